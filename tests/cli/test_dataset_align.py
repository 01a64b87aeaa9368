"""`share dataset align` over an emulated room: clocks that know nothing of each other, bodies that sit askew,
holes, noise, another frame and rate; against what the emulator knows. And over real recordings."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.field_sim import FIRST, Watched, export, export_motive, offset_of, paths, reclocked, seen
from helpers.field_sim import RATE_HZ as MOCAP_HZ
from helpers.small_session import RATE_HZ, small_profile, small_recipe

from share.files.json_file import read_json
from share.geometry import se3
from share.lab.emulate.session import make_session
from share.lab.mocap.report import read_mounting
from share.metrics.ate import ate, joint_ate
from share.recordings.session import read_session
from share.recordings.trajectory import Trajectory, read_tum
from share.runtime.source import open_source

pytestmark = pytest.mark.long

SECONDS = 12.0
WATCHED = {
    "ann": Watched(se3.exp(np.array([0.3, -2.1, 0.7, 0.04, -0.09, 0.06])), 0, ((5.0, 5.3), (8.0, 9.5))),
    "bob": Watched(se3.exp(np.array([1.2, 0.4, -0.3, -0.08, 0.02, 0.1])), -123_456_789_012_345),
}
NOISE = (0.001, np.radians(0.2))


class Room:
    """The emulated session, its recordings by clocks of their own, and the motion capture's export."""

    def __init__(self, folder: Path) -> None:
        recipe = small_recipe(
            small_profile(folder), *(f"{name}=walk:" for name in WATCHED), seconds=SECONDS, seed=5
        )
        self.folder, self.session = folder, make_session(recipe, folder / "session", workers=1)
        self.paths = paths(recipe, folder / "room")
        for name, watched in WATCHED.items():
            reclocked(self.session / name, folder / f"{name}.mcap", watched.clock_ns)
        T = {name: seen(self.paths[name], w, NOISE, k) for k, (name, w) in enumerate(WATCHED.items())}
        export(folder / "vicon.csv", {"Headset1": T["ann"], "BOB": T["bob"]})
        export_motive(folder / "take.csv", {"Headset1": T["ann"], "BOB": T["bob"]})

    def truth(self, name: str, at: Trajectory) -> Trajectory:
        """What the emulator knows, at the stamps of a trajectory by the device's clock."""
        path = self.paths[name]
        true_ns = at.stamps_ns - WATCHED[name].clock_ns
        return at._replace(T=path.poses(np.clip(true_ns, path.start_ns, path.end_ns)))

    @property
    def recordings(self) -> list[str]:
        return [f"{name}={self.folder / name}.mcap" for name in WATCHED]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Room:
    return Room(tmp_path_factory.mktemp("field"))


@pytest.fixture
def made(share, room) -> Path:
    """Aligned once."""
    out = room.folder / "room1"
    if not out.exists():
        reported = ("--body", "ann=Headset1", "--kind", "bob=robot", "--json")
        done = share(
            "dataset",
            "align",
            *room.recordings,
            "--mocap",
            room.folder / "vicon.csv",
            *reported,
            "--out",
            out,
        )
        assert done.code == 0
        assert all("determines the mounting to" in line for line in done.err.splitlines())  # 12 s are few
        assert json.loads(done.out) == read_json(out / "align.json")
    return out


def test_offset_and_mounting_are_estimated(room, made):
    found = read_json(made / "align.json")
    for name, watched in WATCHED.items():
        assert abs(found[name]["offset_ns"] - offset_of(room.paths[name], watched)) < 300_000
        error = se3.log(se3.inverse(watched.T_body_mocap) @ found[name]["T_body_mocap"])
        assert np.degrees(np.linalg.norm(error[:3])) < 0.15 and np.linalg.norm(error[3:]) < 0.004
        assert found[name]["tilt_deg"] == pytest.approx(np.hypot(0.3, 0.5), abs=0.03)
        assert found[name]["next_correlation"] < 0.7 < 0.95 < found[name]["correlation"]
    assert [len(found[name]["gaps_s"]) for name in WATCHED] == [1, 0]
    ((start, end),) = found["ann"]["gaps_s"]
    assert end - start == pytest.approx(1.5, abs=0.1)
    assert found["ann"]["truth_s"] == pytest.approx(SECONDS - 1.5, abs=0.3)


def test_truth_agrees_with_the_emulator_in_one_world(room, made):
    """Millimetres, with one turn and shift for both devices, and no pose in the gap."""
    pairs = {}
    for name, watched in WATCHED.items():
        own = read_tum(made / "truth" / f"{name}.tum")
        real = room.truth(name, own)
        assert ate(own, real).rmse < 0.002
        pairs[name] = (own, real)
        t = (own.stamps_ns - watched.clock_ns - room.paths[name].start_ns) * 1e-9
        assert not any(((t > a + 0.05) & (t < b - 0.05)).any() for a, b in watched.hidden if b - a > 1)
    assert joint_ate(pairs).joint.rmse < 0.003


