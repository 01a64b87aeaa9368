"""A session is whole and repeatable, or it is not there."""

import multiprocessing
import os
import time

import numpy as np
import pytest

from share.core.measurement import CAM0, CAM1, DEPTH
from share.emulate.plain import session as session_module
from share.emulate.plain.agents import AGENTS, RATE_HZ
from share.emulate.plain.session import cached_session, default_cache, make_session
from share.errors import ShareError, UsageError
from share.io.session import read_session
from share.io.source import open_source

SECONDS = 1.0


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Made by two spawned workers."""
    return make_session(tmp_path_factory.mktemp("made") / "room", SECONDS, seed=5, workers=2)


def images(path):
    """Decoded images by stream, and their stamps."""
    out: dict[str, list] = {}
    for m in open_source(str(path)).measurements():
        out.setdefault(m.stream, []).append((m.stamp_ns, m.payload.load()))
    return {k: (np.array([s for s, _ in v]), [i for _, i in v]) for k, v in out.items()}


def test_it_is_whole(session):
    names = sorted(str(p.relative_to(session)) for p in session.rglob("*") if p.is_file())
    wanted = [f"{a.name}.mcap" for a in AGENTS] + [f"truth/{a.name}.tum" for a in AGENTS] + ["session.yaml"]
    assert names == sorted(wanted)
    assert os.listdir(session.parent) == [session.name]  # nothing half-made beside it
    described = read_session(session)
    assert {n: str(a.kind) for n, a in described.agents.items()} == {
        "ar1": "ar",
        "ar2": "ar",
        "robot": "robot",
    }
    assert described.provenance["seed"] == 5
    for agent in AGENTS:
        assert described.agents[agent.name].calibration.rig.kind == agent.rig.kind


@pytest.mark.parametrize("agent", AGENTS, ids=lambda a: a.name)
def test_recordings_read_back(session, agent):
    source = open_source(str(session / agent.name))  # SESSION/NAME
    assert source.rig.kind == agent.rig.kind
    assert source.rig.cam0 == agent.rig.cam0
    assert source.rig.baseline == agent.rig.baseline
    found = images(session / f"{agent.name}.mcap")
    second = CAM1 if agent.rig.cam1 else DEPTH
    assert set(found) == {CAM0, second}
    truth = source.truth()
    assert truth is not None
    for stamps, pictures in found.values():
        assert np.array_equal(stamps, truth.stamps_ns)
        assert len(pictures) == SECONDS * RATE_HZ
        assert all(p.shape == (480, 640) for p in pictures)
    assert found[CAM0][1][0].std() > 15
    if second == DEPTH:
        depth = found[DEPTH][1][0]
        assert depth.dtype == np.float32 and 0.5 < np.median(depth[depth > 0]) < 9


def test_same_seed_same_pictures_however_many_workers(session, tmp_path):
    again = make_session(tmp_path / "again", SECONDS, seed=5, workers=1)
    for agent in AGENTS:
        truth = f"truth/{agent.name}.tum"
        assert (again / truth).read_bytes() == (session / truth).read_bytes()
        one, two = images(session / f"{agent.name}.mcap"), images(again / f"{agent.name}.mcap")
        for stream in one:
            assert all(np.array_equal(a, b) for a, b in zip(one[stream][1], two[stream][1], strict=True))


def test_the_cache_makes_once_and_tells_progress(tmp_path, monkeypatch):
    seen = []
    first = cached_session(tmp_path, SECONDS, 1, 2, lambda done, total: seen.append((done, total)))
    assert seen[-1] == (60, 60)
    stamp = (first / "session.yaml").stat().st_mtime_ns
    assert cached_session(tmp_path, SECONDS, 1, 2, lambda *_: pytest.fail("made again")) == first
    assert (first / "session.yaml").stat().st_mtime_ns == stamp
    monkeypatch.setattr(session_module, "GENERATOR_VERSION", 10**6)
    monkeypatch.setattr(session_module, "_make", lambda out, *_: out.mkdir())
    assert cached_session(tmp_path, SECONDS, 1) != first


def test_default_cache_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache() == tmp_path / "share"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    assert default_cache().parts[-2:] == (".cache", "share")


def test_a_worker_that_fails_is_heard(tmp_path):
    """A file where the recording's folder should be: the worker's own error, in one line."""
    from share.emulate.plain.parallel import record_all

    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="not a folder"):
        record_all(tmp_path / "file", 20, 0, 1, lambda *_: None)


def test_a_failure_leaves_nothing_that_looks_whole(tmp_path):
    def fail(done, total):
        if done > 3:
            raise OSError(28, "No space left on device")

    with pytest.raises(ShareError, match="No space left"):
        make_session(tmp_path / "room", SECONDS, 0, 2, fail)
    assert os.listdir(tmp_path) == []


def test_what_a_killed_process_left_is_replaced(tmp_path):
    """Killed hard in the middle: nothing under the name; the next call makes it whole."""
    process = multiprocessing.get_context("spawn").Process(
        target=make_session, args=(tmp_path / "room", 60.0, 0, 1)
    )
    process.start()
    deadline = time.monotonic() + 30
    while not list(tmp_path.glob(".room.partial-*/*.mcap.part")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.join()
    assert [n.startswith(".room.partial-") for n in os.listdir(tmp_path)] == [True]
    make_session(tmp_path / "room", SECONDS, 0, 2)
    assert os.listdir(tmp_path) == ["room"]


def test_wrong_use_is_said(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(UsageError, match="exists already"):
        make_session(tmp_path / "taken", SECONDS)
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="not a folder"):
        make_session(tmp_path / "file" / "room", SECONDS)
    for seconds in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(UsageError, match="1 to 3600"):
            make_session(tmp_path / "room", seconds)
    with pytest.raises(UsageError, match="negative"):
        make_session(tmp_path / "room", SECONDS, seed=-1)
