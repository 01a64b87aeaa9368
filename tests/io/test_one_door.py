"""Every file is opened through one door, or it is listed here why not.

What SHARE reads goes through `share.io.regular_file` (or `arrays`, `json_file`, `section`, `tables`,
`images`, which do), what it writes through `share.io.files`. A new call of another kind fails here.
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
DOORS = {
    "io/regular_file.py",
    "io/files.py",
    "io/arrays.py",
    "io/json_file.py",
    "strict.py",
    "io/sqlite_file.py",
}

_WHOSE = "|".join(one for some in OF.values() for one in some)
SEEN = re.compile(rf"\b({'|'.join(NAMES - OF.keys())}|({_WHOSE})\.({'|'.join(OF)}))\(")

KERNEL = "of the kernel (/proc, /sys, /etc), not of a person"
OURS = "into or from a temporary folder of our own making"
MEMORY = "into memory, or from bytes that are bounded"
ALLOWED = {
    ("cli/edge.py", "open"): "MapStore.open",
    ("emulate/session.py", "open"): "a folder, for its lock",
    ("emulate/session.py", "save"): MEMORY,
    ("emulate/world/files.py", "load"): "mapped, after open_regular; what is not whole is built again",
    ("emulate/world/files.py", "save"): OURS,
    ("emulate/world/files.py", "write_text"): OURS,
    ("metrics/frame_columns.py", "loadtxt"): "lines in memory, of the run's own file",
    ("emulate/world/gltf.py", "load_scene"): "from memory, after gltf_file has measured it",
    ("io/allan_chart.py", "savefig"): MEMORY,
    ("io/camera_imu_chart.py", "savefig"): MEMORY,
    ("io/camera_report.py", "savefig"): MEMORY,
    ("io/figure.py", "savefig"): MEMORY,
    ("io/code_state.py", "read_bytes"): "SHARE's own sources",
    ("io/convert.py", "write_text"): OURS,
    ("io/convert.py", "write_bytes"): OURS,
    ("io/field_session.py", "copyfile"): "a recording that was opened by the door, into a new folder",
    ("io/host.py", "read_text"): KERNEL,
    ("io/images.py", "imdecode"): "after image_header has measured it",
    ("io/keys.py", "open"): "a new file that nobody else can read, or a folder, for its lock",
    ("io/keys.py", "fdopen"): "likewise",
    ("io/live.py", "open"): "a camera",
    ("io/machine.py", "read_text"): KERNEL,
    ("io/map_store/connect.py", "connect"): "after check_is_map",
    ("io/map_store/lock.py", "open"): "O_NOFOLLOW, and checked",
    ("io/map_store/opening.py", "connect"): "of our own tables, after check_is_map",
    ("io/map_store/salvage.py", "connect"): OURS,
    ("io/map_store/salvage.py", "open"): OURS,
    ("io/map_store/schema.py", "connect"): MEMORY,
    ("io/mcap/recorder.py", "open"): "open('xb'): follows no link",
    ("io/network.py", "InferenceSession"): "after onnx_header has looked through it",
    ("io/realsense/camera.py", "open"): "a camera",
    ("io/source.py", "open"): "a reader's own",
    ("io/tables.py", "loadtxt"): "from lines that are there",
    ("io/tables.py", "read_text"): "its own, through the door",
    ("io/transport/tcp.py", "open"): KERNEL,
    ("peers/basalt.py", "read_text"): KERNEL,
    ("peers/orbslam3.py", "loadtxt"): OURS,
    ("peers/orbslam3.py", "write_text"): OURS,
    ("peers/peer_wire.py", "fdopen"): "its own standard output",
    ("peers/peer_wire.py", "loads"): "the other end of a pipe between our own processes",
    ("run/capture.py", "open"): "a camera",
    ("run/peers.py", "loads"): "the answer of a program that the user names",
    ("run/play.py", "loads"): "events of the edge that it started itself",
    ("train/fit.py", "load"): "weights only, from bytes that are bounded",
    ("train/fit.py", "save"): MEMORY,
}  # fmt: skip


def calls(path: Path) -> set[str]:
    """The names in `NAMES` that a module calls."""
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
    return {(name, call) for name, path in names if name not in DOORS for call in calls(path)}


def test_every_file_is_opened_through_a_door_or_for_a_reason(found):
    assert sorted(found - ALLOWED.keys()) == []


def test_no_reason_outlives_its_call(found):
    assert sorted(ALLOWED.keys() - found) == []


@pytest.mark.parametrize(
    "code", ["open('x')", "Path('x').read_text()", "np.load('x')", "figure.savefig('x')", "json.loads(x)"]
)
def test_such_calls_are_seen(tmp_path, code):
    (tmp_path / "x.py").write_text(code)
    assert calls(tmp_path / "x.py")
