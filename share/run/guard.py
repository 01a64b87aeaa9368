"""A step that fails costs what it was about, and not the process."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from share.errors import ShareError

_MOST_SAID = 16  # kinds of failure


class Guard:
    """Counts steps that failed, and says each kind once, with the place in the program."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.failed = 0
        self._say = say
        self._said: set[str] = set()

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Within it any error but a ShareError, which ends a run by intent, costs only this step."""
        try:
            yield
        except ShareError:
            raise
        except Exception as error:
            self.note(what, error)

    def note(self, what: str, error: Exception) -> None:
        self.failed += 1
        at = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{what}: {type(error).__name__} at {at.filename.rpartition('/')[2]}:{at.lineno}"
        if kind not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(kind)
            text = "".join(c if c.isprintable() else "?" for c in str(error))[:200]
            self._say(f"{kind}: {text}; it is left out and the run goes on")