def test_session_has_the_usual_format(room, made):
    agents = read_session(made).agents
    assert {name: str(agent.kind) for name, agent in agents.items()} == {"ann": "ar", "bob": "robot"}
    assert sorted(os.listdir(made)) == [
        "align.json",
        "align.png",
        "ann.mcap",
        "bob.mcap",
        "session.yaml",
        "truth",
    ]
    for name in agents:
        assert os.path.samefile(made / f"{name}.mcap", room.folder / f"{name}.mcap")  # no copy
        source, was = open_source(str(made / name)), open_source(str(room.session / name))
        assert source.truth() is not None and len(source.stamps()["imu"]) == len(was.stamps()["imu"])
        np.testing.assert_allclose(source.rig.T_body_cam0, was.rig.T_body_cam0, atol=1e-9)


@pytest.mark.slow
def test_scores_agree_with_those_of_the_exact_truth(share, room, made, tmp_path):
    """Scores differ from those against the exact truth by at most the difference of the truths. bob
    starts 3 s later, so the run lasts until bob ends."""
    run, session = tmp_path / "run", tmp_path / "session"
    shutil.copytree(made, session)
    plain = yaml.safe_load((session / "session.yaml").read_text())
    plain["agents"]["bob"]["clock_offset_ns"] -= 3 * 10**9
    (session / "session.yaml").write_text(yaml.safe_dump(plain))
    assert share("evaluate", "run", session, "--virtual", "--out", run).code == 0
    assert read_json(run / "run.json")["seconds"] == pytest.approx(SECONDS + 3, abs=0.2)
    done = share("evaluate", "score", run, "--json")
    assert done.code == 0
    agents = {one["agent"]: one for one in json.loads(done.out)["runs"][0]["agents"]}
    assert list(agents) == list(WATCHED)
    for name, one in agents.items():
        assert one["frames"] == SECONDS * RATE_HZ and one["tracked"] > 60
        poses = read_tum(run / name / "odom.tum")
        real_cm = 100 * ate(poses, room.truth(name, poses)).rmse
        assert one["odom_ate_cm"] == pytest.approx(real_cm, abs=0.2)


def test_provenance_names_all_inputs(room, made):
    whence = read_session(made).provenance
    assert whence["settings"] == {"rotations": "helical", "within_s": None, "sigma_mm": 2.0, "bridge_s": 0.5}
    ann = whence["devices"]["ann"]
    assert ann["recording"] == str(room.folder / "ann.mcap")
    assert ann["mocap"] == f"{room.folder / 'vicon.csv'} Headset1"
    assert ann["drift_ppm"] == read_json(made / "align.json")["ann"]["drift_ppm"]


@pytest.mark.slow
def test_motive_export_with_y_up_gives_the_same(share, room, made, tmp_path):
    """Another clock, which begins with its first frame; the same session."""
    reported = ("--mocap", room.folder / "take.csv", "--json", "--out", tmp_path / "made")
    done = share("dataset", "align", room.recordings[1], *reported)
    assert done.code == 0 and "bob: the motion capture's up axis is y; the session's is z" in done.err
    found, was = json.loads(done.out)["bob"], read_json(made / "align.json")["bob"]
    assert found["up"] == "y" and was["up"] == "z"
    assert abs(found["offset_ns"] - was["offset_ns"] - round(FIRST * 1e9 / MOCAP_HZ)) < 50_000
    assert found["tilt_deg"] == pytest.approx(was["tilt_deg"], abs=0.01)
    own, other = (read_tum(folder / "truth" / "bob.tum") for folder in (tmp_path / "made", made))
    up = [trajectory.T[:, 2, 3] for trajectory in (own, other)]
    assert np.abs(np.interp(other.stamps_ns - 0.0, own.stamps_ns - 0.0, up[0]) - up[1]).max() < 0.005


@pytest.mark.slow
def test_euroc_folder_is_converted(share, room, tmp_path):
    """As one recording, and the truth is the one that was found, not the folder's."""
    asl = tmp_path / "asl"
    assert share("dataset", "convert", room.session / "bob", "--format", "euroc", "--out", asl).code == 0
    reported = ("--mocap", room.folder / "vicon.csv", "--json", "--out")
    done = share("dataset", "align", f"bob={asl}", *reported, tmp_path / "one")
    assert done.code == 0
    assert sorted(p.name for p in (tmp_path / "one").iterdir() if p.suffix) == [
        "align.json",
        "align.png",
        "bob.mcap",
        "session.yaml",
    ]
    own = read_tum(tmp_path / "one" / "truth" / "bob.tum")
    assert np.abs(own.stamps_ns - read_tum(room.session / "truth" / "bob.tum").stamps_ns[0]).min() < 10**7


