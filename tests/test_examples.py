"""The examples run, and the constant matrices of the receivers are what they say."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.headset_reference import predict_pose

from share.geometry.se3 import from_rt, inverse, matrix_from_quat, quat_from_matrix, so3_exp

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
CONVENTIONS = json.loads((EXAMPLES / "conventions.json").read_text())
FRAMES = ("rep103", "unity", "webxr")


def started(name: str, *arguments: object) -> subprocess.Popen[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.Popen(command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def lines_of(name: str, *arguments: object) -> list[str]:
    out, err = started(name, *arguments).communicate(timeout=60)
    assert err == ""
    return out.splitlines()


@pytest.mark.long
def test_track_recording(plain_session):
    lines = lines_of("track_recording.py", plain_session / "ar1")
    assert len(lines) == 45
    assert re.fullmatch(r"\d+ +(-?\d+\.\d{3} +){3}m  \d\.\d\d m/s", lines[-1])


@pytest.mark.long
def test_own_camera(plain_session):
    lines = lines_of("own_camera.py", plain_session / "ar1")
    assert len(lines) >= 40 and all(re.match(r"\d+  \[.+\] m  ", line) for line in lines)
    done = started("own_camera.py", plain_session / "nobody")
    assert re.fullmatch(r"own_camera: .*nobody.*\n", done.communicate(timeout=30)[1])


@pytest.mark.long
@pytest.mark.parametrize("name", ["track_recording", "own_camera", "run_edge", "shared_objects"])
def test_without_arguments_an_example_says_how_it_is_called(name: str) -> None:
    done = started(f"{name}.py")
    _, err = done.communicate(timeout=60)
    assert done.returncode == 1 and f"python examples/{name}.py " in err and "Traceback" not in err


@pytest.mark.long
def test_run_edge(plain_session):
    *agents, maps = lines_of("run_edge.py", plain_session / "ar1", plain_session / "ar2")
    assert len(agents) == 2 and all("m in odom, map ar" in line for line in agents)
    assert maps.startswith("keyframes in maps: {'ar")


@pytest.mark.long
def test_read_poses(share, plain_session, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    reader = started("read_poses.py", port)
    config = tmp_path / "config.yaml"
    config.write_text("agent: {finish_s: 0.1}\n")
    options = ("--kind", "ar", "--edge", "tcp://127.0.0.1:1", "--config", config)
    share("agent", plain_session / "ar1", "--name", "ann", *options, "--poses", f"udp://127.0.0.1:{port}")
    posed: list[str] = []
    for line in reader.stdout:  # ends 10 s after the last message
        posed += [line.rstrip()] * line.startswith("ann OK odom")
        if len(posed) == 30:
            break
    reader.terminate()
    assert reader.communicate(timeout=30)[1] == ""
    assert len(posed) == 30 and posed[-1].endswith("m/s")


@pytest.mark.parametrize("frame", FRAMES)
def test_axes_go_where_the_convention_says(frame):
    """Ahead, left and up of SHARE's world (x, y, z) and of its body (z, -x, -y)."""
    ahead, left, up = {
        "rep103": ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        "unity": ([0, 0, 1], [-1, 0, 0], [0, 1, 0]),
        "webxr": ([0, 0, -1], [-1, 0, 0], [0, 1, 0]),
    }[frame]
    world, body = (np.array(CONVENTIONS[frame][name]) for name in ("world", "body"))
    assert np.array_equal(world @ np.eye(3), np.column_stack([ahead, left, up]))
    assert np.array_equal(body @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.column_stack([ahead, left, up]))
    handedness = -1 if frame == "unity" else 1
    assert np.linalg.det(world) == pytest.approx(handedness) == np.linalg.det(body)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_converted_pose_takes_points_where_the_pose_did(frame, rng):
    world, body = (np.array(CONVENTIONS[frame][name], float) for name in ("world", "body"))
    T = from_rt(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    converted = from_rt(world @ T[:3, :3] @ body.T, world @ T[:3, 3])
    assert np.linalg.det(converted[:3, :3]) == pytest.approx(1)
    point = rng.normal(size=3)  # in the body
    expected = world @ (T[:3, :3] @ point + T[:3, 3])
    assert np.allclose(converted[:3, :3] @ (body @ point) + converted[:3, 3], expected)


@pytest.mark.parametrize(
    ("file", "frame"), [("unity/SharePoses.cs", "unity"), ("webxr/share-poses.js", "webxr")]
)
def test_receivers_have_the_matrices(file, frame):
    text = (EXAMPLES / file).read_text()
    for name in ("world", "body"):
        (rows,) = re.findall(rf"(?i)\b{name} = ([\[{{].+[\]}}]);", text)
        assert json.loads(rows.replace("{", "[").replace("}", "]")) == CONVENTIONS[frame][name]
        assert np.array_equal(np.linalg.inv(CONVENTIONS[frame]["body"]), CONVENTIONS[frame]["body"])
    assert re.search(r"schema (!==?|===) 3\b", text)


def run_receiver(tmp_path, names: str, expression: str):
    """Return what an expression of the web receiver's exported names is."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed: the JavaScript is not run")
    (tmp_path / "poses.mjs").write_text((EXAMPLES / "webxr/share-poses.js").read_text())
    program = tmp_path / "run.mjs"
    program.write_text(
        f'import {{ {names} }} from "./poses.mjs";\nconsole.log(JSON.stringify({expression}));\n'
    )
    done = subprocess.run([node, program], capture_output=True, text=True, timeout=30, check=True)
    return json.loads(done.stdout)


def test_the_web_receiver_computes_the_matrix(tmp_path, rng):
    T = from_rt(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    position, quaternion = T[:3, 3].tolist(), quat_from_matrix(T[:3, :3]).tolist()
    found = run_receiver(tmp_path, "toMatrix", f"toMatrix({position}, {quaternion})")
    world, body = (np.eye(4), np.eye(4))
    world[:3, :3], body[:3, :3] = CONVENTIONS["webxr"]["world"], CONVENTIONS["webxr"]["body"]
    expected = world @ T @ inverse(body)
    assert np.allclose(np.reshape(found, (4, 4), order="F"), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("frame", "ahead_ms"), [("odom", 20), ("map", 50), ("map", 400), ("map", -5), ("odom", 0)]
)
def test_the_web_receiver_predicts_as_the_reference_does(tmp_path, rng, frame, ahead_ms):
    """Velocity comes along the axes of odom, whichever frame is asked for."""
    T = {name: from_rt(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for name in ("odom", "map")}
    velocity, turning = rng.normal(size=3), 2 * rng.normal(size=3)
    message = {
        name: {"position": t[:3, 3].tolist(), "quaternion": quat_from_matrix(t[:3, :3]).tolist()}
        for name, t in T.items()
    }
    message["odom"] |= {"velocity": velocity.tolist(), "angular_velocity": turning.tolist()}
    found = run_receiver(
        tmp_path, "predictPose", f"predictPose({json.dumps(message)}, {frame!r}, {ahead_ms})"
    )
    along = T[frame][:3, :3] @ T["odom"][:3, :3].T @ velocity
    expected = predict_pose(T[frame], along, turning, ahead_ms / 1000)
    assert np.allclose(found["position"], expected[:3, 3], atol=1e-12)
    assert np.allclose(matrix_from_quat(np.array(found["quaternion"])), expected[:3, :3], atol=1e-12)


def test_without_an_imu_the_web_receiver_keeps_the_pose(tmp_path):
    pose = {"position": [1, 2, 3], "quaternion": [0, 0, 0, 1]}
    found = run_receiver(tmp_path, "predictPose", f"predictPose({json.dumps({'odom': pose})}, 'odom', 50)")
    assert found == pose
