import cv2
import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera, Rig

EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
PLAIN = Camera(640, 480, 385.0, 386.0, 319.5, 239.5)


@pytest.mark.parametrize("camera", [EUROC, PLAIN])
def test_normalise_inverts_projection_everywhere_in_the_image(camera, rng):
    px = rng.uniform((0, 0), (camera.width - 1, camera.height - 1), (5000, 2))
    uv = camera.normalise(px)
    points = np.concatenate([uv, np.ones((5000, 1))], axis=1) * rng.uniform(0.3, 20, (5000, 1))
    assert np.abs(camera.project(points) - px).max() < 1e-9


def test_projection_is_opencvs(rng):
    points = rng.normal((0, 0, 5), 1, (100, 3))
    want, _ = cv2.projectPoints(
        points, np.zeros((3, 1)), np.zeros((3, 1)), EUROC.K, np.array(EUROC.distortion)
    )
    assert np.abs(EUROC.project(points) - want.reshape(-1, 2)).max() < 1e-9


def test_points_behind_the_camera_project_to_nan():
    assert np.isnan(PLAIN.project(np.array([[0.0, 0, -1], [0, 0, 0]]))).all()


def test_inside_counts_pixel_centres():
    px = np.array([[0, 0], [639, 479], [-0.1, 5], [639.1, 5]], float)
    assert PLAIN.is_inside(px).tolist() == [True, True, False, False]
    assert PLAIN.is_inside(px, border=1).tolist() == [False, False, False, False]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"width": 0}, "resolution"),
        ({"fx": -1.0}, "focal"),
        ({"distortion": (0.1,)}, "distortion"),
        ({"model": "equidistant"}, "0 coefficients, expected 4 of equidistant"),
        ({"model": "omni"}, "'omni' is not known; known: radtan, equidistant"),
        ({"cx": float("nan")}, "finite"),
    ],
)
def test_impossible_values_are_refused_by_name(change, says):
    values = {"width": 640, "height": 480, "fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0} | change
    with pytest.raises(ValueError, match=says):
        Camera(**values)


def test_rig_wants_extrinsics_with_every_second_camera():
    with pytest.raises(ValueError, match="T_cam1_cam0"):
        Rig(PLAIN, np.eye(4), cam1=PLAIN)
    with pytest.raises(ValueError, match="rigid"):
        Rig(PLAIN, 2 * np.eye(4))


@pytest.mark.parametrize("seconds", [1.1, -20.0, float("nan"), float("inf")])
def test_rig_wants_a_timeshift_of_at_most_a_second(seconds):
    with pytest.raises(ValueError, match="timeshift_s"):
        Rig(PLAIN, np.eye(4), timeshift_s=seconds)


def test_a_rigs_kind_names_its_sensors():
    T = np.eye(4)
    T[0, 3] = -0.05
    stereo = Rig(PLAIN, np.eye(4), cam1=PLAIN, T_cam1_cam0=T)
    assert (stereo.kind, stereo.baseline) == ("stereo", pytest.approx(0.05))
    assert Rig(PLAIN, np.eye(4), depth=PLAIN, T_depth_cam0=np.eye(4)).kind == "rgbd"


@pytest.mark.parametrize("metres", [0.0, 0.004, 2.1, 49.999])
def test_a_baseline_that_is_not_in_metres_is_refused(metres: float) -> None:
    camera = Camera(640, 480, 385.0, 385.0, 320.0, 240.0)
    T = np.eye(4)
    T[0, 3] = -metres
    with pytest.raises(ValueError, match=r"T_cam1_cam0: the cameras are .* m apart.*in metres"):
        Rig(camera, np.eye(4), camera, T)


def test_rounded_extrinsics_become_the_nearest_rigid_transform():
    """Products of a rounded one are not rigid, and no loop of that agent could be verified."""
    exact = se3.exp(np.array([0.4, -1.1, 0.7, 0.02, 0.01, -0.03]))
    held = Rig(PLAIN, np.round(exact, 3)).T_body_cam0
    assert np.abs(held[:3, :3] @ held[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.abs(held - exact).max() < 1e-3
    as_printed = np.round(exact, 9)
    assert Rig(PLAIN, as_printed).T_body_cam0.tobytes() == as_printed.tobytes()


def test_sensors_far_apart_are_refused():
    with pytest.raises(ValueError, match="T_body_cam0: is more than 1000 m away"):
        Rig(PLAIN, se3.exp(np.array([0, 0, 0, 1500.0, 0, 0])))