@pytest.mark.slow
def test_given_calibration_and_mounting_are_used(share, room, tmp_path):
    """The recording is written anew with the one, and the body stays where the other says."""
    chains = yaml.safe_load((room.session / "session.yaml").read_text())["agents"]["bob"]["calibration"]
    imu = {"imu0": chains.pop("imu0")}
    chains["cam0"]["intrinsics"][0] = 97.0
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(yaml.safe_dump(chains))
    (tmp_path / "kalibr_imu_chain.yaml").write_text(yaml.safe_dump(imu))
    T = WATCHED["bob"].T_body_mocap
    sigma = "{rotation_deg: [0.005, 0.005, 0.005], position_m: [0.0001, 0.0001, 0.0001]}"
    (tmp_path / "mocap.yaml").write_text(f"T_body_mocap: {T.tolist()}\nsigma: {sigma}\n")
    reported = ("--mocap", room.folder / "vicon.csv", "--calib", tmp_path, "--mounting", f"bob={tmp_path}")
    done = share("dataset", "align", room.recordings[1], *reported, "--json", "--out", tmp_path / "made")
    assert (done.code, done.err) == (0, "")
    found = json.loads(done.out)["bob"]
    np.testing.assert_allclose(found["T_body_mocap"], T, atol=5e-4)
    assert found["mounting_translation_sigma_mm"] < 0.5
    made, was = tmp_path / "made" / "bob.mcap", room.folder / "bob.mcap"
    assert not os.path.samefile(made, was) and open_source(str(made)).rig.cam0.fx == 97.0
    assert all(
        np.array_equal(stamps, open_source(str(was)).stamps()[stream])
        for stream, stamps in open_source(str(made)).stamps().items()
    )


def test_wrong_use_is_one_line_and_leaves_no_output(share, room, tmp_path):
    def refused(code: int, *arguments: object) -> str:
        out = tmp_path / "out"
        done = share("dataset", "align", *arguments, "--out", out)
        assert done.code == code and done.err.count("\n") == 1, done.err
        assert os.listdir(tmp_path) == []
        return done.err

    ann, bob = room.recordings
    csv = ("--mocap", room.folder / "vicon.csv")
    csv_of_ann = ("--mocap", f"ann={csv[1]}", ann)
    assert "give NAME=RECORDING" in refused(2, room.folder / "ann.mcap", *csv)
    assert "no body for 'ann' (give --body ann=BODY); it has Headset1, BOB" in refused(2, ann, *csv)
    assert "no body 'Hat'" in refused(2, ann, *csv, "--body", "ann=Hat")
    both = refused(2, ann, bob, *csv, "--body", "ann=bob")
    assert "body 'BOB' cannot be both ann and bob; give --body bob=BODY" in both
    assert "no device 'eve'" in refused(2, bob, *csv, "--body", "eve=BOB")
    assert "--kind cat" in refused(2, bob, *csv, "--kind", "cat")
    assert "has no motion capture" in refused(2, bob, *csv_of_ann)
    assert "no such motion capture file" in refused(2, bob, "--mocap", room.folder / "no.csv")
    assert "`share calibrate mocap` makes one" in refused(2, bob, *csv, "--mounting", tmp_path)
    assert "is given twice" in refused(2, bob, bob, *csv)
    assert "name of a folder" in refused(2, f"truth={room.folder / 'bob.mcap'}", *csv)
    assert "bob: the time offset of motion capture" in refused(1, bob, *csv, "--body", "bob=Headset1")


def test_existing_output_is_not_overwritten(share, room, made):
    before = (made / "session.yaml").read_bytes()
    done = share("dataset", "align", room.recordings[1], "--mocap", room.folder / "vicon.csv", "--out", made)
    assert done.code == 2 and "is not an empty folder" in done.err
    assert (made / "session.yaml").read_bytes() == before


def test_written_mounting_is_read(tmp_path):
    (tmp_path / "mocap.yaml").write_text(
        "T_body_mocap: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]]\n"
        "sigma: {rotation_deg: [0.01, 0.05, 0.02], position_m: [0.001, 0.0005, 0.002]}\n"
    )
    T, (turn, shift) = read_mounting(tmp_path)
    assert T[:3, 3].tolist() == [0.1, 0, 0.2]
    assert (np.degrees(turn), shift) == pytest.approx((0.1, 0.004))  # twice the worst axis


@pytest.mark.slow
def test_real_recording_with_processed_motion_capture(share, shared_data, tmp_path):
    """EuRoC's truth is an estimate by the same IMU: its body is found as the Vicon's is known to sit
    (docs/understand/mocap-fit.md), its clock to some ms, and that is said."""
    folder = shared_data / "real" / "euroc_v1_01_keyframes"
    lines = (folder / "mav0" / "state_groundtruth_estimate0" / "data.csv").read_text().splitlines()[1:]
    rows = (line.split(",") for line in lines)
    away = 1_403_715_000_000_000_000
    reported = (",".join([str(int(stamp) - away), *values[:7]]) for stamp, *values in rows)
    (tmp_path / "seen.csv").write_text("\n".join(reported) + "\n")
    options = ("--mocap", tmp_path / "seen.csv", "--sigma-mm", "1.5", "--json", "--out", tmp_path / "made")
    done = share("dataset", "align", f"ann={folder}", *options)
    found = json.loads(done.out)["ann"]
    assert done.code == 0 and "neither smoothed nor estimated" in done.err
    assert abs(found["offset_ns"] - away) < 10_000_000 and found["lead"] > 100
    assert found["mounting_rotation_deg"] == pytest.approx(0.28, abs=0.05) and found["residual_mm"] < 1.5
    assert share("dataset", "info", tmp_path / "made" / "ann").code == 0
