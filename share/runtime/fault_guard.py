"""What fails in a step is told once and costs that step only."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from share.errors import ShareError
from share.timing import LineLimiter

_MAX_TEXT = 160  # characters of an error


class FaultGuard:
    """Counts failed steps and reports each kind with its place in the code, where it is new. Safe from any
    thread."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self.failure_count = 0
        self._notify = notify
        self._lines, self._lock = LineLimiter(), threading.Lock()

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Suppress and record any error in the block but a ShareError, which ends a run on purpose.

        what: the step, for the report.
        """
        try:
            yield
        except ShareError:
            raise
        except Exception as error:
            self.record(what, error)

    def record(self, what: str, error: Exception) -> None:
        frame_summary = traceback.extract_tb(error.__traceback__)[-1]
        kind = (
            f"{what}: {type(error).__name__} at "
            f"{frame_summary.filename.rpartition('/')[2]}:{frame_summary.lineno}"
        )
        text = f"{kind}: {str(error)[:_MAX_TEXT]}; this step is skipped and the run goes on"
        with self._lock:
            self.failure_count += 1
            line = self._lines.admit_new(text, time.monotonic_ns(), kind)
        if line is not None:
            self._notify(line)
