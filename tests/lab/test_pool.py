"""Jobs on several processes: all are done, errors are heard, nothing is left running."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from share.errors import ShareError, UsageError
from share.lab.pool import Pool

_base = 0


def start(base):
    global _base
    _base = base


def add(job):
    return _base + job


def fail_at_three(job):
    if job == 3:
        raise UsageError("three is not to be had")
    return job


def die(job):
    os.kill(os.getpid(), signal.SIGKILL)


def sleep_in_pool(ready, count):
    """A parent that waits for its workers."""
    with Pool(1, start, (0,)) as pool:
        for _ in pool.run(report_and_sleep, [ready] * count):
            pass


def report_and_sleep(ready):
    Path(ready).write_text(str(os.getpid()))
    time.sleep(60)


def test_every_job_is_done_once():
    with Pool(2, start, (100,)) as pool:
        assert dict(pool.run(add, range(20))) == {k: 100 + k for k in range(20)}
        assert list(pool.run(add, [])) == []


def test_what_a_job_raises_is_raised_here():
    with pytest.raises(UsageError, match="three is not"), Pool(1, start, (0,)) as pool:
        list(pool.run(fail_at_three, range(100)))


def fail_or_sleep(job):
    if job:
        raise UsageError("the second fails")
    time.sleep(60)


def test_an_error_does_not_wait_for_what_runs():
    began = time.monotonic()
    with pytest.raises(UsageError, match="second"), Pool(2, start, (0,)) as pool:
        list(pool.run(fail_or_sleep, range(2)))
    assert time.monotonic() - began < 40
    assert multiprocessing.active_children() == []


def cannot_start():
    raise UsageError("nothing to start with")


def test_what_the_start_raises_is_raised_here(capfd):
    with pytest.raises(UsageError, match="nothing to start with"), Pool(2, cannot_start, ()) as pool:
        list(pool.run(add, range(3)))
    assert capfd.readouterr() == ("", "")


def test_a_worker_that_dies_is_said():
    with pytest.raises(ShareError, match="has died"), Pool(1, start, (0,)) as pool:
        list(pool.run(die, [1]))


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    ready = tmp_path / "ready"
    parent = multiprocessing.get_context("spawn").Process(target=sleep_in_pool, args=(str(ready), 1))
    parent.start()
    deadline = time.monotonic() + 30
    while not (ready.exists() and ready.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    worker = int(ready.read_text())
    parent.kill()
    parent.join()
    state = Path(f"/proc/{worker}/stat")
    while state.exists() and state.read_text().split()[2] != "Z":
        assert time.monotonic() < deadline, "the worker lives on"
        time.sleep(0.05)
