"""The map file: all that was written is read back to the last bit."""

import errno
import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers.map_changes import ANN, BOB, as_values, keyframe, loop, pose, run, small_map, solution
from helpers.special_files import KINDS, special

from share.errors import StoreError, UsageError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    RemoveKeyframes,
    RemoveLoops,
    RemoveRun,
    SaveCredential,
    SaveLink,
    SaveLoop,
    SavePoses,
    SaveRun,
    with_unknown_credentials,
)
from share.protocol.peer import restored_runs
from share.store import loading, schema
from share.store.keyframe_archive import KeyframeArchive
from share.store.map_store import MapStore, is_map
from share.store.rows import insert
from share.wire import codec


@pytest.fixture
def path(tmp_path):
    return tmp_path / "room.sqlite"


def reopened(path):
    with MapStore.open(path) as store:
        return store.load()


def files(path):
    return sorted(os.listdir(path.parent))


def test_a_new_file_is_empty(path):
    with MapStore.open(path) as store:
        assert as_values(store.load()) == as_values(type(store.load())())
        assert (store.writable, store.read_only_reason) == (True, "")
    assert is_map(path)
    assert files(path) == ["room.sqlite", "room.sqlite.lock"]


def test_all_changes_are_read_back(path):
    with MapStore.open(path) as store:
        store.write(small_map())
        before = as_values(store.load())
    kept = reopened(path)
    assert as_values(kept) == before
    frames = [keyframe(key, i) for i in range(20) for key in (ANN, BOB)]
    assert [k.keyframe_key for k in kept.keyframes] == [k.keyframe_key for k in frames]
    for found, sent in zip(kept.keyframes, frames, strict=True):
        assert np.array_equal(found.keyframe.view.descriptors, sent.keyframe.view.descriptors)
        assert np.array_equal(found.keyframe.view.points, sent.keyframe.view.points)
        assert np.array_equal(found.keyframe.T_odom_body, sent.keyframe.T_odom_body)
    assert [(x.a.id, x.inliers) for x in kept.loops] == [(i, 20 + i) for i in range(0, 20, 4)]
    assert np.array_equal(kept.poses.T_map_body[5], pose(7) @ pose(2))
    assert kept.segments == (f"{ANN}/0", f"{BOB}/0")
    assert kept.next_ids == {ANN: 20, BOB: 20}
    assert kept.problems == ()


def test_images_are_read_back_byte_by_byte(path):
    sent = keyframe(ANN, 0).keyframe.image
    with MapStore.open(path) as store:
        store.write([run(ANN), keyframe(ANN, 0)])
    found = reopened(path).keyframes[0].keyframe.image
    assert len(sent.jpeg) == 60 and len(sent.uv) == 3
    for name in ("uv", "plane", "rho_sigma"):
        assert getattr(found, name).tobytes() == getattr(sent, name).tobytes()
    assert len(found.jpeg) == 0  # read when it is needed
    jpeg = KeyframeArchive(path).jpeg(KeyframeKey(ANN, 0))
    assert jpeg is not None and jpeg.tobytes() == sent.jpeg.tobytes()


def test_keyframes_of_wire_5_are_read_without_an_image(path):
    """As SHARE before images wrote them: today's message without its last four arrays."""
    with MapStore.open(path) as store:
        store.write([run(ANN), keyframe(ANN, 0), keyframe(ANN, 1)])
    sent = keyframe(ANN, 0).keyframe
    frames = [bytes(frame) for frame in codec.encode(sent)]
    _, code, scalars, table = msgspec.msgpack.decode(frames[0])
    blob = msgspec.msgpack.encode([msgspec.msgpack.encode((5, code, scalars, table[:7])), *frames[1:8]])
    with closing(sqlite3.connect(path)) as connection, connection:
        columns = "number, run, id, stretch, ordinal"
        number, *place = connection.execute(f"SELECT {columns} FROM keyframe WHERE id = 0").fetchone()
        connection.execute("DELETE FROM keyframe WHERE number = ?", (number,))
        insert(connection, "keyframe", (*place, 5, blob), number)
    kept = reopened(path)
    assert kept.problems == ()
    old, new = (found.keyframe for found in kept.keyframes)
    assert (len(old.image.uv), len(new.image.uv)) == (0, 3)
    assert np.array_equal(old.view.descriptors, sent.view.descriptors)
    assert np.array_equal(old.T_ref_body, sent.T_ref_body)


