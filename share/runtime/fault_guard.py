"""What fails in a step is told once and costs that step only."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from share.errors import ShareError
from share.timing import LineLimiter

_MAX_TEXT = 160  # characters of an error
_SHOWN_S = 10.0  # how long a failed step is shown as trouble


class FaultGuard:
    """Counts failed steps and reports each kind with its place in the code, where it is new. Safe from any
    thread."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self.failure_count = 0
        self._newest, self._newest_s = "", 0.0  # failure, and its time, monotonic
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

    @property
    def trouble(self) -> str | None:
        """The newest failure, while it is recent; None without one."""
        is_recent = bool(self._newest) and time.monotonic() - self._newest_s < _SHOWN_S
        return f"internal error: {self._newest}" if is_recent else None

    def record(self, what: str, error: Exception) -> None:
        frame_summary = traceback.extract_tb(error.__traceback__)[-1]
        kind = (
            f"{what}: {type(error).__name__} at "
            f"{frame_summary.filename.rpartition('/')[2]}:{frame_summary.lineno}"
        )
        text = f"{kind}: {str(error)[:_MAX_TEXT]}; this step is skipped and the run goes on"
        with self._lock:
            self.failure_count += 1
            self._newest, self._newest_s = kind, time.monotonic()
            line = self._lines.admit_new(text, time.monotonic_ns(), kind)
        if line is not None:
            with contextlib.suppress(Exception):  # what fails may be what it tells
                self._notify(line)
