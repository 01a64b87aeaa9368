"""Recordings that were cut off or damaged are refused with a hint, and recovered as far as intact."""

import errno
import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.live import RIG, frames, live
from helpers.recordings import STEP_NS, make_tum

from share.errors import DataError, ShareError, UsageError
from share.recordings.convert import to_mcap
from share.recordings.mcap.recorder import Recorder, recover_recording
from share.runtime.source import open_source


def nothing(done: int) -> None:
    pass


def test_other_files_and_empty_ones_are_refused(tmp_path):
    for content in (b"", b"hello, this is no recording"):
        (tmp_path / "x.mcap").write_bytes(content)
        with pytest.raises(DataError, match="is not an MCAP file, or is empty"):
            open_source(str(tmp_path / "x.mcap"))
        with pytest.raises(DataError, match="is not an MCAP file, or is empty"):
            recover_recording(tmp_path / "x.mcap", tmp_path / "y.mcap")
    assert not (tmp_path / "y.mcap").exists()


def record(path: Path, count: int) -> Path:
    with Recorder(path, RIG) as recorder:
        for m in live(count):
            recorder.write(m)
    return path


def test_any_cut_is_refused_and_recovered(tmp_path):
    """Cut anywhere: opening names the remedy; recovery saves an unaltered beginning."""
    data = record(tmp_path / "whole.mcap", 200).read_bytes()
    whole = [(m.stream, m.stamp_ns) for m in open_source(str(tmp_path / "whole.mcap")).measurements()]
    saved_before = 0
    for part in (0.2, 0.4, 0.6, 0.8):
        cut, good = tmp_path / "cut.mcap", tmp_path / f"good{part}.mcap"
        cut.write_bytes(data[: int(len(data) * part)])
        with pytest.raises(DataError, match=r"share dataset recover"):
            open_source(str(cut))
        result = recover_recording(cut, good)
        back = [(m.stream, m.stamp_ns) for m in open_source(str(good)).measurements()]
        assert back == whole[: len(back)]
        assert len(back) > saved_before
        assert len(back) == sum(n for t, n in result.messages.items() if "info" not in t and "tf" not in t)
        saved_before = len(back)
    assert result.lost_bytes < 400_000
    (tmp_path / "nothing.mcap").write_bytes(data[:60])
    with pytest.raises(DataError, match="has no complete message"):
        recover_recording(tmp_path / "nothing.mcap", tmp_path / "no.mcap")
    assert not list(tmp_path.glob("no.mcap*"))


def test_a_flipped_bit_costs_one_chunk(tmp_path):
    path = record(tmp_path / "whole.mcap", 100)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    source = open_source(str(broken))
    read = list(source.measurements())
    (said,) = source.losses.lines()
    assert said.startswith(f"skipped as damaged: 1 of the chunks of {broken}; the first: ")
    assert "share dataset recover" in said
    result = recover_recording(broken, tmp_path / "good.mcap")
    assert result.reason
    left = open_source(str(tmp_path / "good.mcap")).images_count
    assert 60 < left < 100
    assert sum(m.stream == "cam0" for m in read) == left


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(errno.EIO, "Input/output error"), "Input/output error"),
        (MemoryError(), "damaged: MemoryError"),
    ],
)
def test_recovery_keeps_what_precedes_a_read_error(tmp_path, monkeypatch, error, says):
    path = record(tmp_path / "whole.mcap", 100)
    half = path.stat().st_size // 2

    class Worn(io.FileIO):
        def readinto(self, buffer):
            if self.tell() + len(buffer) > half:
                raise error
            return super().readinto(buffer)

    monkeypatch.setattr(
        "share.recordings.mcap.recorder.open_regular", lambda name: io.BufferedReader(Worn(name, "rb"))
    )
    result = recover_recording(path, tmp_path / "good.mcap")
    monkeypatch.undo()
    assert says in result.reason
    assert 0.3 * path.stat().st_size < result.lost_bytes < 0.8 * path.stat().st_size
    assert open_source(str(tmp_path / "good.mcap")).images_count > 20


def test_recovery_skips_a_chunk_that_exceeds_memory(tmp_path, monkeypatch):
    from mcap import stream_reader

    path, opened, chunks = record(tmp_path / "whole.mcap", 100), stream_reader.breakup_chunk, iter(range(99))

    def greedy(chunk):
        if next(chunks) == 3:
            raise MemoryError
        return opened(chunk)

    monkeypatch.setattr(stream_reader, "breakup_chunk", greedy)
    assert recover_recording(path, tmp_path / "good.mcap").reason == "damaged: MemoryError"
    assert 60 < open_source(str(tmp_path / "good.mcap")).images_count < 100


def test_recovery_overwrites_no_file(tmp_path):
    whole = record(tmp_path / "whole.mcap", 20)
    other, part = tmp_path / "a.mcap", tmp_path / "b.mcap.part"
    other.write_bytes(b"dear")
    part.write_bytes(b"dear too")
    with pytest.raises(UsageError, match=r"a\.mcap: exists and is not overwritten; give a new name"):
        recover_recording(whole, other)
    recover_recording(whole, tmp_path / "b.mcap")
    assert (other.read_bytes(), part.read_bytes()) == (b"dear", b"dear too")
    assert sorted(os.listdir(tmp_path)) == ["a.mcap", "b.mcap", "b.mcap.part", "whole.mcap"]
    assert (tmp_path / "b.mcap").stat().st_mode & 0o777 == whole.stat().st_mode & 0o777


def test_a_full_disk_is_reported_as_such(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    whole = record(tmp_path / "whole.mcap", 20)
    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    with pytest.raises(ShareError, match=r"good\.mcap: cannot be written: No space left"):
        recover_recording(whole, tmp_path / "good.mcap")
    assert os.listdir(tmp_path) == ["whole.mcap"]


@pytest.mark.long
def test_a_killed_recorder_leaves_a_recoverable_file(tmp_path):
    """A recorder in a process of its own is killed: at most the last second is missing."""
    out = tmp_path / "walk.mcap"
    code = (
        "import sys, time; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path; from helpers.live import RIG, live\n"
        "from share.recordings.mcap.recorder import Recorder\n"
        "with Recorder(Path(sys.argv[1]), RIG) as recorder:\n"
        "    for m in live(10**6):\n"
        "        recorder.write(m)\n"
        "        if m.stream == 'depth': print(m.stamp_ns, flush=True); time.sleep(0.001)\n"
    )
    folders = [str(Path(__file__).parents[1])]
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(out), *folders], stdout=subprocess.PIPE, text=True
    )
    for _ in range(150):
        last = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert os.listdir(tmp_path) == ["walk.mcap.part"]
    for given in (f"{out}.part", str(out)):
        with pytest.raises(UsageError, match=f"recorded; `share dataset recover {out}.part --out {out}`"):
            open_source(given)
    recover_recording(tmp_path / "walk.mcap.part", out)
    stamps = open_source(str(out)).stamps()["cam0"]
    assert last - stamps[-1] <= 10**9 + STEP_NS
    assert len(frames(open_source(str(out)))) >= 125


def test_an_error_while_converting_leaves_nothing(tmp_path):
    folder = make_tum(tmp_path / "walk")
    for image in (folder / "rgb" / "2.jpg", folder / "rgb" / "3.jpg"):
        image.write_bytes(image.read_bytes()[:-100])
    out = tmp_path / "out"
    with pytest.raises(DataError, match=r"2\.jpg: the image is cut short.*2 of 5 images of cam0 are damaged"):
        to_mcap(open_source(str(folder)), out / "x.mcap", None, nothing)
    assert os.listdir(out) == []