def test_repeated_changes_change_nothing(path):
    with MapStore.open(path) as store:
        store.write(small_map())
        before = as_values(store.load())
        store.write(small_map())
        assert as_values(store.load()) == before


def test_a_new_solution_replaces_the_old(path):
    with MapStore.open(path) as store:
        store.write(small_map())
        store.write([solution([KeyframeKey(ANN, 3)], "elsewhere")])
        poses = store.load().poses
    assert (poses.keys, poses.map_ids) == ((KeyframeKey(ANN, 3),), ("elsewhere",))


def test_ids_of_removed_keyframes_are_not_used_again(path):
    with MapStore.open(path) as store:
        store.write(small_map())
        link = SaveLink(KeyframeKey(ANN, 5), 3, pose(2), np.eye(6) * 1e-3)
        moved = SaveLoop(loop(3, 4))
        store.write(
            [
                RemoveLoops(KeyframeKey(BOB, 4), KeyframeKey(ANN, 4)),
                moved,
                link,
                RemoveKeyframes((KeyframeKey(ANN, 4), KeyframeKey(ANN, 19))),
            ]
        )
        store.write([keyframe(ANN, 4), keyframe(ANN, 19)])  # late copies
    kept = reopened(path)
    numbers = [k.keyframe_key.id for k in kept.keyframes if k.run_key == ANN]
    assert numbers == [i for i in range(19) if i != 4]
    assert kept.next_ids[ANN] == 20
    assert [x.a.id for x in kept.loops] == [0, 8, 12, 16, 3]
    assert kept.links.keys() == {KeyframeKey(ANN, 5)}
    assert (kept.links[KeyframeKey(ANN, 5)].reference, kept.links[KeyframeKey(ANN, 5)].cov[0, 0]) == (3, 1e-3)
    assert KeyframeKey(ANN, 4) not in kept.poses.keys
    assert len(kept.poses.keys) == 38
    assert kept.problems == ()


def test_segments_stay_in_order_without_their_keyframes(path):
    with MapStore.open(path) as store:
        store.write([run(ANN), run(BOB), keyframe(ANN, 0), keyframe(BOB, 0), keyframe(ANN, 1, first=True)])
        store.write([RemoveKeyframes((KeyframeKey(ANN, 0),))])
        store.write(
            [keyframe(ANN, 2), keyframe(ANN, 3), RemoveKeyframes((KeyframeKey(ANN, 2),)), keyframe(ANN, 4)]
        )
        store.write([keyframe(ANN, 5, first=True)])
    kept = reopened(path)
    assert kept.segments == (f"{ANN}/0", f"{BOB}/0", f"{ANN}/1", f"{ANN}/2")
    places = [(k.keyframe_key.id, k.segment_name, k.ordinal) for k in kept.keyframes if k.run_key == ANN]
    assert places == [(1, f"{ANN}/1", 0), (3, f"{ANN}/1", 2), (4, f"{ANN}/1", 3), (5, f"{ANN}/2", 0)]


def credentials(path):
    return {run.run_key: run.credential for run in reopened(path).runs}


def test_credentials_are_stored_and_may_change(path):
    with MapStore.open(path) as store:
        store.write(small_map())
    assert credentials(path) == {ANN: f"key of {ANN[:3]}", BOB: ""}
    for voice in ("E", "F", ""):
        with MapStore.open(path) as store:
            store.write(
                [SaveCredential(BOB, voice), SaveCredential(ANN, voice), SaveCredential("eve-0003", "E")]
            )
        assert credentials(path) == {ANN: voice, BOB: voice}
    with MapStore.open(path) as store:
        store.write([SaveCredential(BOB, "B"), SaveCredential(ANN, "A"), RemoveRun(BOB)])
        store.write([run(BOB)])
    assert credentials(path) == {ANN: "A", BOB: ""}


