# SPDX-License-Identifier: Apache-2.0
"""The two ways a call can fail that are not a bug, and what a process makes of them."""

import errno
import os
import sys
from collections.abc import Callable

_OF_PATHS = (errno.EACCES, errno.ENAMETOOLONG)  # asking whether such a file is there fails already


class Dpm2Error(Exception):
    """The work failed: a full disk, a damaged file found half-way. One line, naming what and where."""

    exit_code = 1


class UsageError(Dpm2Error):
    """The request cannot be carried out as given: no such file, an unknown key, a missing extrinsic."""

    exit_code = 2


def exit_code(work: Callable[[], int | None], name: str = "error") -> int:
    """Run `work` and return its exit code; where it fails, that of the error, which is one line on stderr after `name`.

    An error that is a bug is raised. A path that may not be entered, or with a name that is too long, is none.
    """
    try:
        return work() or 0
    except Exception as error:
        code, text = getattr(error, "exit_code", None), str(error)
        if isinstance(error, OSError) and error.errno in _OF_PATHS and isinstance(error.filename, (str, bytes)):
            code, text = Dpm2Error.exit_code, f"{os.fsdecode(error.filename)}: {error.strerror}"
        if code is None:
            raise
        if hasattr(error, "format_message"):  # click's own errors of use: an unknown option, a missing argument
            text = " ".join(error.format_message().split())
        if text:  # a group of commands that is called without one has shown its help
            print(f"{name}: {printable(text)}", file=sys.stderr)
        return int(code)


def printable(text: str) -> str:
    """Text from a file or a message as one line for a terminal: what would steer it is shown, not sent."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def one_line(error: Exception) -> str:
    """What an error of a library says, or its type where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__
