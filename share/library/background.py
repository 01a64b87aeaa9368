"""What runs in threads of this process from its start to its stop."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, Self

from share.errors import ShareError


class BackgroundRun(ABC):
    """Context manager: start on entry, stop on exit. An error in the block hides an error of `stop`."""

    @abstractmethod
    def start(self) -> None: ...

    @abstractmethod
    def stop(self) -> Any: ...

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(ShareError) if error is not None else contextlib.nullcontext():
            self.stop()
