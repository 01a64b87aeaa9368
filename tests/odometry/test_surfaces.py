"""The surfaces of a keyframe: planes of the filter's features, taken from their anchors into the image."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.textured_planes import CAMERA, T_BODY_CAM, Planes

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Rig, rays
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import CORE_SIZE, initial_state
from share.types import Frame

STILL = np.zeros(3)
T_CAM1_CAM0 = se3.from_rt(np.eye(3), np.array([-0.05, 0.0, 0.0]))
RIG = Rig(CAMERA, T_BODY_CAM, CAMERA, T_CAM1_CAM0)
T_START = se3.inverse(T_BODY_CAM)  # its camera looks along the world's z from the origin
MOTION = se3.exp(np.array([0.05, -0.1, 0.04, 0.2, 0.1, 0.15]))
WALL = Planes([[0.25, -0.1, 0.4]], seed=5)


def frame(T_world_body: np.ndarray) -> Frame:
    rng = np.random.default_rng(0)
    T = T_world_body @ T_BODY_CAM
    return Frame(0, 0, WALL.seen_from(T, rng), WALL.seen_from(T @ se3.inverse(T_CAM1_CAM0), rng))


@pytest.fixture
def landmarks() -> LandmarkMap:
    """Features of a first keyframe, with depths by stereo."""
    cov = np.full(CORE_SIZE, 1e-3)
    state = initial_state(0, T_START, STILL, STILL, STILL, T_BODY_CAM, cov)
    found = LandmarkMap(state, RIG, InertialConfig())
    keyframe, first = found.add_keyframe(STILL), frame(T_START)
    found.admit_features(first, keyframe, found.find_corners(first, found.occupied_px()))
    assert len(state.rho) > 50
    return found


def lie_on_the_wall(landmarks: LandmarkMap) -> None:
    """Replace estimated depths and slants of the features by the true ones."""
    s, plane = landmarks.state, WALL.planes[0]
    s.rho[:] = rays(s.ray) @ plane
    landmarks.appearance.slant[:] = plane[:2] @ landmarks.appearance.ray_per_px


def move(landmarks: LandmarkMap, T_world_body: np.ndarray) -> None:
    """Take the body elsewhere, and the features' positions in the image with it."""
    s = landmarks.state
    points = rays(s.ray) / (rays(s.ray) @ WALL.planes[0])[:, None]
    s.T[:] = T_world_body
    px = CAMERA.project(se3.transform(se3.inverse(T_world_body @ T_BODY_CAM), points))
    landmarks.appearance.last_px[:] = px


@pytest.mark.parametrize("motion", [np.eye(4), MOTION], ids=["anchor", "moved"])
def test_surfaces_are_the_slanted_wall(landmarks: LandmarkMap, motion: np.ndarray) -> None:
    lie_on_the_wall(landmarks)
    T = motion @ T_START
    move(landmarks, T)
    found = landmarks.surfaces(frame(T))
    assert len(found.uv) == len(landmarks.state.rho)
    np.testing.assert_allclose(found.plane, WALL.surfaces(T @ T_BODY_CAM, found.uv), atol=1e-6)
    image = found.with_image(None)
    world = se3.transform(T @ T_BODY_CAM, image.points.astype(np.float64))
    np.testing.assert_allclose(world @ WALL.planes[0], 1, atol=1e-5)


def test_the_sigma_of_inverse_depth_is_taken_into_the_image(landmarks: LandmarkMap) -> None:
    lie_on_the_wall(landmarks)
    T = MOTION @ T_START
    move(landmarks, T)
    s = landmarks.state

    def rho_here(rho: np.ndarray) -> np.ndarray:
        return 1 / se3.transform(se3.inverse(T @ T_BODY_CAM), rays(s.ray) / rho[:, None])[:, 2]

    step = 1e-6
    slope = (rho_here(s.rho + step) - rho_here(s.rho - step)) / (2 * step)
    expected = np.sqrt(s.rho_variance) * np.abs(slope)
    np.testing.assert_allclose(landmarks.surfaces(frame(T)).rho_sigma, expected, rtol=1e-6)
    assert np.ptp(slope) > 0.05


def test_depths_by_stereo_agree_with_the_wall_within_their_sigma(landmarks: LandmarkMap) -> None:
    found = landmarks.surfaces(frame(T_START))
    true = rays(found.uv) @ WALL.planes[0]
    off = ((rays(found.uv) * found.plane).sum(axis=1) - true) / found.rho_sigma
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_without_measured_depth_only_well_known_depths_are_given(landmarks: LandmarkMap) -> None:
    s, single = landmarks.state, Frame(0, 0, np.zeros((480, 640), np.uint8))
    columns = s.features_start + np.arange(len(s.rho))
    sure = np.arange(len(s.rho)) % 3 == 0
    s.cov[columns, columns] = (np.where(sure, 0.05, 0.2) * s.rho) ** 2
    np.testing.assert_allclose(landmarks.surfaces(single).uv, s.ray[sure], atol=1e-6)
    measured = 0.2 * s.rho < 0.05  # a camera pair has measured no depth of what is known worse
    assert 0 < measured[~sure].sum() < (~sure).sum()
    found = landmarks.surfaces(frame(T_START))
    np.testing.assert_allclose(found.uv, s.ray[sure | measured], atol=1e-6)


def test_a_wall_seen_edge_on_or_from_behind_is_left_out(landmarks: LandmarkMap) -> None:
    """Its plane passes through the camera, where its inverse depth is unknown."""
    lie_on_the_wall(landmarks)
    normal = WALL.planes[0] / np.linalg.norm(WALL.planes[0])
    distance_m = 1 / np.linalg.norm(WALL.planes[0])
    for share, count in ((0.5, len(landmarks.state.rho)), (0.99, 0), (1.5, 0)):
        T = se3.from_rt(np.eye(3), share * distance_m * normal) @ T_START
        landmarks.state.T[:] = T
        assert len(landmarks.surfaces(frame(T_START)).uv) == count
