"""Sessions: SESSION/NAME opens an agent's recording with its truth and calibration."""

import numpy as np
import pytest
from helpers.recordings import make_euroc, make_tum

from share.errors import ConfigError, ShareError, UsageError
from share.recordings.convert import to_mcap
from share.recordings.session import read_session
from share.runtime.source import open_source
from share.types import AgentKind

YAML = """schema: 1
provenance: {generator: a test}
agents:
  ann: {kind: ar, sensors: stereo+imu, rate_hz: 20.0, clock_offset_ns: 123456789}
  rob: {kind: robot, sensors: rgbd}
"""
CHAIN = """    calibration:
      cam0: {resolution: [64, 48], intrinsics: [99, 99, 32, 24]}
      depth:
        resolution: [64, 48]
        intrinsics: [60, 60, 32, 24]
        T_depth_cam0: [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


@pytest.fixture
def session(tmp_path):
    folder = tmp_path / "session"
    for name, make in (("ann", make_euroc), ("rob", make_tum)):
        to_mcap(open_source(str(make(tmp_path / name))), folder / f"{name}.mcap", None, lambda done: None)
    (folder / "truth").mkdir()
    (folder / "ann.truth.tum").rename(folder / "truth" / "ann.tum")
    (folder / "session.yaml").write_text(YAML)
    return folder


def test_agents_open_by_name(session):
    ann, rob = (open_source(f"{session}/{name}") for name in ("ann", "rob"))
    assert (ann.name, ann.rig.kind, rob.rig.kind) == ("ann", "stereo+imu", "rgbd")
    assert len(ann.truth().stamps_ns) == 6
    read = read_session(session)
    assert read.agents["ann"].kind is AgentKind.AR
    assert read.agents["ann"].clock_offset_ns == 123456789
    assert read.provenance == {"generator": "a test"}


def test_the_sessions_calibration_overrides_the_recordings(session):
    assert open_source(f"{session}/rob").rig.cam0.fx == 50
    text = YAML.replace("  rob: {kind: robot, sensors: rgbd}\n", "  rob:\n    kind: robot\n" + CHAIN)
    (session / "session.yaml").write_text(text)
    rig = open_source(f"{session}/rob").rig
    assert rig.cam0.fx == 99
    np.testing.assert_allclose(rig.T_depth_cam0[0, 3], 0.5)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("schema: 1", "schema: 2", "schema 2 is not known; this SHARE reads schema 1"),
        ("schema: 1\n", "", "key 'schema' is missing"),
        ("kind: ar", "kind: cat", "agents: ann: kind 'cat' is not known; known: ar, robot"),
        ("kind: ar, ", "", "ann: key 'kind' is missing"),
        ("sensors: rgbd", "sensor: rgbd", "rob: unknown key 'sensor'; known: kind, sensors"),
        ("123456789", "0.5", "clock_offset_ns: expected whole nanoseconds, found 0.5"),
    ],
)
def test_an_invalid_session_yaml_is_refused_by_its_key(session, old, new, complaint):
    file = session / "session.yaml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=rf"session\.yaml.*{complaint}"):
        open_source(f"{session}/ann")


def test_unknown_and_missing_agents_are_refused(session):
    with pytest.raises(UsageError, match="no agent 'eve'; agents: ann, rob"):
        open_source(f"{session}/eve")
    (session / "rob.mcap").unlink()
    with pytest.raises(UsageError, match=r"rob\.mcap: no such file, although"):
        open_source(f"{session}/rob")
    with pytest.raises(ShareError, match="is a session; name one of its agents"):
        open_source(str(session))
    with pytest.raises(UsageError, match=r"/ann: is one agent of a session; give the session: "):
        read_session(session / "ann")