def test_a_map_of_share_0_1_has_no_credentials(path):
    """It has only the first rows of `about`."""
    with MapStore.open(path) as store:
        store.write([replace(one, credential="") if isinstance(one, SaveRun) else one for one in small_map()])
    with closing(sqlite3.connect(path)) as connection:
        assert {name for (name,) in connection.execute("SELECT name FROM about")} == {"schema", "made by"}
    kept = reopened(path)
    assert {run.credential for run in kept.runs} == {""}
    assert {run.credential for run in with_unknown_credentials(kept).runs} == {None}  # may be anybody
    assert kept.problems == ()
    assert files(path) == ["room.sqlite", "room.sqlite.lock"]
    with MapStore.open(path) as store:
        store.write([SaveCredential(ANN, "A")])
    assert {run.run_key: run.credential for run in with_unknown_credentials(reopened(path)).runs} == {
        ANN: "A",
        BOB: None,
    }


def test_one_pair_of_keyframes_may_have_two_loops(path):
    with MapStore.open(path) as store:
        store.write([*small_map(), SaveLoop(loop(4, 4)), SaveLoop(loop(4, 4).reverse())])
        assert len(store.load().loops) == 6
        store.write([RemoveLoops(KeyframeKey(ANN, 4), KeyframeKey(BOB, 4))])
        assert len(store.load().loops) == 4


def test_a_list_of_changes_is_written_whole_or_not_at_all(path):
    with MapStore.open(path) as store:
        store.write([run(ANN), keyframe(ANN, 0)])
        with pytest.raises(ValueError, match=r"bob-0002 is not in the file; its SaveRun must come first"):
            store.write([keyframe(ANN, 1), keyframe(BOB, 0)])
        assert [k.keyframe_key.id for k in store.load().keyframes] == [0]


def test_another_thread_may_write(path):
    with MapStore.open(path) as store:
        thread = threading.Thread(target=store.write, args=(small_map(),))
        thread.start()
        thread.join()
        assert len(store.load().keyframes) == 40


@pytest.mark.long
def test_a_map_has_one_writer_and_any_number_of_readers(path):
    with MapStore.open(path) as store:
        store.write(small_map())
        with pytest.raises(StoreError, match="another edge uses this map"):
            MapStore.open(path)
        assert keyframes_for_a_reader(path) == 40
        store.write([keyframe(ANN, 20)])
        assert keyframes_for_a_reader(path) == 41
    with MapStore.read(path) as reader, pytest.raises(StoreError, match="opened for reading"):
        reader.write([])
    MapStore.open(path).close()


def keyframes_for_a_reader(path) -> int:
    """In a process of its own."""
    code = (
        "import sys; from pathlib import Path; from share.store.map_store import MapStore\n"
        "print(len(MapStore.read(Path(sys.argv[1])).load().keyframes))"
    )
    return int(
        subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, check=True).stdout
    )


def test_other_files_are_refused_and_left_unchanged(tmp_path):
    text, other = tmp_path / "notes.txt", tmp_path / "browser.sqlite"
    text.write_text("SQLite is nice" * 1000)
    with sqlite3.connect(other) as connection:
        connection.execute("CREATE TABLE bookmarks(url TEXT)")
    connection.close()
    for path in (text, other):
        before = path.read_bytes()
        for how in (MapStore.open, MapStore.read):
            with pytest.raises(UsageError, match="is not a SHARE map and was left unchanged"):
                how(path)
        assert path.read_bytes() == before
        assert not is_map(path)
    with pytest.raises(UsageError, match="is a folder"):
        MapStore.open(tmp_path)
    with pytest.raises(UsageError, match="cannot be made there"):
        MapStore.open(text / "room.sqlite")


# ---------------------------------------------------------------- schemas


@pytest.mark.parametrize(
    ("number", "line"),
    [
        (
            schema.SCHEMA + 1,
            rf"made by a newer SHARE \(schema {schema.SCHEMA + 1}, this one reads {schema.SCHEMA}\); use",
        ),
        (2, r"made before SHARE 0.1.0 \(schema 2\), and no release reads it; give another file"),
    ],
)
def test_a_map_of_another_schema_is_refused_and_left_unchanged(path, number, line):
    with MapStore.open(path) as store:
        store.write(small_map())
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("DELETE FROM about WHERE name = 'schema'")
    insert(connection, "about", ("schema", str(number)))
    connection.close()
    before = path.read_bytes()
    for opening in (MapStore.open, MapStore.read):
        with pytest.raises(UsageError, match=line):
            opening(path)
    assert path.read_bytes() == before
    assert files(path) == ["room.sqlite", "room.sqlite.lock"]


