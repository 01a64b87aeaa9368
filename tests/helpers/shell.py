"""What a command came to."""

from typing import NamedTuple


class Done(NamedTuple):
    """Its exit code, stdout and stderr."""

    code: int
    out: str
    err: str
