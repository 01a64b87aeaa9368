"""The tilts of two cameras, known from gravity: what they add to matched keypoints and to aligned images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers import textured_planes
from helpers.atlas_sim import UP_SIGMA, Walker
from helpers.hellos import rig_of
from helpers.place_sim import bodies, sights
from helpers.textured_planes import T_BODY_CAM, Planes

from share.geometry import se3
from share.mapping.loops import KeyframeKey
from share.mapping.recognition.keyframe_views import KeyframeViews
from share.mapping.recognition.patch_alignment import ImageView, align_images
from share.mapping.recognition.relative_tilt import UNKNOWN_TILT, RelativeTilt
from share.mapping.recognition.verification import Verification, verify
from share.types import F64

UP = np.array([0.0, -0.8, 0.6])  # in the world
RIG = rig_of()


@dataclasses.dataclass(frozen=True)
class Camera:
    T_body_cam0: F64
    up: F64
    up_sigma: float = 0.0


def test_a_rotation_about_up_is_not_known_and_a_tilt_is() -> None:
    T = se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    up_q = np.array([0.0, 0.6, 0.8])
    off = np.array([0.01, -0.02, 0.005, 0.0, 0.0, 0.0])
    tilt = RelativeTilt(up_q, se3.so3_exp(off[:3]) @ T[:3, :3] @ up_q, 0.01)
    H, g = tilt.equations(T)
    across = off - np.concatenate([tilt.up_c * (off[:3] @ tilt.up_c), np.zeros(3)])
    np.testing.assert_allclose(H @ off, g, rtol=0.03)
    np.testing.assert_allclose(off @ H @ off, (np.linalg.norm(across) / 0.01) ** 2, rtol=0.03)
    about = np.concatenate([T[:3, :3] @ up_q, np.zeros(3)])
    assert about @ H @ about == pytest.approx(0.0, abs=1e-9)
    assert not H[3:].any()


def test_the_directions_are_those_of_the_cameras_and_their_sigmas_add_up() -> None:
    T_body_cam = se3.exp(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.1]))
    upright, moving = Camera(T_body_cam, np.array([0.0, 0.0, 1.0])), Camera(np.eye(4), UP, 0.02)
    tilt = RelativeTilt.between(upright, moving)
    np.testing.assert_allclose(T_body_cam[:3, :3] @ tilt.up_q, upright.up, atol=1e-12)
    np.testing.assert_array_equal(tilt.up_c, UP)
    assert tilt.sigma == pytest.approx(np.hypot(0.02, np.radians(0.1) * np.sqrt(2)))


def test_without_both_directions_nothing_is_known() -> None:
    known, unknown = Camera(np.eye(4), UP), Camera(np.eye(4), np.zeros(3))
    for pair in ((known, unknown), (unknown, known), (unknown, unknown)):
        assert RelativeTilt.between(*pair) is UNKNOWN_TILT
    assert not any(part.any() for part in UNKNOWN_TILT.equations(np.eye(4)))


def tilt_deg(T_c_q: F64, true: F64, up: F64) -> float:
    """Angle between the query's up direction (3,) by either pose."""
    return float(np.degrees(np.arccos(np.clip((T_c_q[:3, :3] @ up) @ (true[:3, :3] @ up), -1, 1))))


