"""The files of an agent's run, and which agents are scored together."""

from __future__ import annotations

import json

import numpy as np

from share.lab.evaluate.scoring import AgentScore, largest_map_ate
from share.metrics.ate import ate
from share.metrics.frame_log import RunLog
from share.recordings.trajectory import Trajectory, format_tum, read_tum
from share.runtime.run_files import AgentFiles


def test_a_map_after_the_last_pose_is_not_that_of_the_file(tmp_path):
    files = AgentFiles(tmp_path, print)
    files.write_odom_pose(1, np.eye(4))
    files.write_map_pose(1, np.eye(4), "ann-1/0")
    files.write_map_pose(2, np.eye(4), "bob-1/0")
    files.finish(RunLog(), {"protocol": {"map_id": "eve-1/0"}})
    assert json.loads((tmp_path / "report.json").read_text())["map_tum_id"] == "bob-1/0"
    assert len(read_tum(tmp_path / "map.tum").stamps_ns) == 1


def test_an_edge_that_moves_an_agent_from_map_to_map_does_not_fill_the_folder(tmp_path):
    said = []
    files = AgentFiles(tmp_path, said.append)
    for k in range(300):
        files.write_odom_pose(k, np.eye(4))
        files.write_map_pose(k, np.eye(4), f"map {k}")
    files.finish(RunLog(), {})
    assert len(list(tmp_path.glob("map.previous-*"))) == 100
    assert said == ["moved between more than 100 maps: poses in further ones are not kept"]
    assert len(read_tum(tmp_path / "odom.tum").stamps_ns) == 300
    assert read_tum(tmp_path / "map.tum").stamps_ns.tolist() == [299]


def test_agents_are_scored_by_the_map_of_their_file(tmp_path):
    stamps = np.arange(50) * 10**8
    T = np.tile(np.eye(4), (50, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = np.linspace(0, 5, 50), np.sin(np.linspace(0, 5, 50))
    truth = Trajectory(stamps, T)
    elsewhere = Trajectory(stamps, T @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    elsewhere.T[:, 0, 3] += 8
    (tmp_path / "x.tum").write_text(format_tum(elsewhere))

    def agent(map_tum: str, reported: Trajectory) -> AgentScore:
        report = {"map_tum_id": map_tum, "protocol": {"map_id": "joined/0"}}
        return AgentScore(report, ate(reported, truth), reported, truth)

    found = largest_map_ate(
        {"ann": agent("a/0", truth), "bob": agent("a/0", truth), "late": agent("b/0", elsewhere)}
    )
    assert found is not None
    assert set(found.agents) == {"ann", "bob"}
    assert found.joint.rmse < 1e-9
    alone = {"ann": agent("a/0", truth)}
    assert largest_map_ate(alone | {"late": agent("b/0", elsewhere)}) is None  # each in a map of its own
    assert largest_map_ate(alone) is not None  # who plays alone is all there are
