"""Run jobs on other machines by dask.distributed. Jobs of a worker that dies go to another worker."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import TypeVar

from share.errors import ShareError, UsageError, install_hint

Job = TypeVar("Job")
Result = TypeVar("Result")
_CONNECT_S = 10


class Cluster:
    """A pool with the interface of `share.lab.pool.Pool`, on the dask scheduler at `address`.

    Workers need SHARE, and the same files at the same paths.
    """

    def __init__(self, address: str) -> None:
        if importlib.util.find_spec("distributed") is None:
            raise UsageError(f"--scheduler: {install_hint('distributed', 'cluster')}")
        from distributed import Client

        try:
            self._client = Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise UsageError(f"--scheduler {address}: no answer from a dask scheduler: {error}") from None

    @property
    def worker_count(self) -> int:
        """The number of workers now; 1 while none has connected."""
        return max(1, len(self._client.nthreads()))

    def run(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result]]:
        """Yield every job with `work(job)`, in order of completion. Raises what a job raised."""
        from distributed import KilledWorker, as_completed

        running = {self._client.submit(work, job, pure=False): job for job in jobs}
        try:
            for future in as_completed(list(running)):
                yield running[future], future.result()
        except KilledWorker:
            raise ShareError(
                "a run has ended several workers, one after the other; do they have enough memory?"
            ) from None
        finally:
            self._client.cancel(list(running))

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()
