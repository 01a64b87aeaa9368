"""A live run does not wait for its disk, and reports trouble with it."""

from __future__ import annotations

import threading
import time

import pytest

from share.errors import ShareError
from share.runtime import output_writer
from share.runtime.output_writer import OutputWriter


class Disk:
    def __init__(self) -> None:
        self.lines: list[int] = []
        self.go_on = threading.Event()
        self.go_on.set()

    def write(self, line: int) -> None:
        self.go_on.wait()
        self.lines.append(line)


def write(writer: OutputWriter, disk: Disk, lines: range) -> None:
    for line in lines:
        writer.submit(lambda line=line: disk.write(line))


def test_all_is_written_in_order() -> None:
    messages, disk = list[str](), Disk()
    writer = OutputWriter("out", messages.append)
    write(writer, disk, range(1000))
    writer.stop()
    writer.check()
    assert (disk.lines, messages, writer.trouble) == (list(range(1000)), [], None)


def test_a_disk_that_does_not_answer_and_its_recovery_are_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(output_writer, "_SLOW_WRITE_S", 0.05)
    messages, disk = list[str](), Disk()
    writer = OutputWriter("out", messages.append)
    disk.go_on.clear()
    write(writer, disk, range(2))
    time.sleep(0.1)
    began = time.monotonic()
    write(writer, disk, range(2, 100))
    assert time.monotonic() - began < 0.05
    assert writer.trouble == "out: its disk has not answered for 0 s"
    assert messages == ["out: its disk has not answered for 0 s; writes wait"]
    disk.go_on.set()
    writer.stop()
    writer.check()
    assert disk.lines == list(range(100))
    assert messages[1:] == ["out: is written again"]
    assert writer.trouble is None


def test_stop_does_not_wait_for_a_disk_that_does_not_answer() -> None:
    disk = Disk()
    writer = OutputWriter("out", print)
    disk.go_on.clear()
    write(writer, disk, range(2))
    writer.stop(0.05)
    with pytest.raises(ShareError, match="out: is not complete: its disk does not answer"):
        writer.check()
    disk.go_on.set()


def test_pending_jobs_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_writer, "MAX_PENDING", 10)
    messages, disk = list[str](), Disk()
    writer = OutputWriter("out", messages.append)
    disk.go_on.clear()
    write(writer, disk, range(50))
    assert messages == ["out: too many writes wait for its disk; further ones are dropped"]
    disk.go_on.set()
    writer.stop()
    assert disk.lines == list(range(len(disk.lines)))
    assert 10 <= len(disk.lines) <= 11
    with pytest.raises(ShareError, match="out: is not complete: its disk did not answer for too long"):
        writer.check()


def test_a_failed_job_is_raised_at_the_end() -> None:
    disk = Disk()
    writer = OutputWriter("out", print)

    def fails() -> None:
        raise ShareError("out/a: cannot be written: Disk quota exceeded")

    writer.submit(fails)
    write(writer, disk, range(3))
    writer.stop()
    assert disk.lines == [0, 1, 2]
    with pytest.raises(ShareError, match="Disk quota exceeded"):
        writer.check()


def test_a_thread_that_cannot_be_had_is_missed_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not at the first job, of which another would wait in vain."""
    monkeypatch.setattr(threading.Thread, "start", lambda thread: {}["none"])
    with pytest.raises(KeyError):
        OutputWriter("out", print)
