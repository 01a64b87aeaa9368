"""Invalid input gives one clear line, the right exit code, and no partial output.

Commands run for real: within this process where that is the same, as processes where signals, sockets
or two of them at a time matter. Exit code 2: what was typed or pointed at; 1: damaged data or a failure.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.recordings import make_euroc, make_tum
from helpers.shell import Done

from share.net.transport import bind
from share.types import Keyframe
from share.wire import messages as m
from share.wire.codec import decode, encode

pytestmark = pytest.mark.long

SHARE = [sys.executable, "-m", "share"]
NOBODY = "tcp://127.0.0.1:1"  # a port that nothing listens on
FRAMES = 45  # of `plain_session`
FEW = ("--frames", ":20")  # agents play in real time: for those of whom a second is enough
CAMCHAIN = """
cam0: {camera_model: pinhole, intrinsics: [385, 385, 320.4, 239.6], resolution: [640, 480]}
cam1: {camera_model: pinhole, intrinsics: [385, 385, 320.4, 239.6], resolution: [640, 480],
       T_cn_cnm1: [[1, 0, 0, -0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
"""


def complaint(done: Done, code: int) -> str:
    """Return the one error line of a command that failed with `code`."""
    assert done.code == code, done.err
    assert done.out == ""
    assert done.err.startswith("share: ")
    assert done.err.count("\n") == 1, done.err
    return done.err


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@contextmanager
def untouched(folder: Path) -> Iterator[None]:
    """Assert that no file below `folder` changes or appears."""
    before = tree(folder)
    yield
    assert tree(folder) == before


def as_track(source: Path, out: Path) -> list[object]:
    return ["track", source, "--out", out / "T.tum", "--report", out / "R.json"]


def as_agent(source: Path, out: Path, edge: str = NOBODY, name: str = "ann") -> list[object]:
    return ["agent", source, "--name", name, "--kind", "ar", "--edge", edge, "--out", out]


both = pytest.mark.parametrize("command", [as_track, as_agent])

# ------------------------------------------------------------------ recordings


@pytest.fixture(scope="module")
def room(plain_session) -> Path:
    """A trackable session of three seconds."""
    return plain_session


@pytest.fixture(scope="module")
def stereo(room, tmp_path_factory) -> Path:
    """The cameras of its ar1 as an EuRoC folder."""
    folder = tmp_path_factory.mktemp("made") / "stereo"
    convert = [*SHARE, "dataset", "convert", f"{room}/ar1", "--format", "euroc", "--out", str(folder)]
    subprocess.run(convert, check=True, stdout=subprocess.DEVNULL)
    shutil.rmtree(folder / "mav0" / "imu0")
    return folder


@pytest.fixture
def damaged(stereo, tmp_path) -> Path:
    """The same with one image cut short, in the middle."""
    folder = shutil.copytree(stereo, tmp_path / "stereo")
    image = sorted((folder / "mav0" / "cam1" / "data").iterdir())[FRAMES // 2]
    image.write_bytes(image.read_bytes()[:-5000])
    return folder


def longer(stereo: Path, to: Path, frames: int, step_s: float) -> Path:
    """The same images forwards and backwards, `frames` of them at `step_s`."""
    folder = shutil.copytree(stereo, to)
    for listing in folder.glob("mav0/cam*/data.csv"):
        lines = [line for line in listing.read_text().splitlines() if not line.startswith("#")]
        names = [line.split(",")[1] for line in lines]
        names += names[-2:0:-1]
        stamps = (10**18 + round(i * step_s * 1e9) for i in range(frames))
        listing.write_text("".join(f"{t},{names[i % len(names)]}\n" for i, t in enumerate(stamps)))
    return folder


# ------------------------------------------------------------------ the source


def edit(path: Path, old: str, new: str, count: int = -1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def spoil(path: Path, stamp: str = "NaN") -> None:
    """No line has a stamp any more."""
    path.write_text(re.sub(r"(?m)^\d+,", f"{stamp},", path.read_text()))


def cut(path: Path, left: int = 3) -> None:
    """The file ends in the middle of a line."""
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:left]) + lines[left][: len(lines[left]) // 3])


def leave_only_cam0(folder: Path) -> None:
    for name in ("cam1", "imu0"):
        shutil.rmtree(folder / name, ignore_errors=True)


CAM0, IMU0 = Path("mav0/cam0"), Path("mav0/imu0")
EUROC_DAMAGE = {
    "gone": (2, "no such file or folder", shutil.rmtree),
    "empty": (2, "not a recording that SHARE reads", lambda r: shutil.rmtree(r / "mav0")),
    "no cameras": (2, "cam0/sensor.yaml: no such file", lambda r: shutil.rmtree(r / CAM0)),
    "no list": (1, "data.csv: no such file", lambda r: (r / CAM0 / "data.csv").unlink()),
    "empty list": (1, "data.csv: has no data", lambda r: (r / CAM0 / "data.csv").write_text("#t,name\n")),
    "binary list": (1, "is not a text file", lambda r: (r / CAM0 / "data.csv").write_bytes(b"\xff\xfe\0")),
    "NaN stamp": (
        1,
        "data.csv, line 2: stamp 'NaN' is not a whole number",
        lambda r: spoil(r / CAM0 / "data.csv"),
    ),
    "images gone": (1, "is missing from", lambda r: shutil.rmtree(r / CAM0 / "data")),
    "imu NaN stamp": (1, "line 2: stamp 'nan'", lambda r: spoil(r / IMU0 / "data.csv", "nan")),
    "imu NaN": (
        1,
        "line 2: 'nan' is not finite",
        lambda r: (r / IMU0 / "data.csv").write_text("#t,w,w,w,a,a,a\n5,0,0,nan,0,0,0\n"),
    ),
    "no extrinsics": (
        2,
        "cam0/sensor.yaml: key 'T_BS' is missing",
        lambda r: edit(r / CAM0 / "sensor.yaml", "T_BS:", "T_unknown:"),
    ),
    "no YAML": (2, "not valid YAML", lambda r: (r / CAM0 / "sensor.yaml").write_text("a: [1")),
    "unknown lens": (
        2,
        "distortion_model 'fov' is not supported; supported: radtan",
        lambda r: edit(r / CAM0 / "sensor.yaml", "radial-tangential", "fov"),
    ),
    "a fisheye of five numbers": (
        2,
        "distortion_coeffs: expected 4 numbers, found 5",
        lambda r: edit(
            r / CAM0 / "sensor.yaml",
            "radial-tangential\ndistortion_coefficients: [",
            "equidistant\ndistortion_coeffs: [0.0, ",
        ),
    ),
    "mono": (2, "stereo, depth or an IMU is needed", lambda r: leave_only_cam0(r / "mav0")),
}


@both
@pytest.mark.parametrize("damage", EUROC_DAMAGE)
def test_euroc_folder(damage, command, share, tmp_path):
    code, said, do = EUROC_DAMAGE[damage]
    recording = make_euroc(tmp_path / "walk")
    do(recording)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "T.tum").write_text("an older run\n")
    (tmp_path / "out" / "odom.tum").write_text("an older run\n")
    with untouched(tmp_path):
        assert said in complaint(share(*command(recording, tmp_path / "out")), code)


TUM_DAMAGE = {
    "no depth list": (1, "depth.txt: no such file", lambda r: (r / "depth.txt").unlink()),
    "NaN stamp": (
        1,
        "stamp 'NaN' is not a time",
        lambda r: (r / "rgb.txt").write_text("NaN rgb/0.jpg\n"),
    ),
    "no calibration": (2, "give the calibration with --calib", lambda r: (r / "camera.yaml").unlink()),
    "no depth scale": (
        2,
        "camera.yaml: key 'depth_scale' is missing",
        lambda r: edit(r / "camera.yaml", "depth_scale", "scale"),
    ),
    "no depth extrinsics": (
        2,
        "camera.yaml: key 'T_depth_cam0' is missing",
        lambda r: edit(r / "camera.yaml", "T_depth_cam0", "T"),
    ),
}


@both
@pytest.mark.parametrize("damage", TUM_DAMAGE)
def test_tum_folder(damage, command, share, tmp_path):
    code, said, do = TUM_DAMAGE[damage]
    recording = make_tum(tmp_path / "kitchen")
    do(recording)
    with untouched(tmp_path):
        assert said in complaint(share(*command(recording, tmp_path / "out")), code)


def test_truncated_ground_truth_is_refused(share, tmp_path):
    recording = make_tum(tmp_path / "kitchen")
    cut(recording / "groundtruth.txt")
    with untouched(tmp_path):
        done = share(*as_track(recording, tmp_path / "out"))
    said, failed = done.err.splitlines()  # the five frames of this recording show nothing
    assert "groundtruth.txt, line 4: 2 of 8 columns; the line is cut short" in said
    assert said.startswith("share: kitchen: skipped as damaged: 1 of the lines of ")
    assert (done.code, "none of its 5 frames could be tracked" in failed) == (1, True)


@both
def test_truncated_mcap_is_refused(command, room, share, tmp_path):
    recording = tmp_path / "cut.mcap"
    recording.write_bytes((room / "ar1.mcap").read_bytes()[:-3000])
    with untouched(tmp_path):
        said = complaint(share(*command(recording, tmp_path / "out")), 1)
    assert f"`share dataset recover {recording}" in said


@both
def test_paths_without_a_recording_are_refused(command, room, share, tmp_path):
    note = tmp_path / "note.txt"
    note.write_text("hello")
    for source, said in (
        (note, "not a recording that SHARE reads"),
        (room, f"is a session; name one of its agents: {room}/ar1, {room}/ar2, {room}/robot"),
        (room / "bob", "no agent 'bob'; agents: ar1, ar2, robot"),
        ("realsense", "RealSense camera"),  # none is attached, or the SDK is not here
    ):
        assert said in complaint(share(*command(source, tmp_path / "out")), 2)
    assert os.listdir(tmp_path) == ["note.txt"]


@both
def test_frame_range_beyond_the_end_is_refused(command, room, share, tmp_path):
    said = complaint(share(*command(room / "ar1", tmp_path / "out"), "--frames", f"{FRAMES}:"), 2)
    assert f"--frames {FRAMES}: selects nothing; it has {FRAMES} frames" in said


# ------------------------------------------------------------------ calibration and configuration

CALIBRATIONS = {
    "missing": (None, "no such file or folder"),
    "no YAML": ("cam0: [", "not valid YAML"),
    "a list": ("- 1", "expected keys and values, found list"),
    "empty": ("", "expected keys and values, found nothing"),
    "no extrinsics": (CAMCHAIN.replace("T_cn_cnm1", "T_unknown"), "no extrinsics to cam0; add T_cn_cnm1"),
    "not rigid": (CAMCHAIN.replace("[0, 0, 1, 0]", "[0, 0, 2, 0]"), "T_cn_cnm1: is not a rigid transform"),
    "NaN": (CAMCHAIN.replace("320.4", ".nan"), "intrinsics: has values that are not finite"),
    "negative focal length": (CAMCHAIN.replace("[385", "[-385"), "cam0"),
    "a lens that folds": (
        CAMCHAIN.replace("480]}", "480], distortion_model: radtan, distortion_coeffs: [-30, 0, 0, 0]}"),
        "cam0: its distortion folds",
    ),
    "no view in common": (
        CAMCHAIN.replace("[[1, 0, 0", "[[-1, 0, 0").replace("[0, 0, 1, 0]", "[0, 0, -1, 0]"),
        "cam1 sees 0 % of what cam0 sees",
    ),
    "another resolution's": (CAMCHAIN.replace("320.4", "1320.4"), "lies outside an image of 640x480"),
    "three intrinsics": (CAMCHAIN.replace(", 239.6", ""), "intrinsics: expected 4 numbers, found 3"),
    "one camera": (CAMCHAIN[: CAMCHAIN.index("cam1")], "stereo, depth or an IMU is needed"),
    "another sensor": (CAMCHAIN.replace("cam1", "depth").replace("T_cn_cnm1", "T_depth_cam0"), "has depth"),
}


@both
@pytest.mark.parametrize("case", CALIBRATIONS)
def test_calibration(case, command, stereo, share, tmp_path):
    text, said = CALIBRATIONS[case]
    calib = tmp_path / "camchain.yaml"
    if text is not None:
        calib.write_text(text)
    with untouched(tmp_path):
        done = share(*command(stereo, tmp_path / "out"), "--calib", calib)
    notes = [line for line in done.err.splitlines(keepends=True) if "is not used" in line]
    assert said in complaint(done._replace(err=done.err.replace("".join(notes), "")), 2)


def test_calibration_folder_without_a_camchain(stereo, share, tmp_path):
    said = complaint(share("track", stereo, "--calib", tmp_path), 2)
    assert "has no kalibr_imucam_chain.yaml" in said


def test_images_of_wrong_size_are_refused(stereo, share, tmp_path):
    calib = tmp_path / "camchain.yaml"
    calib.write_text(CAMCHAIN.replace("640, 480", "752, 480"))
    with untouched(tmp_path):
        said = complaint(share(*as_track(stereo, tmp_path / "out"), "--calib", calib), 1)
    assert "is 640x480, but the calibration is for 752x480; give the calibration of this recording" in said
    assert said.split()[1].startswith(f"{stereo}/mav0/cam0/data/")  # it names the image
    assert said == complaint(share(*as_agent(stereo, tmp_path / "out2"), "--calib", calib), 1)


CONFIGS = {
    "missing": (None, "config.yaml: cannot be read: No such file"),
    "no YAML": ("tracker: {", "config.yaml, line 1: not valid YAML"),
    "twice": ("agent: {}\nagent: {}", "config.yaml, line 2: not valid YAML: duplicate key 'agent'"),
    "a list": ("- tracker", "config.yaml: expected keys and values, found list"),
    "unknown section": ("traker: {}", "config.yaml: unknown key 'traker'; did you mean 'tracker'?"),
    "unknown key": ("tracker: {cornrs: 9}", "tracker: unknown key 'cornrs'; did you mean 'corners'?"),
    "far from any": ("agent: {zzz: 9}", "agent: unknown key 'zzz'; known: keep_keyframes, "),
    "wrong type": ("tracker: {corners: many}", "tracker: corners: expected a whole number, found 'many'"),
    "a number": ("tracker: 5", "tracker: expected keys and values, found int"),
    "out of range": ("stream: {window: 0}", "stream: window: 0 must be positive"),
    "zero": ("tracker: {corners: 0}", "tracker: corners: 0 must be positive"),
    "negative": (
        "inertial: {max_speed_m_s: -1}",
        "max_speed_m_s: expected a number from 0 to 1e+09, found -1",
    ),
    "huge": ("tracker: {corners: 1" + 40 * "0" + "}", "tracker: corners: expected a number from 0 to 1e+09"),
    "absurd": ("tracker: {corners: 1" + 400 * "0" + "}", "not valid YAML: number of 401 characters"),
    "retired": ("place: {hash_bits: 30}", "place.hash_bits is no longer a setting: it is"),
    "not a number": ("link: {silent_s: .nan}", "silent_s: expected a number from 0 to 1e+09, found nan"),
    "infinite": ("sequencer: {sync_tolerance_ms: .inf}", "from 0 to 1e+09, found inf"),
}


@pytest.mark.parametrize("command", [as_track, as_agent, lambda source, out: ["edge", "--out", out]])
@pytest.mark.parametrize("case", CONFIGS)
def test_configuration(case, command, share, tmp_path):
    text, said = CONFIGS[case]
    path = tmp_path / "config.yaml"
    if text is not None:
        path.write_text(text)
    with untouched(tmp_path):
        assert said in complaint(share(*command("nowhere", tmp_path / "out"), "--config", path), 2)


def test_numbers_of_a_configuration_have_all_yaml_forms(room, share, tmp_path):
    (tmp_path / "config.yaml").write_text("merge: {enter_m: 15e-2}\ninertial: {max_speed_m_s: 9}\n")
    done = share("track", room / "ar1", "--config", tmp_path / "config.yaml", "--frames", ":3", "--json")
    used = json.loads(done.out)["config"]
    assert done.code == 0
    assert (used["merge"]["enter_m"], used["inertial"]["max_speed_m_s"]) == (0.15, 9.0)


# ------------------------------------------------------------------ where results go

EDGE = ["edge", "--bind", "tcp://127.0.0.1:0", "--out"]


def test_unwritable_output_is_refused(room, share, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "file").write_text("old")
    (tmp_path / "taken" / "odom.tum").mkdir(parents=True)
    (tmp_path / "taken" / "events.jsonl").mkdir()
    source, below, proc = room / "ar1", tmp_path / "file" / "x", "/proc/share-x"
    with untouched(tmp_path):
        for arguments, said in (
            (["track", source, "--out", tmp_path], "is a folder; give the name of a file"),
            (["track", source, "--report", tmp_path], "is a folder; give the name of a file"),
            (["track", source, "--out", below], "is not a folder, or lies below a file"),
            (["track", source, "--out", f"{proc}/T.tum"], "cannot be written to: No such file"),
            (["track", source, "--out", below.parent, "--report", below.parent], "is the same file as --out"),
            (["track", room / "ar1.mcap", "--out", room / "ar1.mcap"], "is the source itself"),
            (as_agent(source, tmp_path / "file"), "is not a folder, or lies below a file"),
            (as_agent(source, below), "is not a folder, or lies below a file"),
            (as_agent(source, Path(proc)), "cannot be written to: No such file"),
            (as_agent(source, tmp_path / "taken"), "odom.tum: is a folder"),
            ([*EDGE, below], "is not a folder, or lies below a file"),
            ([*EDGE, proc], "cannot be written to: No such file"),
            ([*EDGE, tmp_path / "taken"], "events.jsonl: is a folder"),
            (["demo", "--out", below], "is not a folder, or lies below a file"),
            (["demo", "--out", proc], "cannot be written to: No such file"),
        ):
            assert said in complaint(share(*arguments), 2)


def test_output_may_have_any_valid_file_name(room, share, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert share("track", room / "ar1", "--out", "./new//T.tum", "--report", "new/../R.json").code == 0
    assert len((tmp_path / "new" / "T.tum").read_text().splitlines()) == FRAMES
    assert json.loads((tmp_path / "R.json").read_text())["tracked"] == FRAMES
    (tmp_path / "link").symlink_to("new/T.tum")
    (tmp_path / "new" / "T.tum").write_text("old")
    assert share("track", room / "ar1", "--out", "link", "--frames", ":5").code == 0
    assert not (tmp_path / "link").is_symlink()  # it is replaced, and not written through
    assert len((tmp_path / "link").read_text().splitlines()) == 5
    assert (tmp_path / "new" / "T.tum").read_text() == "old"


@pytest.mark.skipif(
    not all(Path(device).is_char_device() for device in ("/dev/null", "/dev/full")),
    reason="/dev/null or /dev/full is no device here",
)
def test_output_to_a_device_does_not_replace_it(room, share):
    assert share("track", room / "ar1", "--out", "/dev/null", "--frames", ":5").code == 0
    assert Path("/dev/null").is_char_device()
    done = share("track", room / "ar1", "--out", "/dev/full", "--frames", ":5")
    assert complaint(done, 1) == "share: /dev/full: cannot be written: No space left on device\n"


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Fail after a time limit instead of waiting forever."""

    def late(number: int, frame: object) -> None:
        raise AssertionError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_output_to_a_pipe_without_a_reader_is_refused(room, share, tmp_path):
    """To open it would wait for a reader."""
    names = ("T.tum", "events.jsonl", "edge.json", "odom.tum", "report.json")
    for name in names:
        (tmp_path / name).mkdir()
        os.mkfifo(tmp_path / name / name)
    pipe, source = tmp_path / "T.tum" / "T.tum", room / "ar1"
    with untouched(tmp_path), within(20):
        for arguments, said in (
            (["track", source, "--out", pipe], "T.tum: is a pipe without a reader"),
            (["track", source, "--report", pipe], "T.tum: is a pipe without a reader"),
            *((as_agent(source, tmp_path / name), f"{name}: is a pipe, where") for name in names[3:]),
            *(([*EDGE, tmp_path / name], f"{name}: is a pipe, where") for name in names[1:3]),
            (["dataset", "convert", source, "--format", "mcap", "--out", pipe], "T.tum: is a pipe, where"),
        ):
            assert said in complaint(share(*arguments), 2)


def test_poses_can_be_piped_into_a_command(room):
    command = 'exec "$@" --out >(wc -l)'
    arguments = [*SHARE, "track", room / "ar1", "--frames", ":5"]
    done = subprocess.run(
        ["bash", "-c", command, "-", *map(str, arguments)], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "5" in done.stdout.split("\n")


# ------------------------------------------------------------------ tracking


def test_two_runs_write_the_same_bytes(room, share, tmp_path):
    for agent in ("ar1", "robot"):
        first, second = tmp_path / f"{agent}.1", tmp_path / f"{agent}.2"
        assert share("track", room / agent, *FEW, "--out", first).code == 0
        again = [*SHARE, "track", room / agent, *FEW, "--out", second]
        subprocess.run(list(map(str, again)), check=True, stdout=subprocess.DEVNULL)
        assert first.read_bytes() == second.read_bytes()
        assert len(first.read_text().splitlines()) == 20


def test_damaged_image_is_reported_by_track(damaged, share, tmp_path):
    done = share(*as_track(damaged, tmp_path / "out"))
    assert done.code == 0
    (said,) = done.err.splitlines()
    assert "skipped as damaged: 1 of the frames; the first: " in said
    assert f"{damaged}/mav0/cam1/data/" in said
    assert "the image is cut short or damaged" in said


def test_untrackable_recording_is_refused_by_track(share, tmp_path):
    """Images of noise, too small to hold features."""
    recording = make_tum(tmp_path / "kitchen")
    with untouched(tmp_path):
        said = complaint(share(*as_track(recording, tmp_path / "out")), 1)
    assert "kitchen: none of its 5 frames could be tracked" in said


def test_unused_streams_are_named(stereo, share, tmp_path):
    recording = shutil.copytree(stereo, tmp_path / "stereo")
    (recording / "mav0" / "imu0").mkdir()
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    done = share("track", recording, "--calib", tmp_path / "camchain.yaml")
    assert done.code == 0
    assert done.err == "share: stereo: imu0 is not used: the calibration has no imu\n"


def test_ctrl_c_on_track(stereo, tmp_path):
    recording = longer(stereo, tmp_path / "long", 20_000, 0.05)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "T.tum").write_text("an older run\n")
    with untouched(tmp_path), start(*as_track(recording, tmp_path / "out")) as process:
        time.sleep(1.5)
        assert end(process) == Done(130, "", "share: interrupted\n")


# ------------------------------------------------------------------ agents and edges, alive


@contextmanager
def start(*arguments: object, limit: str = "true") -> Iterator[subprocess.Popen]:
    """`share ARGUMENTS` as a process, after the shell command `limit`."""
    command = ["bash", "-c", f'{limit}; exec "$@"', "-", *SHARE, *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def end(process: subprocess.Popen, ask: bool = True, said: str = "") -> Done:
    """Wait for the end of a process, after Ctrl-C if `ask`. said: its stderr so far."""
    if ask:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    return Done(process.returncode, out, said + err)


@contextmanager
def edge(out: Path, limit: str = "true") -> Iterator[tuple[subprocess.Popen, str]]:
    """An edge that listens, and its address."""
    with start(*EDGE, out, limit=limit) as process:
        line = process.stderr.readline()
        assert line.startswith("listening on tcp://127.0.0.1:")
        yield process, line.split()[2].rstrip(",")


def wait_for(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 15
    while not what():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.02)


@pytest.mark.parametrize(
    "address",
    [
        *("", "localhost", "tcp://", "127.0.0.1", "tcp://127.0.0.1", "tcp://127.0.0.1:port"),
        *("tcp://h:65536", "udp://127.0.0.1:5555", "tcp://a b:1", "tcp://::1:5555", "tcp://h:1:2"),
    ],
)
def test_invalid_addresses_are_refused(address, room, share, tmp_path):
    expected = f"'{address}' is not an address; expected tcp://HOST:PORT, such as tcp://127.0.0.1:5555"
    with untouched(tmp_path):
        assert expected in complaint(share(*as_agent(room / "ar1", tmp_path / "out", address)), 2)
        assert expected in complaint(share("edge", "--bind", address, "--out", tmp_path / "out"), 2)


def test_unusable_addresses_are_refused(room, share, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))  # where nobody has keys

    def agent_at(address: str) -> Done:
        return share(*as_agent(room / "ar1", tmp_path / "out", address))

    with untouched(tmp_path):
        assert "is not an address" in complaint(agent_at("tcp://127.0.0.1:0"), 2)
        assert "tcp://far:5555: links to other machines need keys" in complaint(agent_at("tcp://far:5555"), 2)
        for host in ("0.0.0.0", "192.0.2.1", "[::]", "some.host"):
            done = share("edge", "--bind", f"tcp://{host}:5555", "--out", tmp_path / "out")
            said = "need keys; make them with `share keys generate`"
            assert said in complaint(done, 2)


@pytest.mark.parametrize("name", ["", "a/b", "../x", ".hidden", "a b", "x" * 65, "hope\u3164"])
def test_names_invalid_as_file_names_are_refused(name, room, share, tmp_path):
    done = share(*as_agent(room / "ar1", tmp_path / "out", name=name))
    assert f"--name '{name}': use 1 to 64 letters" in complaint(done, 2)
    assert os.listdir(tmp_path) == []


def _not_late(said: str) -> list[str]:
    """Apart from figures that depend on the load of the machine."""
    return [line for line in said.splitlines() if " late: this machine is too slow" not in line]


def test_agent_fails_if_no_edge_answers(room, share, tmp_path):
    """Tracking is what `share track` makes of it, to the last digit; everything is written."""
    config = tmp_path / "quick.yaml"
    config.write_text("link: {silent_s: 0.4}\nagent: {finish_s: 0.2, late_ms: 0}")
    done = share(*as_agent(room / "ar1", tmp_path / "out"), "--config", config, *FEW)
    assert done.code == 1
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert done.out.startswith(
        "20 of 20 frames tracked, lost for 0.0 s\n"
        f"no edge answered: {report['keyframes']} keyframe not sent\n"
    )
    assert report["keyframes"] == 1
    assert (report["bytes_up"], report["protocol"]["sent"]) == (0, 0)  # no link took anything
    assert _not_late(done.err) == [
        "share agent: no edge answers yet; tracking continues without the edge",
        f"share: no edge answered at {NOBODY}; is `share edge` running there?",
    ]
    assert sorted(os.listdir(tmp_path / "out")) == ["latency.csv", "map.tum", "odom.tum", "report.json"]
    assert (tmp_path / "out" / "map.tum").read_bytes() == b""
    assert share("track", room / "ar1", "--out", tmp_path / "T.tum", *FEW).code == 0
    assert (tmp_path / "out" / "odom.tum").read_bytes() == (tmp_path / "T.tum").read_bytes()


class Careless(threading.Thread):
    """An edge that acknowledges only the first keyframe and buffers the others."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.link, self.is_over = bind("tcp://127.0.0.1:0"), False
        self._held = set()

    def run(self) -> None:
        while not self.is_over:
            if (arrival := self.link.receive(50)) is not None:
                for answer in self._answers(decode(arrival.frames)):
                    self.link.send(arrival.peer, encode(answer))
        self.link.close()

    def _answers(self, message: object) -> Iterator[m.DownlinkMessage]:
        match message:
            case m.Hello():
                yield m.Welcome(7, 0)
            case m.Ping():
                yield m.Pong(message.sequence, message.sent_ns, 1, 1, 7)
            case Keyframe():
                self._held |= {message.id} - {0}
                yield m.Ack(1, tuple(sorted(self._held)))


def test_unacknowledged_keyframes_are_reported(room, share, tmp_path):
    (config := tmp_path / "quick.yaml").write_text(
        "agent: {finish_s: 0.4}\ninertial: {keyframe_m: 0.01, keyframe_rad: 0.01}\n"
    )
    edge = Careless()
    edge.start()
    try:
        done = share(*as_agent(room / "ar1", tmp_path / "out", edge.link.endpoint), "--config", config)
    finally:
        edge.is_over = True
        edge.join()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    made, sent = report["keyframes"], report["protocol"]["sent"]
    left = made - 1
    assert 3 < sent == made == report["protocol"]["keyframes"]
    assert done.code == 0
    assert f"\n{made} keyframes: {sent} sent, 1 acknowledged, 0 corrections, " in done.out
    assert done.err.splitlines() == [
        "share agent: connected to the edge",
        f"share agent: the edge did not acknowledge {left} keyframes: it received {left} of them but could "
        "not store them in its map file; see the edge's log",
    ]


def test_agent_skips_a_damaged_image(damaged, share, tmp_path):
    with edge(tmp_path / "edge") as (server, address):
        done = share(*as_agent(damaged, tmp_path / "out", address), "--frames", ":27")
        assert end(server).code == 0
    assert done.code == 0
    skipped = [line for line in done.err.splitlines() if "frame skipped" in line]
    assert len(skipped) == 1
    assert skipped[0].startswith(f"share agent: frame skipped: {damaged}/mav0/cam1/data/")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["damaged_images"], report["frames"], report["tracked"]) == (1, 26, 26)


def test_second_agent_of_a_name_or_folder_is_refused(stereo, room, share, tmp_path):
    """Both later agents are refused; the first continues, and Ctrl-C ends it and the edge cleanly."""
    slow = longer(stereo, tmp_path / "slow", 600, 0.05)
    first, report = tmp_path / "first", tmp_path / "first" / "report.json"
    with (
        edge(tmp_path / "edge") as (server, address),
        start(*as_agent(slow, first, address)) as agent,
    ):
        said = agent.stderr.readline()
        assert said == "share agent: connected to the edge\n"
        refused = complaint(share(*as_agent(room / "ar2", tmp_path / "second", address)), 2)
        assert "the edge refuses 'ann': the name 'ann' is in use by another agent" in refused
        assert "choose another with --name" in refused
        assert os.listdir(tmp_path / "second") == []
        refused = complaint(share(*as_agent(room / "ar2", first, address, name="bob")), 2)
        assert f"{first}: another run is writing there; give another --out" in refused
        assert "another run is writing there" in complaint(share(*EDGE, tmp_path / "edge"), 2)
        done, served = end(agent, said=said), end(server)
    assert (done.code, done.err) == (0, said)
    poses = (first / "odom.tum").read_text().splitlines()
    assert 0 < len(poses) == json.loads(report.read_text())["tracked"] < 600
    assert sorted(os.listdir(first)) == ["latency.csv", "map.tum", "odom.tum", "report.json"]
    assert served.code == 0
    assert sorted(os.listdir(tmp_path / "edge")) == ["edge.json", "events.jsonl"]
    assert set(json.loads((tmp_path / "edge" / "edge.json").read_text())["agents"]) == {"ann"}
    events = [json.loads(line) for line in (tmp_path / "edge" / "events.jsonl").read_text().splitlines()]
    assert [e["reason"] for e in events if e["event"] == "refused"][:1] == [refused_reason()]


def refused_reason() -> str:
    return "the name 'ann' is in use by another agent; choose another with --name"


def test_port_in_use_is_reported(share, tmp_path):
    old = tmp_path / "old"
    old.mkdir()
    (old / "events.jsonl").write_text("an older run\n")
    with edge(tmp_path / "edge") as (_, address), untouched(old):
        done = share("edge", "--bind", address, "--out", old)
    assert complaint(done, 1) == (
        f"share: {address}: the port is in use; stop the other edge or choose another port\n"
    )


def test_pages_of_an_edge_do_not_share_a_port(share, tmp_path):
    """It was told to stop the other edge, and there was none."""
    done = share("edge", "--http", "8093", "--view", "8093", "--out", tmp_path / "out")
    assert complaint(done, 2) == "share: --http and --view name the same port 8093; give each its own\n"
    done = share("edge", "--http", "8093", "--headset", "http://127.0.0.1:8093")
    assert complaint(done, 2) == "share: --http and --headset name the same port 8093; give each its own\n"


def test_edge_with_a_full_disk_continues(room, share, tmp_path):
    """A limit on file size stands for the disk."""
    out = tmp_path / "edge"
    with edge(out, "ulimit -f 0") as (server, address):
        assert share(*as_agent(room / "ar1", tmp_path / "out", address), *FEW).code == 0
        done = end(server)
    assert done.code == 1
    assert done.err.count("events.jsonl: cannot be written: File too large; the run goes on without it") == 1
    assert re.search(
        "share: .*(is not complete|cannot be written): File too large", done.err.splitlines()[-1]
    )


def test_agent_with_a_full_disk_continues(room, tmp_path):
    """A limit on file size stands for the disk: 1 kB is full after a few poses."""
    with edge(tmp_path / "edge") as (server, address):
        with start(*as_agent(room / "ar1", tmp_path / "out", address), *FEW, limit="ulimit -f 1") as agent:
            done = end(agent, ask=False)
        assert end(server).code == 0
    assert done.code == 1
    odom, in_map = (tmp_path / "out" / f"{name}.tum.partial" for name in ("odom", "map"))
    assert _not_late(done.err) == [
        "share agent: connected to the edge",
        *(
            f"share agent: {file}: cannot be written: File too large; the run goes on without it"
            for file in (odom, in_map)
        ),
        f"share: {odom}: is not complete: File too large",
    ]
    assert sorted(os.listdir(tmp_path / "out")) == ["latency.csv.partial", in_map.name, odom.name]
    lines = odom.read_text().splitlines()
    assert len(lines) > 5
    assert {len(line.split()) for line in lines} == {8}
    assert odom.read_text().endswith("\n")
    ann = json.loads((tmp_path / "edge" / "edge.json").read_text())["agents"]["ann"]
    assert ann["poses"] > 3  # thinned until the air is known


@pytest.mark.parametrize("more", [(), ("--profile", "d435i"), ("--profile", "laptop-edge")])
def test_agent_without_a_kind_is_refused(share, more):
    done = share("agent", "realsense", "--name", "a", "--edge", NOBODY, *more)
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("share: --kind is required: ar (headset) or robot")
    assert done.err.count("\n") == 1


@pytest.mark.parametrize(
    "command", [("demo",), ("agent", "x", "--name", "a", "--kind", "ar", "--edge", "tcp://127.0.0.1:1")]
)
def test_unknown_network_is_refused(command: tuple[str, ...]) -> None:
    done = subprocess.run([*SHARE, *command, "--link", "nowhere"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    names = "wifi5, wifi-busy, shared-150, shared-15, shared-8, shared-5"
    assert done.stderr == f"share: --link: 'nowhere' is neither a file nor one of {names}\n"


def test_air_that_agents_share_is_refused_in_real_time() -> None:
    agent = ("agent", "x", "--name", "a", "--kind", "ar", "--edge", "tcp://127.0.0.1:1")
    for command in (("demo",), agent):
        done = subprocess.run(
            [*SHARE, *command, "--link", "shared-8"], capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(
            "share: --link shared-8: air that agents share is emulated in virtual time"
        )
        assert done.stderr.count("\n") == 1


def test_invalid_frustum_is_refused_before_the_edge_starts(tmp_path: Path) -> None:
    config = tmp_path / "flat.yaml"
    config.write_text("control: {far_m: 0.1}\n")
    command = [*SHARE, "edge", "--bind", "tcp://127.0.0.1:0", "--policy", "share", "--config", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr == f"share: {config}: control: far_m: 0.1 m is not beyond the near plane, 0.3 m\n"


@pytest.mark.parametrize("policy", ["covins-g", "streamed"])
def test_compare_needs_another_policy_that_shares_a_map(share, policy):
    done = share("demo", "--compare", "--policy", policy, "--out", "out")
    assert done.code == 2
    assert f"choose another than {policy}" in done.err
