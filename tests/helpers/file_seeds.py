"""What the fuzzer of files damages, and by whom it is read."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from helpers.live import RIG, live
from helpers.made_db3 import make_db3
from helpers.made_features import made_features
from helpers.made_gltf import tree, write
from helpers.map_changes import small_map
from helpers.onnx_bytes import small_error_model
from helpers.recordings import make_euroc, make_tum
from helpers.small_session import small_profile, small_recipe

from share import config
from share.cli.options import load_config
from share.errors import ShareError, UsageError
from share.lab.calibrate.imu_table import read_imu
from share.lab.emulate.session import make_session
from share.lab.emulate.world.gltf import load_gltf
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.scoring import merge_locations, run_metrics, traces
from share.lab.evaluate.trial import read_trial, run_trial
from share.lab.evaluate.virtual_time import read_delays
from share.lab.mocap.files import read_bodies
from share.lab.train.keyframe_table import collect_labels, tabulate
from share.lab.train.labels import Labels, read_labels, write_labels
from share.net.keys import AllowList
from share.odometry.error_model.inputs import INPUT_SHAPES, input_dtype
from share.odometry.error_model.network import estimate_error, open_error_model
from share.recordings.calibration import kalibr_texts, read_calibration
from share.recordings.describe import describe_recording
from share.recordings.mcap.recorder import Recorder, recover_recording
from share.recordings.session import read_session
from share.runtime.pipeline import check_trackable, make_tracker, read_frames
from share.runtime.source import open_source
from share.sensors.profile import load_host_profile, load_profile
from share.sensors.sequencer import SequencerCounters
from share.store.export import describe_map
from share.store.map_store import MapStore


def _tracked(source: object) -> None:
    check_trackable(source.name, source.rig)
    tracker = make_tracker(source.rig, config.Config())
    for frame in read_frames(source, config.Config(), SequencerCounters()):
        if tracker.track(frame).keyframe_ready:
            tracker.make_keyframe(frame)
            tracker.finish_keyframe()


def read_recording(path: Path) -> None:
    source = open_source(str(path))
    with contextlib.suppress(ShareError):
        describe_recording(source)
    with contextlib.suppress(ShareError):
        source.truth()
    with contextlib.suppress(ShareError):
        read_imu(str(path))
    source.losses.lines()
    _tracked(source)


def read_mcap(path: Path) -> None:
    with contextlib.suppress(ShareError):
        recover_recording(path, path.with_name("saved.mcap"))
    read_recording(path)


def read_a_session(path: Path) -> None:
    session = read_session(path)
    for name in session.agents:
        read_recording(path / name)


def read_map(path: Path) -> None:
    with contextlib.suppress(ShareError):
        describe_map(MapStore.read(path))
    with MapStore.open(path) as store:
        store.load()
    assert MapStore.read(path).load() is not None


def read_settings(path: Path) -> None:
    load_config(str(path))


def read_profile(path: Path) -> None:
    load_profile(str(path)).rig()
    load_host_profile(str(path))


def read_onnx(path: Path) -> None:
    estimate_error(open_error_model(str(path)), made_features(np.random.default_rng(1)))


def read_room(path: Path) -> None:
    load_gltf(path / "room.gltf")


def read_keys(path: Path) -> None:
    allowed = AllowList(path / "authorized")
    allowed.trouble()
    allowed.grants()


def read_labels_of(path: Path) -> None:
    with contextlib.suppress(UsageError):  # of four rooms at least
        collect_labels(path, 0)
    for file in path.iterdir():
        tabulate([read_labels(file)])


def read_a_run(path: Path) -> None:
    """What agents and the edge left, in virtual time."""
    with contextlib.suppress(ShareError):
        read_delays(path / "run")
    trial = read_trial(path / "run")
    for read in (run_metrics, traces, merge_locations):
        with contextlib.suppress(ShareError):
            read(trial)
    load_config(str(path / "run" / "config.yaml"))


Seed = tuple[Callable[[Path], None], Path]


def seeds(root: Path) -> dict[str, Seed]:
    """What is damaged, and by whom it is read."""
    make_euroc(root / "euroc", frames=12)
    make_tum(root / "tum", frames=12)
    with Recorder(root / "a.mcap", RIG) as recorder:
        for m in live(12):
            recorder.write(m)
    (root / "session" / "truth").mkdir(parents=True)
    shutil.copyfile(root / "a.mcap", root / "session" / "ann.mcap")
    texts = kalibr_texts(RIG, "a rig")
    chain = "".join("      " + line + "\n" for text in texts.values() for line in text.splitlines())
    (root / "session" / "session.yaml").write_text(
        f"schema: 1\nprovenance: {{a: 1}}\nagents:\n  ann:\n    kind: ar\n    sensors: rgbd+imu\n    rate_hz: 20.0\n"  # noqa: E501
        f"    clock_offset_ns: 5\n    calibration:\n{chain}"
    )
    (root / "session" / "truth" / "ann.tum").write_text("1.0 0 0 0 0 0 0 1\n1.1 0 0 0 0 0 0 1\n")
    (root / "calib").mkdir()
    for name, text in texts.items():
        (root / "calib" / name).write_text(text)
    with MapStore.open(root / "map.sqlite") as store:
        store.write(small_map(12, points=10))
    (root / "map.sqlite.lock").unlink()
    (root / "config.yaml").write_text("tracker: {}\nedge: {}\ncontrol:\n  kp: 0.8\n  agents: {}\n")
    (root / "motive.csv").write_text(_MOTIVE)
    (root / "vicon.csv").write_text(_VICON)
    make_db3(root / "a.db3")
    (root / "a.onnx").write_bytes(small_error_model())
    (root / "room").mkdir()
    write(root / "room", tree())
    (root / "labels").mkdir()
    columns = (np.zeros((3, *shape), input_dtype(name)) for name, shape in INPUT_SHAPES.items())
    about = {"session": "s", "seed": 0, "provenance": {"scene": "plain", "seed": 1, "motions": ["walk:"]}}
    write_labels(root / "labels" / "a.npz", Labels(about, np.arange(3), np.ones(3, np.float32), *columns))
    (root / "keys").mkdir()
    (root / "keys" / "authorized").write_text("# those\n" + _KEYS)
    small_profile(root)
    _study(root)
    return {
        "euroc": (read_recording, root / "euroc"),
        "tum": (read_recording, root / "tum"),
        "mcap": (read_mcap, root / "a.mcap"),
        "session": (read_a_session, root / "session"),
        "calib": (read_calibration, root / "calib"),  # type: ignore[dict-item]
        "map": (read_map, root / "map.sqlite"),
        "config": (read_settings, root / "config.yaml"),
        "motive": (read_bodies, root / "motive.csv"),  # type: ignore[dict-item]
        "vicon": (read_bodies, root / "vicon.csv"),  # type: ignore[dict-item]
        "db3": (read_recording, root / "a.db3"),
        "onnx": (read_onnx, root / "a.onnx"),
        "gltf": (read_room, root / "room"),
        "labels": (read_labels_of, root / "labels"),
        "keys": (read_keys, root / "keys"),
        "profile": (read_profile, root / "small.yaml"),
        "study": (read_a_run, root / "study"),
    }


def _study(root: Path) -> None:
    """A run of two agents, where the cases will lie: it names its session by its path."""
    case = root / "case" / "study"
    case.mkdir(parents=True)
    session = case / "session"
    make_session(small_recipe(root / "small.yaml", "ann=walk:", "bob=walk:"), session, workers=1)
    terms = RunOptions("share", virtual=True)
    run_trial(read_session(session), terms, config.Config(), case / "run", lambda now: None)
    shutil.copytree(case, root / "study")


_KEYS = "".join(
    f"share-public-key {name} {'rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7'} ann\n" for name in "ab"
)
_MOTIVE = """Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,Name,A,A,A,A,A,A,A
,ID,1,1,1,1,1,1,1
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z
""" + "".join(f"{k},{k / 100},0,0,0,1,{k / 10},0,1\n" for k in range(20))
_VICON = """Objects
100
,,Ann:Ann,,,,,
Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ
,,deg,deg,deg,mm,mm,mm
""" + "".join(f"{k},0,0.1,0.2,0.3,{k},2,3\n" for k in range(1, 20))
