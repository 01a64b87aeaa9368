"""An edge and agents in one process, by the library: a shared map, poses as they come, one's own camera."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from share import Agent, Config, Edge, Pose, Rig, ShareError, load_calibration, open_recording
from share.recordings.trajectory import read_tum

NOBODY = "tcp://127.0.0.1:1"


@pytest.fixture
def quick() -> Config:
    """An agent that does not wait for an edge at the end."""
    from share.config import load_config

    return load_config("agent: {finish_s: 0.1, error_model: ''}")


@pytest.mark.long
def test_two_agents_share_a_map(plain_session, tmp_path):
    events = []
    with Edge("tcp://127.0.0.1:0", policy="covins-g", out=tmp_path / "edge", on_event=events.append) as edge:
        agents = [Agent(plain_session / name, name, edge.endpoint) for name in ("ar1", "ar2")]
        for agent in agents:
            agent.start()
        poses = {agent: list(agent.poses()) for agent in agents}
        reports = [agent.wait() for agent in agents]
        assert set(edge.report()["agents"]) == {"ar1", "ar2"}
        in_the_map = _poses_in_the_map(plain_session / "ar1", edge.endpoint)
        report = edge.stop()
    assert all(len(poses[agent]) == 45 for agent in agents)
    assert [one["frames"] for one in reports] == [45, 45]
    assert all(one["protocol"]["unacknowledged"] == 0 for one in reports)
    assert report["agents"]["ar1"]["keyframes"] == reports[0]["protocol"]["sent"] > 0
    assert {"agent joined", "left"} <= {event["event"] for event in events}
    assert (tmp_path / "edge" / "edge.json").exists()
    last = in_the_map[-1]
    assert last.map_id
    assert np.linalg.eigvalsh(last.map_cov).min() > 0
    assert last.age_ms > 0


def _poses_in_the_map(recording: Path, endpoint: str) -> list[Pose]:
    """Play a recording again and again until the edge has said where it is in the map: the mapper's process
    may need longer to start than a recording of 3 s takes."""
    for n in range(10):
        with Agent(recording, f"again{n}", endpoint) as agent:
            poses = [pose for pose in agent.poses() if pose.T_map_body is not None]
        if poses:
            return poses
    raise AssertionError("no correction in 30 s of recordings")


@pytest.mark.long
def test_poses_are_those_of_its_files(plain_session, tmp_path, quick):
    with Agent(plain_session / "ar1", "ann", NOBODY, config=quick, out=tmp_path) as agent:
        poses = list(agent.poses())
    written = read_tum(tmp_path / "odom.tum")
    assert [pose.stamp_ns for pose in poses] == written.stamps_ns.tolist()
    assert np.allclose([pose.position for pose in poses], written.T[:, :3, 3], atol=1e-8)
    assert agent.pose is poses[-1] and agent.state == "OK"
    assert list(agent.poses()) == []


@pytest.mark.long
def test_own_camera_is_tracked_live(plain_session, quick):
    """At half the recorded pace, as fast as this machine may: nothing is to be dropped."""
    recording = open_recording(plain_session / "ar1", frames=slice(0, 20))
    agent = Agent(recording.rig, "ann", NOBODY, "robot", rate_hz=15, config=quick)
    with agent:
        for frame in recording:
            for sample in zip(frame.imu.stamps_ns, frame.imu.gyro, frame.imu.accel, strict=True):
                agent.feed_imu(*sample)
            agent.feed_images(frame.stamp_ns, frame.image0, frame.image1)
            time.sleep(0.13)
        report = agent.stop()
    assert report["camera"]["streams"]["cam0"]["samples"] == 20
    assert agent.pose is not None and report["tracked"] >= 12
    stamps = [frame.stamp_ns for frame in recording]
    assert agent.pose.stamp_ns in stamps[-3:]


def test_wrong_use_is_one_clear_line(plain_session, tmp_path, quick):
    rig: Rig = load_calibration("calib/d435i")
    ar1 = plain_session / "ar1"
    for arguments, options, what in [
        ((ar1, "a/b", NOBODY), {}, "name 'a/b': use"),
        ((ar1, "ann", "nowhere"), {}, "'nowhere' is not an address"),
        ((ar1, "ann", NOBODY, "drone"), {}, r"kind 'drone': use ar \(headset\) or robot"),
        ((ar1, "ann", NOBODY), {"keys": tmp_path}, "keys needs server_key"),
        ((tmp_path / "missing", "ann", NOBODY), {}, "no such file"),
        ((rig, "ann", "tcp://192.0.2.1:5555"), {}, "links to other machines need keys"),
    ]:
        with pytest.raises(ShareError, match=what):
            Agent(*arguments, config=quick, **options)
    agent = Agent(ar1, "ann", NOBODY, config=quick)
    with pytest.raises(ShareError, match="this agent plays a recording"):
        agent.feed_imu(0, [0, 0, 0], [0, 0, 9.81])
    assert agent.stop() == {}
    with pytest.raises(ShareError, match="--poses nowhere: expected udp://"):
        Agent(ar1, "ann", NOBODY, config=quick, poses="nowhere").start()
    with pytest.raises(ShareError, match="policy 'best' is not known; known: share, "):
        Edge("tcp://127.0.0.1:0", policy="best")
    with pytest.raises(ShareError, match="map_file: policy streamed builds no map"):
        Edge("tcp://127.0.0.1:0", policy="streamed", map_file=tmp_path / "m.sqlite")


def test_an_address_in_use_is_refused_and_nothing_stays(tmp_path):
    with Edge("tcp://127.0.0.1:0") as edge, pytest.raises(ShareError, match="the port is in use"):
        Edge(edge.endpoint)


@pytest.mark.long
def test_a_program_without_a_main_guard_is_told_so(tmp_path):
    """Its mapper imports it anew; there, the edge refuses to start another."""
    program = tmp_path / "edge.py"
    program.write_text(
        "import time\nfrom share import Edge\nedge = Edge('tcp://127.0.0.1:0')\n"
        "edge.start()\ntime.sleep(4)\nedge.stop()\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, program], capture_output=True, text=True, timeout=60, cwd=root, check=False,
        env={"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert 'start an edge under `if __name__ == "__main__":`' in done.stderr
