"""Policy `streamed` as processes: agents that stream, an edge that tracks."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from helpers.children import SHARE, Child, start_agent

from share.config import Config
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.session import make_session
from share.lab.emulate.small_pictures import profile_of_mode
from share.recordings.trajectory import format_tum
from share.runtime.offline_tracking import track
from share.runtime.source import open_source

FRAMES, LONGER = 45, 120
ROOMY = "stream: {window: 60}\n"  # nothing is dropped, however busy this machine is


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "roomy.yaml"
    path.write_text(ROOMY)
    return path


def edge_that_tracks(folder: Path, *more: str) -> tuple[Child, str]:
    where = ("--bind", "tcp://127.0.0.1:0", "--out", str(folder / "edge"))
    edge = Child(folder / "edge.log", "edge", "--policy", "streamed", *where, *more)
    return edge, edge.wait_for(r"listening on (tcp://\S+?), policy streamed")[1]


def report_of(folder: Path, name: str) -> dict:
    return json.loads((folder / name / "report.json").read_text())


def tracked_here(recording: Path) -> str:
    """What `share track` makes of it, as a file."""
    return format_tum(track(open_source(str(recording)), Config(), lambda done: None).trajectory)


@pytest.mark.parametrize(
    "link", [(), pytest.param(("--link", "wifi5"), marks=pytest.mark.slow)], ids=["loopback", "wifi5"]
)
def test_poses_are_those_of_share_track(
    plain_session: Path, tmp_path: Path, config: Path, link: tuple[str, ...]
) -> None:
    settings = ("--config", str(config))
    edge, address = edge_that_tracks(tmp_path, *settings)
    more = ("--streamed", *settings, *link)
    who = {"ann": "ar1", "rob": "robot"}  # stereo, and depth
    agents = {
        name: start_agent(tmp_path, name, plain_session / source, address, *more)
        for name, source in who.items()
    }
    assert [agent.wait(60) for agent in agents.values()] == [0, 0], agents["ann"].said
    assert edge.interrupt() == 0
    reported = json.loads((tmp_path / "edge" / "edge.json").read_text())
    assert "maps" not in reported
    for name, source in who.items():
        report = report_of(tmp_path, name)
        assert (report["frames"], report["untracked"]) == (FRAMES, 0)
        assert (tmp_path / name / "odom.tum").read_text() == tracked_here(plain_session / source)
        assert (tmp_path / name / "map.tum").read_text() == ""
        rows = (tmp_path / name / "latency.csv").read_text().splitlines()
        assert len(rows) == 1 + FRAMES
        assert report["track_ms"]["mean"] > (40 if link else 1)  # 616 kB at 150 Mbit/s take 34 ms
        assert report["protocol"]["poses"] == report["sent"] == 0
        of_edge = reported["agents"][name]
        assert (of_edge["frames_streamed"], of_edge["frames_tracked"]) == (FRAMES, FRAMES)
        assert of_edge["frames_dropped"] == of_edge["keyframes"] == 0
        assert of_edge["bytes_up"] > FRAMES * 2 * 640 * 480


def trackers_of(edge: Child) -> list[int]:
    """Its processes that track, the oldest first."""
    pids = Path(f"/proc/{edge.process.pid}/task").glob("*/children")
    children = sorted({int(pid) for path in pids for pid in path.read_text().split()})
    return [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def longer_recording(folder: Path) -> Path:
    """One on which the killed tracker is back long before the end: 1 s after its death, and its start."""
    profile = profile_of_mode("320x240@15")
    recipe = SessionRecipe("plain", ("ar1=walk:",), LONGER / 15, 18, profiles={"": profile})
    return make_session(recipe, folder / "session", workers=1) / "ar1"


@pytest.mark.long
def test_a_tracker_that_is_killed_costs_its_agent_only(tmp_path: Path, config: Path) -> None:
    recording = longer_recording(tmp_path)
    settings = ("--config", str(config))
    edge, address = edge_that_tracks(tmp_path, *settings)
    agents = [
        start_agent(tmp_path, name, recording, address, "--streamed", *settings) for name in ("ann", "bob")
    ]
    await_poses(*(tmp_path / name / "odom.tum.partial" for name in ("ann", "bob")))
    first = trackers_of(edge)
    assert len(first) == 2
    os.kill(first[0], signal.SIGKILL)
    assert [agent.wait(60) for agent in agents] == [0, 0]
    text = r"tracking lost: (\w+): its process was ended by SIGKILL; restarted in \d+ s; odometry"
    lost = edge.wait_for(text)
    assert edge.interrupt() == 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in first)
    hit, other = (lost[1], {"ann": "bob", "bob": "ann"}[lost[1]])
    assert (tmp_path / other / "odom.tum").read_text() == tracked_here(recording)
    assert report_of(tmp_path, other)["untracked"] == 0
    assert report_of(tmp_path, other)["segments"] == 1
    of_hit = report_of(tmp_path, hit)
    assert of_hit["frames"] + of_hit["untracked"] == LONGER
    assert of_hit["segments"] == 2
    assert of_hit["tracked"] > LONGER / 3
    reported = json.loads((tmp_path / "edge" / "edge.json").read_text())["agents"]
    assert reported[hit]["frames_dropped"] <= of_hit["untracked"]  # which counts answers that came late, too
    assert reported[other]["frames_dropped"] == 0


def await_poses(*files: Path) -> None:
    deadline = time.monotonic() + 30
    while not all(file.exists() and file.stat().st_size for file in files):
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.long
def test_an_agent_continues_when_its_edge_is_killed(plain_session: Path, tmp_path: Path) -> None:
    config = tmp_path / "quick.yaml"
    config.write_text("link: {silent_s: 1}\n")
    edge, address = edge_that_tracks(tmp_path)
    more = ("--streamed", "--config", str(config))
    agent = start_agent(tmp_path, "ann", plain_session / "ar1", address, *more)
    agent.wait_for("connected to the edge")
    edge.kill()
    assert agent.wait(60) == 0
    assert "the edge is silent; no tracking without the edge" in agent.said
    report = report_of(tmp_path, "ann")
    assert report["frames"] + report["untracked"] == FRAMES
    assert report["untracked"] > FRAMES / 2


@pytest.mark.long
def test_an_agent_beyond_the_capacity_is_refused(plain_session: Path, tmp_path: Path) -> None:
    edge, address = edge_that_tracks(tmp_path)
    tracks = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    assert tracks.wait(60) == 2
    assert tracks.said == (
        "share: the edge refuses 'ann': this edge tracks its agents (policy streamed): "
        "start the agent with --streamed\n"
    )
    edge.interrupt()
    maps = Child(tmp_path / "maps.log", "edge", "--bind", "tcp://127.0.0.1:0")
    address = maps.wait_for(r"listening on (tcp://\S+?),")[1]
    streams = start_agent(tmp_path, "bob", plain_session / "ar1", address, "--streamed")
    assert streams.wait(60) == 2
    assert streams.said == (
        "share: the edge refuses 'bob': this edge does not track agents: start it with --policy streamed, "
        "or the agent without --streamed\n"
    )
    maps.interrupt()


BAD = {
    "a map": (
        ("edge", "--policy", "streamed", "--map", "room.sqlite"),
        "--map: policy streamed builds no map; leave it out, or choose another policy",
    ),
    "an error to tell": (
        ("agent", "x", "--name=a", "--kind=ar", "--edge=tcp://127.0.0.1:1", "--streamed", "--true-error"),
        "--true-error does not go with --streamed, where the edge tracks; leave out one",
    ),
    "errors to tell": (
        ("demo", "--policy", "streamed", "--true-error", "--out", "out"),
        "--true-error does not go with --policy streamed, where the edge tracks; leave out one",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_conflicting_options_are_refused(what: str, tmp_path: Path) -> None:
    command, said = BAD[what]
    done = subprocess.run([*SHARE, *command], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, f"share: {said}\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_whole_demo(plain_cache: Path, tmp_path: Path) -> None:
    settings = ("--scene", "plain", "--seconds", "3", "--seed", "18", "--policy", "streamed")
    done = subprocess.run(
        [*SHARE, "demo", *settings, "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "XDG_CACHE_HOME": str(plain_cache)},
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "the edge tracked each agent alone; frames without an answer: ar1 " in done.stdout
    for name in ("ar1", "ar2", "robot"):
        report = report_of(tmp_path, name)
        assert report["frames"] + report["untracked"] == FRAMES
        assert report["tracked"] > FRAMES / 2