# ---------------------------------------------------------------- the disk


def test_a_full_disk_keeps_nothing_half_and_recovers(path):
    """No file of this process may grow beyond a limit for a while."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with MapStore.open(path) as store:
        store.write([run(ANN), *(keyframe(ANN, i, 500) for i in range(3))])
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
        try:
            with pytest.raises(StoreError, match=r"room\.sqlite: the map cannot be written: "):
                store.write([keyframe(ANN, i, 500) for i in range(3, 20)])
            assert [k.keyframe_key.id for k in store.load().keyframes] == [0, 1, 2]
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, before)
        store.write([keyframe(ANN, i, 500) for i in range(3, 20)])
    assert [k.keyframe_key.id for k in reopened(path).keyframes] == list(range(20))


@pytest.mark.long
@pytest.mark.parametrize("killed", [False, True], ids=["closed", "killed"])
def test_a_read_only_map_is_opened_for_reading(killed):
    """As a user other than root, who may write everything."""
    folder = Path(tempfile.mkdtemp())
    path = folder / "room.sqlite"
    try:
        store = MapStore.open(path)
        store.write(small_map())
        if killed:  # its log is still there
            for name in os.listdir(folder):
                shutil.copyfile(folder / name, folder / name.replace("room", "copy"))
            path = folder / "copy.sqlite"
        store.close()
        for name in os.listdir(folder):
            (folder / name).chmod(0o444)
        folder.chmod(0o555)
        code = (
            "import os, sys; from pathlib import Path; from share.store.map_store import MapStore\n"
            "if os.geteuid() == 0: os.setuid(65534)\n"
            "store = MapStore.open(Path(sys.argv[1]))\n"
            "print(len(store.load().keyframes), store.writable, store.read_only_reason)"
        )
        done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
        assert (done.stdout, done.stderr) == ("40 False the file is read-only\n", "")
    finally:
        folder.chmod(0o755)
        shutil.rmtree(folder)


@pytest.mark.long
def test_the_file_stays_bounded_when_keyframes_are_removed(path):
    with MapStore.open(path) as store:
        store.write([run(ANN)])
        sizes = []
        for start in range(0, 600, 20):
            batch = [keyframe(ANN, i, 500) for i in range(start, start + 20)]
            store.write(
                [*batch, RemoveKeyframes(tuple(KeyframeKey(ANN, i) for i in range(start - 60, start - 40)))]
            )
            sizes.append(sum(f.stat().st_size for f in path.parent.iterdir()))
        assert len(store.load().keyframes) == 60
    assert max(sizes[10:]) < 1.1 * max(sizes[:10])
    assert path.stat().st_size < 1.5 * 80 * 27_000


def test_keyframes_of_an_earlier_wire_version_that_have_not_changed_are_read(path, monkeypatch):
    with monkeypatch.context() as then:
        then.setattr(codec, "WIRE_VERSION", 3)
        with MapStore.open(path) as store:
            store.write(small_map())
            before = as_values(store.load())
    assert as_values(reopened(path)) == before
    path.unlink()
    monkeypatch.setattr(codec, "WIRE_VERSION", 99)
    with MapStore.open(path) as store:
        store.write(small_map())
    monkeypatch.undo()
    with pytest.raises(StoreError, match=r"have wire version 99, this SHARE reads \d+: use the SHARE that"):
        reopened(path)


@pytest.mark.parametrize("end", ["-wal", "-shm"])
@pytest.mark.parametrize("kind", [*KINDS, "link"])
@pytest.mark.parametrize("made", [True, False])
def test_side_files_of_a_map_must_be_regular_files(path, end, kind, made):
    """SQLite would open a pipe, and wait or write there."""
    if made:
        with MapStore.open(path) as store:
            store.write(small_map())
    beside = path.with_name(path.name + end)
    if kind == "link":
        beside.symlink_to(path.parent / "elsewhere")
    else:
        special(beside, kind)
    with pytest.raises(UsageError, match=f"sqlite{end}: (is a link|cannot be the (log|index) of)"):
        MapStore.open(path)
    assert not (path.parent / "elsewhere").exists()
    beside.rmdir() if kind == "folder" else beside.unlink()
    assert reopened(path) is not None


@pytest.mark.parametrize("code", [errno.EMFILE, errno.EACCES])
@pytest.mark.parametrize("end", ["-wal", "-shm", ".lock"])
def test_a_side_file_that_cannot_be_opened_is_not_to_be_removed(path, monkeypatch, code, end):
    """The log had all keyframes."""
    with MapStore.open(path) as store:
        store.write(small_map())
        copy = path.with_name("killed.sqlite")
        for side in ("", "-wal", "-shm"):
            shutil.copy(path.with_name(path.name + side), copy.with_name(copy.name + side))
        copy.with_name(copy.name + ".lock").touch()
    open_file = os.open

    def fails(name, *arguments, **more):
        if str(name).endswith(end):
            raise OSError(code, os.strerror(code), str(name))
        return open_file(name, *arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", fails)
        with pytest.raises((UsageError, StoreError), match=rf"{end}: .*{os.strerror(code)}$"):
            MapStore.open(copy)
    assert len(reopened(copy).keyframes) == 40


LIMITED = """
import resource, sys
from pathlib import Path
from helpers.map_changes import small_map
from share.errors import StoreError
from share.store.map_store import MapStore
path, limit = Path(sys.argv[1]), int(sys.argv[2])
store = MapStore.open(path) if limit > 50_000 else None
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
try:
    store = store or MapStore.open(path)
    for _ in range(2000):
        store.write(small_map())
