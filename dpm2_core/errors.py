# SPDX-License-Identifier: Apache-2.0
"""The two kinds of failure that are not bugs, and the exit codes they cause."""

import errno
import os
import sys
from collections.abc import Callable

_PATH_ERRORS = (errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP)
"""Already the check whether such a file exists raises these."""


class Dpm2Error(Exception):
    """The work failed, such as by a full disk or a damaged file. One line that names what and where."""

    exit_code = 1


class UsageError(Dpm2Error):
    """The request cannot be carried out as given: a missing file, an unknown key, a missing extrinsic calibration."""

    exit_code = 2


def exit_code(work: Callable[[], int | None], name: str = "error") -> int:
    """Run `work` and return its exit code; on an error, print it as one line on stderr after `name`, return its code.

    An error that is a bug is raised. A path without access permission, with a name that is too long, or in a loop of
    symbolic links is not a bug.
    """
    try:
        return work() or 0
    except Exception as raised:
        cause = raised.__context__  # `Path.resolve` replaces ELOOP by a RuntimeError before Python 3.13
        error = cause if isinstance(cause, OSError) and cause.errno == errno.ELOOP else raised
        code, text = getattr(error, "exit_code", None), str(error)
        if isinstance(error, OSError) and error.errno in _PATH_ERRORS and isinstance(error.filename, (str, bytes)):
            code, text = Dpm2Error.exit_code, f"{os.fsdecode(error.filename)}: {error.strerror}"
        if code is None:
            raise
        if hasattr(error, "format_message"):  # click's own usage errors: an unknown option, a missing argument
            text = " ".join(error.format_message().split())
        if text:  # empty for a group of commands that is called without one: it has shown its help
            print(f"{name}: {printable(text)}", file=sys.stderr)
        return int(code)


def printable(text: str) -> str:
    """Text from a file or a message as one line for a terminal: control characters are escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def one_line(error: Exception) -> str:
    """The message of a library's error on one line, or its type if the message is empty."""
    return " ".join(str(error).split()) or type(error).__name__
