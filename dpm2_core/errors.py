# SPDX-License-Identifier: Apache-2.0
"""The two ways a call can fail that are not a bug; the command line turns them into exit codes 2 and 1."""


class Dpm2Error(Exception):
    """The work failed: a full disk, a damaged file found half-way. One line, naming what and where. Exit code 1."""


class UsageError(Dpm2Error):
    """The request cannot be carried out as given: no such file, an unknown key, a missing extrinsic. Exit code 2."""


def printable(text: str) -> str:
    """Text from a file or a message as one line for a terminal: what would steer it is shown, not sent."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
