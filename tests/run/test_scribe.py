"""A live run does not wait for the disk that it writes to, and says what that costs."""

from __future__ import annotations

import threading
import time

import pytest

from share.errors import ShareError
from share.runtime import output_writer as scribe_module
from share.runtime.output_writer import OutputWriter


class Disk:
    def __init__(self) -> None:
        self.lines: list[int] = []
        self.go_on = threading.Event()
        self.go_on.set()

    def write(self, line: int) -> None:
        self.go_on.wait()
        self.lines.append(line)


def write(scribe: OutputWriter, disk: Disk, lines: range) -> None:
    for line in lines:
        scribe.submit(lambda line=line: disk.write(line))


def test_all_is_written_in_order() -> None:
    said, disk = list[str](), Disk()
    scribe = OutputWriter("out", said.append)
    write(scribe, disk, range(1000))
    scribe.stop()
    scribe.check()
    assert (disk.lines, said, scribe.trouble) == (list(range(1000)), [], None)


def test_a_disk_that_does_not_answer_is_said_and_that_it_does_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scribe_module, "_SLOW_WRITE_S", 0.05)
    said, disk = list[str](), Disk()
    scribe = OutputWriter("out", said.append)
    disk.go_on.clear()
    write(scribe, disk, range(2))
    time.sleep(0.1)
    began = time.monotonic()
    write(scribe, disk, range(2, 100))
    assert time.monotonic() - began < 0.05
    assert scribe.trouble == "out: its disk has not answered for 0 s"
    assert said == ["out: its disk has not answered for 0 s; writes wait"]
    disk.go_on.set()
    scribe.stop()
    scribe.check()
    assert disk.lines == list(range(100))
    assert said[1:] == ["out: is written again"]
    assert scribe.trouble is None


def test_who_ends_does_not_wait_for_it() -> None:
    disk = Disk()
    scribe = OutputWriter("out", print)
    disk.go_on.clear()
    write(scribe, disk, range(2))
    scribe.stop(0.05)
    with pytest.raises(ShareError, match="out: is not complete: its disk does not answer"):
        scribe.check()
    disk.go_on.set()


def test_what_waits_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scribe_module, "MAX_PENDING", 10)
    said, disk = list[str](), Disk()
    scribe = OutputWriter("out", said.append)
    disk.go_on.clear()
    write(scribe, disk, range(50))
    assert said == ["out: too many writes wait for its disk; further ones are dropped"]
    disk.go_on.set()
    scribe.stop()
    assert disk.lines == list(range(len(disk.lines)))
    assert 10 <= len(disk.lines) <= 11
    with pytest.raises(ShareError, match="out: is not complete: its disk did not answer for too long"):
        scribe.check()


def test_what_fails_is_raised_at_the_end_and_costs_itself() -> None:
    disk = Disk()
    scribe = OutputWriter("out", print)

    def fails() -> None:
        raise ShareError("out/a: cannot be written: Disk quota exceeded")

    scribe.submit(fails)
    write(scribe, disk, range(3))
    scribe.stop()
    assert disk.lines == [0, 1, 2]
    with pytest.raises(ShareError, match="Disk quota exceeded"):
        scribe.check()