except StoreError as error:
    print(error)
"""


@pytest.mark.long
@pytest.mark.parametrize("limit", [1_000, 10_000, 40_000, 100_000, 300_000])
def test_a_file_size_limit_is_named(path, limit):
    """SQLite reports "disk I/O error", for the file, the log or the index."""
    here = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, path, str(limit)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(here), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    assert "may not grow beyond the file size limit of this process" in done.stdout, done.stdout
    assert done.stdout.endswith("; raise it (ulimit -f) and start again\n")


def test_one_pose_beyond_all_measure_costs_itself(path):
    """And no run, no map: what an agent has sent must not cost others theirs."""
    *changes, solved = small_map()
    T = solved.T_map_body.copy()
    T[1, 0, 3] = 2e5
    with MapStore.open(path) as store:
        store.write([*changes, replace(solved, T_map_body=T)])
    kept = reopened(path)
    assert kept.problems == ()
    assert kept.poses is not None
    assert set(kept.poses.keys) == {*solved.keys} - {solved.keys[1]}
    assert len(restored_runs(kept, 0.05)) == len(kept.runs)


def test_a_run_beyond_all_measure_waits_for_a_solution_and_others_have_their_place(path):
    with MapStore.open(path) as store:
        store.write([run(ANN), run(BOB), keyframe(ANN, 0), keyframe(BOB, 0)])
    kept = reopened(path)
    T_map_body, T_odom_body = np.eye(4), np.eye(4)
    T_map_body[0, 3], T_odom_body[0, 3] = 9.9e4, -5e3
    first = kept.keyframes[0]
    far = replace(first, keyframe=replace(first.keyframe, T_odom_body=T_odom_body))
    poses = SavePoses((far.keyframe_key,), T_map_body[None], (f"{ANN}/0",))
    with_far = replace(kept, keyframes=(far, *kept.keyframes[1:]), poses=poses)
    ann, bob = restored_runs(with_far, 0.05)
    assert ann.last_correction_event is None
    assert ann.next_keyframe == bob.next_keyframe == 1
    assert bob.last_correction_event is not None


def test_a_map_with_another_name_is_refused(path):
    with MapStore.open(path) as store:
        store.write(small_map())
    other = path.with_name("other.sqlite")
    os.link(path, other)
    for name in (path, other):
        with pytest.raises(StoreError, match=r"has 2 names \(hard links\)"):
            MapStore.open(name)
    other.unlink()
    assert len(reopened(path).keyframes) > 0


def test_a_full_disk_is_said_when_a_map_is_opened(path, monkeypatch):
    """SQLite says of it "disk I/O error": a person would look for a broken disk."""
    MapStore.open(path).close()

    def fails(connection, now_s):
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR
        monkeypatch.setattr(tempfile, "TemporaryFile", full)
        raise error

    def full(dir):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(loading, "convert", fails)
    with pytest.raises(StoreError, match="the map cannot be opened: No space left on device"):
        MapStore.open(path)
