"""`board:` moves all axes, keeps the board in view of both cameras, and begins at rest."""

import numpy as np
import pytest

from share.errors import UsageError
from share.geometry import se3
from share.lab.emulate.motion.board import INITIAL_STILL_S, board_path
from share.lab.emulate.motion.motion_plan import plan_motions
from share.lab.emulate.motion.spec import BoardSpec, parse_motion
from share.lab.emulate.world.scenes import make_scene_layout
from share.sensors.profile import load_profile
from share.types import AgentKind

SECONDS = 40.0


@pytest.fixture(scope="module")
def room():
    return make_scene_layout("board", 1)


def stamps(path, hz):
    return np.arange(path.start_ns, path.end_ns, round(1e9 / hz))


def exercised(room, seed=0, **options):
    return board_path(room, BoardSpec(**options), SECONDS, np.random.default_rng((seed, 5)))


def seen(room, path, rig, t):
    """Where both cameras see the corners (2, N, K, 2) px, NaN where they do not, of the IMU's own path."""
    points = se3.transform(room.target.T_world_target, room.target.target.corners)
    path = path.with_axes(rig.T_body_cam0[:3, :3].T)
    out = []
    for camera, T_body_cam in (
        (rig.cam0, rig.T_body_cam0),
        (rig.cam1, rig.T_body_cam0 @ se3.inverse(rig.T_cam1_cam0)),
    ):
        T = se3.inverse(path.poses(t) @ T_body_cam)
        local = np.einsum("nij,kj->nki", T[:, :3, :3], points) + T[:, None, :3, 3]
        px = camera.project(local)
        ahead = np.hypot(*np.moveaxis(local[..., :2], -1, 0)) < 1.2 * local[..., 2]  # the lens model's range
        px[~(camera.is_inside(px, 3) & ahead)] = np.nan
        out.append(px)
    return np.stack(out)


@pytest.mark.parametrize("name", ["d435i", "euroc"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_both_cameras_see_most_of_the_board_everywhere_in_the_image(room, name, seed):
    rig = load_profile(name).rig()
    path = exercised(room, seed)
    px = seen(room, path, rig, stamps(path, 10))
    share = np.isfinite(px[..., 0]).mean(axis=2)
    assert (share >= 0.8).mean() > 0.85
    assert (share >= 0.5).all()
    for camera, of_one in zip((rig.cam0, rig.cam1), px, strict=True):
        flat = of_one[np.isfinite(of_one[..., 0])]
        cells, _, _ = np.histogram2d(*flat.T, bins=(8, 6), range=((0, camera.width), (0, camera.height)))
        assert (cells > 0).mean() >= 0.95  # a strong lens leaves a corner or two empty


def test_all_axes_are_excited(room):
    path = exercised(room)
    t = stamps(path, 50)
    gyro, force = path.inertial(t)
    assert (np.sqrt((gyro**2).mean(axis=0)) > 0.35).all()
    assert np.abs(gyro).max() < 5
    R = path.poses(t)[:, :3, :3]
    own = np.einsum("nij,nj->ni", R, force) - (0, 0, 9.81)  # without gravity, in the world
    assert (np.sqrt((own**2).mean(axis=0)) > 0.4).all()
    tilt = np.degrees(np.arccos(-R[:, :, 2] @ room.target.T_world_target[:3, 2]))
    assert tilt.max() > 35
    away = np.linalg.norm(path.poses(t)[:, :3, 3] - room.target.T_world_target[:3, 3], axis=1)
    assert away.min() < 0.75
    assert away.max() > 1.2


def test_it_begins_at_rest(room):
    path = exercised(room)
    gyro, force = path.inertial(path.start_ns + np.arange(0, round((INITIAL_STILL_S - 0.1) * 1e9), 10**7))
    assert np.abs(gyro).max() < 1e-9
    assert np.abs(force - force[0]).max() < 1e-7


def test_a_slow_one_pauses(room):
    slow = exercised(room, vigour=0.3)
    t = stamps(slow, 50)
    speed = np.linalg.norm(slow.inertial(t)[0], axis=1)
    usual = np.linalg.norm(exercised(room).inertial(t)[0], axis=1)
    assert (speed < 0.02)[t > slow.start_ns + 4e9].mean() > 0.15
    assert np.median(speed) < 0.3 * np.median(usual)


def test_inertial_readings_follow_turned_axes(room):
    path = exercised(room)
    R = se3.so3_exp(np.array([0.3, -1.2, 0.7]))
    t = stamps(path, 7)
    turned = path.with_axes(R)
    np.testing.assert_allclose(turned.poses(t)[:, :3, :3], path.poses(t)[:, :3, :3] @ R, atol=1e-12)
    for before, after in zip(path.inertial(t), turned.inertial(t), strict=True):
        np.testing.assert_allclose(after, before @ R, atol=1e-9)


def test_a_plan_contains_the_board_motion(room):
    found = plan_motions(["cal=board:vigour=0.5,seconds=10"], room, SECONDS, 4)
    (agent,) = found.agents
    assert (agent.name, agent.kind, agent.has_camera_axes) == ("cal", AgentKind.AR, True)
    assert agent.path.end_ns - agent.path.start_ns == 10_000_000_000
    again, other = (
        plan_motions(["cal=board:vigour=0.5,seconds=10"], room, SECONDS, s).agents[0] for s in (4, 5)
    )
    t = stamps(agent.path, 3)
    np.testing.assert_array_equal(agent.path.poses(t), again.path.poses(t))
    assert np.abs(agent.path.poses(t) - other.path.poses(t)).max() > 0.05


def test_an_impossible_board_motion_is_refused_in_one_line(room):
    with pytest.raises(UsageError, match="the whitewall has no calibration board; use --scene board"):
        plan_motions(["board:"], make_scene_layout("whitewall", 1), 20, 1)
    with pytest.raises(UsageError, match="too small for distance=2"):
        plan_motions(["board:distance=2"], room, 20, 1)
    with pytest.raises(UsageError, match="vigour=9: expected"):
        parse_motion("board:vigour=9")
