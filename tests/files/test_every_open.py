"""Every file is opened through `share.files`, or listed here with a reason.

What SHARE reads goes through `share.files.reading` (or `arrays`, `json_file`, `section`, `tables`,
`images`, which do), what it writes through `share.files.writing`. A new call of another kind fails here.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import share

ROOT = Path(share.__file__).parent
NAMES = {
    "open", "read_text", "read_bytes", "write_text", "write_bytes", "savefig", "imread", "imwrite", "load",
    "loads", "save", "loadtxt", "genfromtxt", "fromfile", "tofile", "memmap", "copyfile", "copy", "copytree",
    "connect", "InferenceSession", "load_scene", "safe_load", "full_load", "unsafe_load", "load_all",
    "imdecode", "fdopen", "mkstemp", "dump",
}  # fmt: skip
OF = {  # where the name alone says too little: whose attribute it is
    "load": ("np", "numpy", "yaml", "json", "torch", "pickle", "trimesh", "marshal"),
    "loads": ("json", "pickle", "marshal", "yaml", "tomllib"),
    "save": ("np", "numpy", "torch"),
    "copy": ("shutil",),
    "connect": ("sqlite3",),
    "dump": ("json", "yaml", "pickle"),
}
OPENERS = {
    "files/reading.py",
    "files/writing.py",
    "files/arrays.py",
    "files/json_file.py",
    "strict_yaml.py",
    "files/sqlite_file.py",
}

_OWNERS = "|".join(one for some in OF.values() for one in some)
SEEN = re.compile(rf"\b({'|'.join(NAMES - OF.keys())}|({_OWNERS})\.({'|'.join(OF)}))\(")

KERNEL = "of the kernel (/proc, /sys, /etc), not of a person"
OURS = "into or from a temporary folder of our own making"
MEMORY = "into memory, or from bytes that are bounded"
ALLOWED = {
    ("files/locks.py", "open"): "a folder, for its lock",
    ("cli/edge_output.py", "open"): "MapStore.open",
    ("runtime/room_parts.py", "open"): "MapStore.open",
    ("runtime/remote_worker.py", "open"): "MapStore.open",
    ("runtime/remote_worker.py", "loads"): "from processes of the own site, through Ray, which does the same",
    ("cli/dataset_forget.py", "open"): "MapStore.open",
    ("cli/robot.py", "read_text"): "SHARE's own sources",
    ("robot/share_robot_node.py", "open"): "on a robot without SHARE: 500 bytes of a key",
    ("robot/share_robot_node.py", "loads"): MEMORY,
    ("lab/emulate/session.py", "save"): MEMORY,
    ("lab/emulate/world/room_files.py", "load"): "mapped, after open_regular; rebuilt if not whole",
    ("lab/emulate/world/room_files.py", "save"): OURS,
    ("lab/emulate/world/room_files.py", "write_text"): OURS,
    ("metrics/frame_log.py", "loadtxt"): "lines in memory, of the run's own file",
    ("lab/emulate/world/gltf.py", "load_scene"): "from memory, after gltf_file has measured it",
    ("lab/evaluate/charts.py", "savefig"): MEMORY,
    ("lab/evaluate/provenance.py", "read_bytes"): "SHARE's own sources",
    ("library/edge.py", "open"): "MapStore.open",
    ("recordings/calibration.py", "dump"): "to text",
    ("recordings/bags/ros1_bag.py", "open"): "rosbags' reader, through open_regular",
    ("recordings/convert.py", "write_text"): OURS,
    ("recordings/convert.py", "write_bytes"): OURS,
    ("lab/mocap/session.py", "copyfile"): "a recording that was opened by the door, into a new folder",
    ("devices/host.py", "read_text"): KERNEL,
    ("vision/image_codec.py", "imdecode"): "after image_header has measured it",
    ("view/page_process.py", "open"): "/dev/null",
    ("headset/measures.py", "open"): "O_NOFOLLOW, a table that the edge has just made",
    ("headset/measures.py", "fdopen"): "likewise",
    ("headset/server.py", "loads"): "the other end of a pipe between our own processes",
    ("cli/evaluate_paper.py", "read_text"): "the report that it has just written",
    ("lab/evaluate/side_by_side.py", "open"): "a table of a run that it has just made",
    ("view/viewer.py", "loads"): "the other end of a pipe between our own processes",
    ("cameras/live.py", "open"): "a camera",
    ("lab/evaluate/provenance.py", "read_text"): KERNEL,
    ("lab/emulate/small_pictures.py", "read_text"): "a profile that is shipped",
    ("lab/emulate/small_pictures.py", "safe_load"): "likewise",
    ("lab/study/study_log.py", "open"): "O_NOFOLLOW, a trial's own log, appended and synced",
    ("cli/study_run.py", "open"): "a folder, for its lock",
    ("store/database.py", "connect"): "after check_is_map",
    ("store/database.py", "open"): "O_NOFOLLOW, and checked",
    ("store/salvage.py", "connect"): OURS,
    ("store/salvage.py", "open"): OURS,
    ("store/schema.py", "connect"): MEMORY,
    ("recordings/mcap/recorder.py", "open"): "open('xb'): follows no link",
    ("odometry/error_model/network.py", "InferenceSession"): "after onnx_header has looked through it",
    ("cameras/realsense/camera.py", "open"): "a camera",
    ("runtime/source.py", "open"): "a reader's own",
    ("recordings/tables.py", "read_text"): "its own, through the door",
    ("net/tcp.py", "open"): KERNEL,
    ("lab/peer_trackers/basalt.py", "read_text"): KERNEL,
    ("lab/peer_trackers/orbslam3.py", "loadtxt"): OURS,
    ("lab/peer_trackers/orbslam3.py", "write_text"): OURS,
    ("lab/peer_trackers/peer_wire.py", "fdopen"): "its own standard output",
    ("lab/peer_trackers/peer_wire.py", "loads"): "the other end of a pipe between our own processes",
    ("runtime/capture.py", "open"): "a camera",
    ("startup.py", "open"): "the null device, for standard streams that are closed",
    ("startup.py", "fdopen"): "standard streams",
    ("lab/evaluate/tracker_runs.py", "loads"): "the answer of a program that the user names",
    ("lab/evaluate/real_time.py", "loads"): "events of the edge that it started itself",
    ("lab/train/training.py", "load"): "weights only, from bytes that are bounded",
    ("lab/train/training.py", "save"): MEMORY,
}  # fmt: skip


def calls(path: Path) -> set[str]:
    """Return the names in `NAMES` that a module calls."""
    found: set[str] = set()
    text = path.read_text()
    if not SEEN.search(text):  # parsing takes longer
        return found
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        match node.func:
            case ast.Name(id="open" as name):
                found.add(name)
            case ast.Attribute(attr=name, value=value) if name in NAMES:
                if name not in OF or (isinstance(value, ast.Name) and value.id in OF[name]):
                    found.add(name)
    return found


@pytest.fixture(scope="module")
def found() -> set[tuple[str, str]]:
    paths = sorted(ROOT.rglob("*.py"))
    assert len(paths) > 300
    names = ((path.relative_to(ROOT).as_posix(), path) for path in paths)
    return {(name, call) for name, path in names if name not in OPENERS for call in calls(path)}


@pytest.mark.long
def test_every_file_is_opened_through_share_files_or_listed(found):
    assert sorted(found - ALLOWED.keys()) == []


@pytest.mark.long
def test_no_exception_is_listed_without_its_call(found):
    assert sorted(ALLOWED.keys() - found) == []


@pytest.mark.parametrize(
    "code", ["open('x')", "Path('x').read_text()", "np.load('x')", "figure.savefig('x')", "json.loads(x)"]
)
def test_calls_that_open_files_are_recognised(tmp_path, code):
    (tmp_path / "x.py").write_text(code)
    assert calls(tmp_path / "x.py")
