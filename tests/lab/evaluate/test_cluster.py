"""Jobs on a cluster, of which a worker dies."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from share.errors import UsageError
from share.lab.evaluate.campaign import Cluster

distributed = pytest.importorskip("distributed", reason="pip install 'share-slam[cluster]' brings it")


def slow_square(job: tuple[int, str]) -> int:
    """The first who takes 3 dies of it."""
    number, folder = job
    mark = Path(folder) / "died"
    if number == 3 and not mark.exists():
        mark.write_text(str(os.getpid()))
        os._exit(1)
    time.sleep(0.05)
    return number * number


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # dask's own
def test_jobs_of_a_dead_worker_are_done_by_another(tmp_path):
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        Cluster(cluster.scheduler_address) as workers,
    ):
        done = dict(workers.run(slow_square, [(n, str(tmp_path)) for n in range(8)]))
    assert {job[0]: square for job, square in done.items()} == {n: n * n for n in range(8)}
    assert (tmp_path / "died").exists()


@pytest.mark.slow
def test_an_unreachable_scheduler_is_refused():
    with pytest.raises(UsageError, match=r"--scheduler tcp://127\.0\.0\.1:1: no answer from"):
        Cluster("tcp://127.0.0.1:1")
