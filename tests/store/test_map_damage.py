"""A damaged map file: never a crash, never a wrong value, and the file itself is kept."""

import random
import shutil
import sqlite3

import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, as_values, keyframe, run, small_map, solution

from share.errors import ShareError, StoreError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import RemoveKeyframes, SaveLink
from share.store import map_store, salvage
from share.store.map_store import MapStore, is_map
from share.store.schema import PAGE_BYTES


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a closed file, and its map."""
    path = tmp_path_factory.mktemp("whole") / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
        told_whole = as_values(store.load())
    return path.read_bytes(), told_whole


def damaged(folder, data, at, by):
    """A copy of `data`, its byte `keyframe_key` changed."""
    path = folder / "room.sqlite"
    for old in folder.iterdir():
        old.unlink()
    changed = bytearray(data)
    changed[at] ^= by
    path.write_bytes(changed)
    return path, bytes(changed)


def check_opens(path, as_it_was, good):
    """Check that the file opens with right values, names its losses, is kept, and can be written. Return
    the number of lost keyframes."""
    assert is_map(path)
    with MapStore.read(path) as reader:
        read_only = as_values(reader.load())
    assert path.read_bytes() == as_it_was
    with MapStore.open(path) as store:
        found = as_values(store.load())
        store.write([keyframe(ANN, 20)])
    assert found["keyframes"] == read_only["keyframes"]
    lost = check_right(found, good)
    if found["complaints"]:
        assert path.with_name("room.sqlite.damaged-1").read_bytes() == as_it_was
        assert "kept as room.sqlite.damaged-1" in found["complaints"][0]
    with MapStore.open(path) as store:
        later = as_values(store.load())
    assert later["complaints"] == ()
    assert later["loops"] == found["loops"]
    assert later["keyframes"][: len(found["keyframes"])] == found["keyframes"]
    assert len(later["keyframes"]) == len(found["keyframes"]) + 1
    return lost


ABOUT_LOST = "rows about the file, the credentials of runs and forgotten runs could not be read"


def check_right(found, good) -> int:
    """Check that all values are as before, except edges to keyframes whose reference is lost."""
    was = {k[0]: k for k in good["keyframes"]}
    order = [k[0] for k in good["keyframes"] if k[0] in {f[0] for f in found["keyframes"]}]
    assert [k[0] for k in found["keyframes"]] == order
    tied = [k for k in found["keyframes"] if k != was[k[0]]]
    for k in tied:  # all but its edge: reference, T_ref_body, cov
        assert (k[:2], k[3:6], k[8:]) == (was[k[0]][:2], was[k[0]][3:6], was[k[0]][8:])
        assert k[2] in {-1, *(key.id for key in order if key.agent == k[0].agent and key.id < k[0].id)}
    assert set(found["loops"]) <= set(good["loops"])
    assert {run[:-1] for run in found["runs"]} <= {run[:-1] for run in good["runs"]}
    voices = {run[0]: run[-1] for run in good["runs"]}
    silent = [run for run in found["runs"] if run[-1] != voices[run[0]]]
    assert {run[-1] for run in silent} <= {""}
    assert not silent or any(ABOUT_LOST in line for line in found["complaints"])
    assert found["poses"] in (None, good["poses"]) or set(found["poses"][0]) < set(good["poses"][0])
    lost = len(was) - len(order)
    complaints = "\n".join(found["complaints"])
    assert (lost > 0) == (
        "keyframes could not be read" in complaints or "keyframes belong to a run" in complaints
    )
    assert len(tied) == sum(int(c.split()[0]) for c in found["complaints"] if "are linked" in c)
    assert (found["poses"] is None) == ("solutions could not be read" in complaints)
    return lost


@pytest.mark.long
@pytest.mark.parametrize("flips", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_a_flipped_byte_anywhere_costs_a_page_at_most(whole, tmp_path, flips):
    data, good = whole
    draw = random.Random(flips)
    lost = []
    for _ in range(flips):
        path, as_it_was = damaged(tmp_path, data, draw.randrange(len(data)), draw.randrange(1, 256))
        lost.append(check_opens(path, as_it_was, good))
    assert max(lost) <= 2
    assert sum(lost) > flips / 10  # or nothing was put to the test


def test_the_first_page_can_be_lost_whole(whole, tmp_path):
    """The whole page except the markers of a map."""
    data, good = whole
    path, _ = damaged(tmp_path, data, 0, 1)
    text = data.index(b"CREATE TABLE run_copy(")
    path.write_bytes(bytes(text) + data[text : text + 22] + bytes(PAGE_BYTES - text - 22) + data[PAGE_BYTES:])
    assert check_opens(path, path.read_bytes(), good) == 0


@pytest.mark.slow
@pytest.mark.long
def test_any_header_byte_may_be_wrong(whole, tmp_path):
    data, good = whole
    for at in range(0, 100, 3):
        path, as_it_was = damaged(tmp_path, data, at, 0x41)
        assert check_opens(path, as_it_was, good) == 0


def test_a_row_with_a_wrong_crc_is_not_read(whole, tmp_path):
    """Written by SQLite, so only the CRC differs."""
    path, _ = damaged(tmp_path, whole[0], 0, 0)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("UPDATE loop SET inliers = 999 WHERE number = 2")
    connection.execute("UPDATE keyframe SET number = 1000 WHERE number = 7")
    connection.execute("UPDATE run SET next = 3")
    connection.execute("UPDATE stretch SET nth = 7 WHERE number = 1")
    connection.close()
    with MapStore.open(path) as store:
        kept = store.load()
        store.write([keyframe(ANN, 20)])
        newest = store.load().keyframes[-1]
    assert (newest.segment_name, newest.ordinal) == (f"{ANN}/0", 20)
    assert kept.segments == (f"{BOB}/0", f"{ANN}/0")
    assert len(kept.loops) == 4
    assert len(kept.keyframes) == 39
    assert kept.next_ids == {ANN: 20, BOB: 20}
    assert [line for line in kept.problems if "loops could" in line] == ["1 loops could not be read"]
    assert len(kept.runs) == 2  # from their copies


def test_credentials_are_salvaged_from_a_damaged_file(whole, tmp_path):
    """Except of a lost run; an unreadable credential is left out."""
    data, good = whole
    for broken, lost in (("loop SET inliers = 999 WHERE number = 2", 0), ("about SET value = 'E'", 3)):
        for old in tmp_path.iterdir():
            old.unlink()
        path, _ = damaged(tmp_path, data, 0, 0)
        connection = sqlite3.connect(path, isolation_level=None)
        connection.execute(f"UPDATE {broken}")
        connection.close()
        with MapStore.open(path) as store:
            kept = store.load()
        assert [run.credential for run in kept.runs] == (["", ""] if lost else [good["runs"][0][-1], ""])
        said = [line for line in kept.problems if ABOUT_LOST in line]
        assert said == ([f"{lost} {ABOUT_LOST}"] if lost else [])
        with MapStore.open(path) as store:
            assert [run.credential for run in store.load().runs] == [run.credential for run in kept.runs]


def test_a_file_may_be_truncated_or_grown(whole, tmp_path):
    data, good = whole
    path = tmp_path / "room.sqlite"
    for length in (len(data) // 2, len(data) - 1, PAGE_BYTES, len(data) - 5 * PAGE_BYTES):
        for old in tmp_path.iterdir():
            old.unlink()
        path.write_bytes(data[:length])
        with MapStore.open(path) as store:
            found = as_values(store.load())
        check_right(found, good)
        assert found["complaints"]
        assert path.with_name("room.sqlite.damaged-1").read_bytes() == data[:length]


def test_a_lost_keyframe_is_bridged_for_those_that_follow(tmp_path):
    """Later ones are connected to the one before by odometry; used ids are not used again."""
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        link = SaveLink(KeyframeKey(ANN, 6), 3, np.eye(4), np.eye(6))
        frames = [keyframe(ANN, i, 300) for i in range(9)]
        store.write(
            [
                run(ANN),
                *frames,
                link,
                RemoveKeyframes((KeyframeKey(ANN, 4), KeyframeKey(ANN, 5), KeyframeKey(ANN, 8))),
                solution([KeyframeKey(ANN, 6)]),
            ]
        )
    data = bytearray(path.read_bytes())
    data[data.index(frames[3].keyframe.view.descriptors.tobytes()[:64])] ^= 1
    path.write_bytes(data)
    with MapStore.open(path) as store:
        kept = store.load()
    assert [k.keyframe_key.id for k in kept.keyframes] == [0, 1, 2, 6, 7]
    assert kept.next_ids == {ANN: 9}
    tie = kept.links[KeyframeKey(ANN, 6)]
    assert tie.reference == 2
    T_odom = {k.keyframe_key.id: k.keyframe.T_odom_body for k in kept.keyframes}
    assert np.allclose(T_odom[2] @ tie.T_ref_body, T_odom[6], atol=1e-12)
    assert np.linalg.eigvalsh(tie.cov - link.cov)[0] > 0
    assert "1 keyframes lost their predecessor and are linked to an earlier one" in kept.problems


def test_two_damaged_files_are_both_kept(whole, tmp_path):
    data, _ = whole
    path, first = damaged(tmp_path, data, 30 * PAGE_BYTES // 2, 1)
    MapStore.open(path).close()
    second = bytearray(path.read_bytes())
    second[21] ^= 4
    path.write_bytes(second)
    MapStore.open(path).close()
    assert path.with_name("room.sqlite.damaged-1").read_bytes() == first
    assert path.with_name("room.sqlite.damaged-2").read_bytes() == bytes(second)


@pytest.mark.parametrize("step", range(4))
def test_an_interrupted_salvage_loses_nothing(whole, tmp_path, monkeypatch, step):
    """Interrupted before each of the renames; the next opening finishes."""
    data, good = whole
    path, as_it_was = damaged(tmp_path, data, 21, 4)
    shutil.copyfile(path, tmp_path / "room.sqlite-wal")  # some log
    left = [step]
    replace = type(path).replace

    def breaking(self, target):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(5, "broken off")
        return replace(self, target)

    monkeypatch.setattr(type(path), "replace", breaking)
    with pytest.raises(ShareError, match="broken off"):
        salvage.salvage(path)
    monkeypatch.undo()
    with MapStore.open(path) as store:
        assert as_values(store.load())["keyframes"] == good["keyframes"]
    assert path.with_name("room.sqlite.damaged-1").read_bytes() == as_it_was
    assert not path.with_name("room.sqlite.salvaged").exists()


@pytest.mark.long
def test_a_damaged_log_costs_what_comes_after(tmp_path):
    """As after a killed writer, with a log. Of each commit all or nothing."""
    path, copy = tmp_path / "room.sqlite", tmp_path / "killed" / "room.sqlite"
    copy.parent.mkdir()
    with MapStore.open(path) as store:
        store.write([run(ANN)])
        for i in range(0, 40, 2):
            store.write([keyframe(ANN, i), keyframe(ANN, i + 1)])
        file, log = path.read_bytes(), path.with_name("room.sqlite-wal").read_bytes()
    draw, lost = random.Random(3), []
    for _ in range(25):
        for old in copy.parent.iterdir():
            old.unlink()
        changed = bytearray(log)
        changed[draw.randrange(len(log))] ^= draw.randrange(1, 256)
        copy.write_bytes(file)
        copy.with_name("room.sqlite-wal").write_bytes(changed)
        with MapStore.open(copy) as store:
            kept = store.load()
        numbers = [k.keyframe_key.id for k in kept.keyframes]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) % 2 == 0
        assert kept.next_ids.get(ANN, 0) == len(numbers)
        lost.append(40 - len(numbers))
    assert 0 < max(lost) <= 40


def overwrite_pages(path, numbers):
    """As a failing disk does while the map is open: it cannot be read there again."""
    with path.open("r+b") as file:
        for number in numbers:
            file.seek(number * PAGE_BYTES)
            file.write(b"\xa5" * PAGE_BYTES)


@pytest.fixture
def large(tmp_path):
    """An open map of many pages, which has changed since it was opened, and its path."""
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map(300, 60))
    with MapStore.open(path) as store:
        store.write([keyframe(ANN, 300)])
        store.compact()
        yield store, path


def test_damage_that_comes_while_the_map_is_open_is_repaired_and_said(large):
    """A mapper that was restarted then lacked keyframes without a word."""
    store, path = large
    whole = store.rows()
    assert not whole.is_damaged and store.problems == ()
    overwrite_pages(path, range(40, 90, 3))
    read_rows = store.rows()
    assert not read_rows.is_damaged
    lost = len(whole.tables["keyframe"]) - len(read_rows.tables["keyframe"])
    assert store.problems[0].startswith("the file was damaged; it is kept as room.sqlite.damaged-1")
    assert lost and f"{lost} keyframes could not be read" in store.problems
    store.write([keyframe(ANN, 301)])
    assert len(store.rows().tables["keyframe"]) == len(read_rows.tables["keyframe"]) + 1


@pytest.mark.parametrize("how", ["rows", "write"])
def test_a_repair_that_fails_is_tried_again(large, monkeypatch, how):
    """As on a full disk. The file stayed shut until the edge was restarted, and "was removed"."""
    store, path = large
    overwrite_pages(path, range(2, 90, 3))
    repair = store.rows if how == "rows" else lambda: store.write([keyframe(ANN, 301)])

    def full(*_):
        raise ShareError("x.part: cannot be written: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(map_store, "salvage", full)
        for _ in range(3):  # a writer waits for StoreError: of another error, only the change is lost
            with pytest.raises(StoreError, match=r"damaged and cannot be repaired: x.part: .* No space left"):
                repair()
    assert store.problems == ()
    repair()
    assert store.problems[0].startswith("the file was damaged; it is kept as room.sqlite.damaged-1")
    store.write([keyframe(ANN, 302)])
    assert not store.rows().is_damaged


def test_a_repair_that_ended_in_its_last_step_is_finished_and_said(large, monkeypatch):
    store, path = large
    overwrite_pages(path, range(40, 90, 3))

    def interrupted(path):
        raise ShareError(f"{path}: cannot be written: it fails")

    with monkeypatch.context() as patch:
        patch.setattr(salvage, "finish_salvage", interrupted)
        with pytest.raises(StoreError, match="it fails"):
            store.rows()
        patch.setattr(map_store, "finish_salvage", interrupted)
        with pytest.raises(StoreError, match="it fails"):  # of another error, the writer loses the change
            store.write([keyframe(ANN, 301)])
    assert not store.rows().is_damaged
    assert store.problems[0].startswith("the file was damaged; it is kept as room.sqlite.damaged-1")
    assert store.problems[1] == "the repair was interrupted: how much was lost was not counted"


def test_a_repaired_file_that_cannot_be_opened_at_once_is_opened_later(large, monkeypatch):
    """It was "replaced while the edge ran; put it back", for ever."""
    store, path = large
    overwrite_pages(path, range(40, 90, 3))

    def too_many_files(*_):
        raise StoreError("too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(map_store, "open_writer", too_many_files)
        for _ in range(2):
            with pytest.raises(StoreError, match="too many open files"):
                store.rows()
    assert not store.rows().is_damaged
    store.write([keyframe(ANN, 301)])


def test_a_repair_that_is_finished_at_the_next_start_is_said(large, monkeypatch):
    store, path = large
    overwrite_pages(path, range(40, 90, 3))
    with monkeypatch.context() as patch:
        patch.setattr(salvage, "finish_salvage", lambda path: (_ for _ in ()).throw(ShareError("it fails")))
        with pytest.raises(StoreError, match="it fails"):
            store.rows()
    store.close()
    with MapStore.open(path) as again:
        assert again.problems[:2] == (
            "the file was damaged; it is kept as room.sqlite.damaged-1, and its intact rows were taken over",
            "the repair was interrupted: how much was lost was not counted",
        )


def test_a_file_that_is_removed_after_a_repair_has_failed_is_missed(large, monkeypatch):
    store, path = large
    overwrite_pages(path, range(2, 90, 3))
    with monkeypatch.context() as patch:
        patch.setattr(map_store, "salvage", lambda path: (_ for _ in ()).throw(ShareError("it fails")))
        with pytest.raises(StoreError, match="it fails"):
            store.rows()
    path.unlink()
    with pytest.raises(StoreError, match="was removed while the edge ran"):
        store.write([keyframe(ANN, 301)])
    assert not path.exists()


def test_a_file_that_was_replaced_is_not_repaired_in_its_place(large, whole):
    store, path = large
    overwrite_pages(path, range(40, 90, 3))
    path.unlink()
    path.write_bytes(whole[0])
    with pytest.raises(StoreError, match="was replaced while the edge ran"):
        store.rows()
    assert path.read_bytes() == whole[0]


class FailingConnection:
    """A connection that fails at the query of this number."""

    def __init__(self, connection, error, number):
        self._connection, self._error, self._left = connection, error, number

    def execute(self, *query):
        self._left -= 1
        if self._left == 0:
            raise self._error
        return self._connection.execute(*query)

    def close(self):
        self._connection.close()


def of_sqlite(code):
    error = sqlite3.OperationalError("it fails")
    error.sqlite_errorcode = code
    return error


@pytest.mark.parametrize("number", [1, 2, 3, 5])
@pytest.mark.parametrize(
    "error",
    [of_sqlite(sqlite3.SQLITE_IOERR_READ), of_sqlite(sqlite3.SQLITE_BUSY), MemoryError()],
    ids=["io", "busy", "memory"],
)
def test_a_machine_that_fails_for_a_moment_costs_no_rows(tmp_path, error, number):
    """Half of the map was restored, as if the rest were lost."""
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        store.write(small_map())
        read_rows, connection = store.rows(), store._db
        store._db = FailingConnection(connection, error, number)
        with pytest.raises(StoreError, match=r"the map cannot be read: (it fails|out of memory)"):
            store.rows()
        store._db = connection
        assert store.rows().tables == read_rows.tables
    assert not path.with_name("room.sqlite.damaged-1").exists()


def test_a_change_for_which_memory_is_short_is_not_taken_for_faulty(tmp_path):
    """It was skipped, and its keyframe acknowledged."""
    path = tmp_path / "room.sqlite"
    with MapStore.open(path) as store:
        connection = store._db
        store._db = FailingConnection(connection, MemoryError(), 2)
        with pytest.raises(StoreError, match="the map cannot be written: out of memory"):
            store.write(small_map())
        store._db = connection
        store.write(small_map())
        assert len(store.load().keyframes) == 40


def test_short_memory_while_a_file_is_opened_does_not_make_it_damaged(whole, tmp_path, monkeypatch):
    path = tmp_path / "room.sqlite"
    path.write_bytes(whole[0])

    def fails(*_):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(salvage, "own_tables", fails)
        with pytest.raises(StoreError, match="out of memory"):
            MapStore.open(path)
    assert path.read_bytes() == whole[0]
    with MapStore.open(path) as store:
        assert as_values(store.load()) == whole[1]
