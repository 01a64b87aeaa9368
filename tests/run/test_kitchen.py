"""The real kitchen: 500 RGB-D frames of a Kinect, whose truth is itself good to 3 or 4 cm."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from helpers.children import Child, start_agent, start_edge

from share.metrics.ate import ate, joint_ate
from share.recordings.trajectory import read_tum

PARTS = {"ann": "0:250", "bob": "200:500"}  # that overlap: their maps join whichever keyframe comes first


@pytest.fixture(scope="module")
def kitchen(shared_data) -> Path:
    return shared_data / "real" / "redkitchen_0000_0499"


@pytest.fixture(scope="module")
def tracked(kitchen, tmp_path_factory) -> dict[str, bytes]:
    """What `share track` says of the whole, and of each agent's part, of the first twice."""
    folder = tmp_path_factory.mktemp("track")
    ranges = {"whole": ":", "again": PARTS["ann"], **PARTS}
    running = {
        name: Child(
            folder / f"{name}.log", "track", str(kitchen), "--frames", frames, "--out", str(folder / name)
        )
        for name, frames in ranges.items()
    }
    assert [child.wait(120) for child in running.values()] == [0] * 4
    print({name: child.said.splitlines()[-1] for name, child in running.items()})
    return {name: (folder / name).read_bytes() for name in ranges}


@pytest.mark.long
def test_every_frame_is_tracked_to_five_centimetres(kitchen, tracked, tmp_path):
    (tmp_path / "T.tum").write_bytes(tracked["whole"])
    estimate, truth = read_tum(tmp_path / "T.tum"), read_tum(kitchen / "groundtruth.txt")
    error = ate(estimate, truth)
    print(f"ATE {100 * error.rmse:.2f} cm over {error.n} causal poses, SE3 alignment")
    assert error.n == 500
    assert error.rmse <= 0.05


def test_the_same_recording_twice_gives_the_same_bytes(tracked):
    assert tracked["ann"] == tracked["again"]


def _events(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "edge" / "events.jsonl").read_text().splitlines()]


@pytest.mark.long
def test_two_agents_end_in_one_map(kitchen, tracked, tmp_path):
    edge, address = start_edge(tmp_path)
    agents = {
        name: start_agent(tmp_path, name, kitchen, address, "--frames", frames)
        for name, frames in PARTS.items()
    }
    assert [agent.wait(90) for agent in agents.values()] == [0, 0]
    assert edge.interrupt() == 0
    truth = read_tum(kitchen / "groundtruth.txt")
    report = json.loads((tmp_path / "edge" / "edge.json").read_text())
    shared = {agent["map_id"] for agent in report["agents"].values()}
    assert len(shared) == 1
    own_reports = [json.loads((tmp_path / name / "report.json").read_text()) for name in agents]
    shown = {own["protocol"]["map_id"] for own in own_reports}
    assert shown == shared, "an agent left before it was shown the map that it was in"
    joint = joint_ate({name: (read_tum(tmp_path / name / "map.tum"), truth) for name in agents})
    print(f"joint ATE {100 * joint.joint.rmse:.2f} cm over {joint.joint.n} causal poses, one alignment")
    assert joint.joint.rmse <= 0.06
    assert joint.joint.n > 250  # of 500: from the moment on that the map was shared
    corrections = [event for event in _events(tmp_path) if event["event"] == "correction"]
    assert len(corrections) > 3
    assert all(event["reason"] for event in _events(tmp_path))
    for name in agents:
        assert (tmp_path / name / "odom.tum").read_bytes() == tracked[name]
        own = json.loads((tmp_path / name / "report.json").read_text())
        # the last may come when the agent has said goodbye
        assert 0 <= sum(event["agent"] == name for event in corrections) - own["corrections"] <= 1
        assert own["corrections"] >= 1
        assert report["agents"][name]["keyframes"] == own["sent"] <= own["keyframes"]
        assert own["corrected_ms"]["n"] > 0
        clock = own["clock"]  # of one machine with itself: the truth is 0
        estimate_ms = own["protocol"]["clock_offset_ns"] / 1e6
        assert abs(estimate_ms) <= clock["asymmetry_ms"] + 1e-3  # however long either side waits for a core
        assert clock["is_reliable"] == (clock["uncertainty_ms"] <= 1.0) == (clock["offset_ms"] is not None)
        assert "clock of the edge: " in agents[name].said


@pytest.mark.long
def test_an_edge_that_is_killed_and_started_again(kitchen, tracked, tmp_path):
    """Odometry does not notice; the new edge is rejoined, given the map again, and joins it again."""
    edge, address = start_edge(tmp_path)
    agents = {
        name: start_agent(tmp_path, name, kitchen, address, "--frames", frames)
        for name, frames in PARTS.items()
    }
    for agent in agents.values():
        agent.wait_for("connected to the edge")
    time.sleep(0.5)  # the second edge has to have the greater part of the recording
    edge.kill()
    time.sleep(0.5)
    edge, _ = start_edge(tmp_path, address)
    for agent in agents.values():
        agent.wait_for("the edge has restarted")
    assert [agent.wait(90) for agent in agents.values()] == [0, 0]
    edge.wait_for(r"(?s)listening on.*listening on.*maps merged")  # on a busy machine, after they have left
    assert edge.interrupt() == 0
    report = json.loads((tmp_path / "edge" / "edge.json").read_text())
    assert len(report["maps"]) == 1
    for name in agents:
        assert (tmp_path / name / "odom.tum").read_bytes() == tracked[name]
        own = json.loads((tmp_path / name / "report.json").read_text())
        assert report["agents"][name]["keyframes"] == own["sent"] <= own["keyframes"]
        reported = [
            e["map_id"] for e in _events(tmp_path) if (e["event"], e["agent"]) == ("correction", name)
        ]
        assert own["protocol"]["map_id"] in reported[-2:]  # the last may come when the agent has said goodbye
        assert own["protocol"]["edge_sessions"] == 2