def test_few_features_do_not_tilt_a_verified_pose() -> None:
    T = se3.exp(np.array([0.02, 0.05, 0.01, 0.3, 1.1, 0.1]))

    def seen(seed: int, with_up: bool) -> Verification:
        query, candidate = sights(seed, T, n=70)
        none = np.zeros(3)
        if not with_up:
            query, candidate = (dataclasses.replace(one, up=none) for one in (query, candidate))
        found = verify(query, candidate)
        assert isinstance(found, Verification), found
        return found

    up = bodies(T)[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    known, images_alone = (
        np.array([tilt_deg(seen(seed, with_up).T_c_q, bodies(T), up) for seed in range(6)])
        for with_up in (True, False)
    )
    assert known.max() < 0.1
    assert np.sqrt((known**2).mean()) < 0.85 * np.sqrt((images_alone**2).mean())


def upright(view: ImageView, T_world_body: F64) -> ImageView:
    return dataclasses.replace(view, up=T_world_body[:3, :3].T @ UP)


def central(view: ImageView) -> ImageView:
    """The image with the features within 0.3 of its centre only."""
    source = view.source
    kept = np.abs(source.uv).max(axis=1) < 0.3
    few = {name: getattr(source, name)[kept] for name in ("uv", "plane", "rho_sigma")}
    return dataclasses.replace(view, source=dataclasses.replace(source, **few))


def test_few_far_patches_do_not_tilt_an_aligned_pose() -> None:
    """Walls some eight metres away, seen from other heights: a tilt looks like a height."""
    far = Planes([[0.02, 0.01, 0.12], [-0.1, 0.0, 0.09]], seed=3)
    T_world_c = se3.inverse(T_BODY_CAM)
    T_world_q = se3.exp(np.array([0.02, 0.03, 0.0, 0.2, 0.5, 0.1])) @ T_world_c
    true, rng = se3.inverse(T_world_c) @ T_world_q, np.random.default_rng(2)
    query, candidate = (
        central(textured_planes.image_view(far, T, rng, count=200)) for T in (T_world_q, T_world_c)
    )
    alone = align_images(true, query, candidate)
    known = align_images(true, upright(query, T_world_q), upright(candidate, T_world_c))
    assert alone is not None and known is not None
    up, error = T_world_q[:3, :3].T @ UP, se3.log(se3.inverse(true) @ known.T_c_q)
    assert tilt_deg(known.T_c_q, true, up) < 0.6 * tilt_deg(alone.T_c_q, true, up)
    assert np.linalg.norm(error[3:]) < 0.6 * np.linalg.norm(se3.log(se3.inverse(true) @ alone.T_c_q)[3:])
    assert se3.position_sigma(known.cov) < se3.position_sigma(alone.cov)


@pytest.mark.parametrize("is_image", [True, False])
def test_the_views_of_a_keyframe_know_its_up_direction_and_its_sigma(is_image: bool) -> None:
    keyframe = Walker("ann", 0, n=1).keyframes[0]
    views = KeyframeViews()
    if is_image:
        room = Planes([[0.1, 0.05, 0.4]], seed=3)
        image = textured_planes.image_view(room, np.eye(4), np.random.default_rng(0)).source
        keyframe = dataclasses.replace(keyframe, image=image)
    views.add(0, KeyframeKey("ann", 0), keyframe, RIG)
    seen = views.image(0) if is_image else views.by_node[0]
    assert seen is not None
    assert (seen.up == keyframe.up).all() and seen.up_sigma == keyframe.up_sigma == UP_SIGMA


def test_images_that_contradict_the_tilts_decide_alone() -> None:
    """A camera that sits on its IMU by three degrees otherwise than is said: the loop has to tell."""
    room, T_world_c = (
        Planes([[0.1, 0.05, 0.4], [-0.6, 0.0, 0.3], [0.0, 0.7, 0.25]], 3),
        se3.inverse(T_BODY_CAM),
    )
    T_world_q = se3.exp(np.array([0.05, 0.12, 0.03, 0.15, -0.05, 0.1])) @ T_world_c
    true, rng = se3.inverse(T_world_c) @ T_world_q, np.random.default_rng(1)
    query, candidate = (textured_planes.image_view(room, T, rng) for T in (T_world_q, T_world_c))
    turned = se3.so3_exp(np.radians(3.0) * np.cross(UP, [1.0, 0.0, 0.0])) @ T_world_q[:3, :3]
    wrong = dataclasses.replace(query, up=turned.T @ UP)
    alone = align_images(true, query, candidate)
    found = align_images(true, wrong, upright(candidate, T_world_c))
    assert alone is not None and found is not None
    np.testing.assert_array_equal(found.T_c_q, alone.T_c_q)
