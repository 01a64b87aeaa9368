"""Loops by patches: exact to a millimetre, honest about it, and refused where the images contradict."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers import textured_planes
from helpers.textured_planes import CAMERA, T_BODY_CAM, Planes

from share.geometry import se3
from share.geometry.camera import rays
from share.mapping.recognition import patch_alignment
from share.mapping.recognition.depth_scale import DepthScale
from share.mapping.recognition.patch_alignment import (
    ImageView,
    align_from_map,
    align_images,
    align_undetermined,
    align_verified,
)
from share.mapping.recognition.verification import Refusal, Verification
from share.types import KeyframeImage, View
from share.vision.keyframe_images import compress

ROOM = [[0.1, 0.05, 0.4], [-0.6, 0.0, 0.3], [0.0, 0.7, 0.25]]  # a back wall, a side wall, a floor
T_WORLD_C = se3.inverse(T_BODY_CAM)  # its camera is the world's
MOTIONS = [
    np.array([0.05, 0.12, 0.03, 0.15, -0.05, 0.1]),
    np.array([-0.04, -0.1, 0.2, -0.12, 0.1, -0.08]),
    np.array([0.1, 0.02, -0.1, 0.02, -0.15, 0.2]),
]
OFF = np.array([0.004, -0.003, 0.003, 0.015, 0.01, -0.012])  # as exact as ORB features: 0.33 degrees, 22 mm


@pytest.fixture(scope="module")
def room() -> Planes:
    return Planes(ROOM, seed=3)


def moved(motion: np.ndarray) -> np.ndarray:
    """T_world_body (4, 4) of a body whose camera has moved from the candidate's."""
    return se3.exp(motion) @ T_WORLD_C


@pytest.fixture(scope="module")
def pairs(room: Planes) -> list[tuple[np.ndarray, ImageView, ImageView]]:
    """T_c_q of the bodies, query and candidate."""
    rng = np.random.default_rng(1)
    candidate = textured_planes.image_view(room, T_WORLD_C, rng)
    return [
        (
            se3.inverse(T_WORLD_C) @ moved(motion),
            textured_planes.image_view(room, moved(motion), rng),
            candidate,
        )
        for motion in MOTIONS
    ]


def error(true: np.ndarray, found: np.ndarray) -> np.ndarray:
    """xi (6,) with found = true Exp(xi): rotation, rad, and translation, m."""
    return np.asarray(se3.log(se3.inverse(true) @ found))


def test_a_pose_is_refined_to_a_millimetre_and_hundredths_of_a_degree(pairs) -> None:
    for true, query, candidate in pairs:
        found = align_images(true @ se3.exp(OFF), query, candidate)
        assert found is not None
        xi = error(true, found.T_c_q)
        assert np.degrees(np.linalg.norm(xi[:3])) < 0.03
        assert np.linalg.norm(xi[3:]) < 0.0015
        assert found.inliers > 0.9 * found.found and found.found > 0.9 * found.predicted
        assert found.found > 100  # features of both
        assert abs(found.depth_scale.log) < 3 * found.depth_scale.sigma < 0.03


def nees(xi: np.ndarray, cov: np.ndarray) -> float:
    return float(xi @ np.linalg.solve(cov, xi))


@pytest.mark.long
def test_the_covariance_is_that_of_right_perturbations_of_the_bodies_pose(
    room: Planes, pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With errors of depth and of aligned pixels as stated: the mean NEES of 6 degrees of freedom, and the
    spread in every direction. Robust weights cost a little."""
    rng, sigma, trials = np.random.default_rng(2), 0.02, 60
    true, *images = pairs[0]
    poses = {id(image): T for image, T in zip(images, (moved(MOTIONS[0]), T_WORLD_C), strict=True)}
    whitened, squared = [], []

    def aligned(T: np.ndarray, source: ImageView, target: ImageView, level: int):
        """The positions that a perfect alignment finds, with noise."""
        T = se3.inverse(poses[id(target)] @ T_BODY_CAM) @ poses[id(source)] @ T_BODY_CAM
        plane = room.surfaces(poses[id(source)] @ T_BODY_CAM, source.uv)
        points = rays(source.uv) / (rays(source.uv) * plane).sum(axis=1, keepdims=True)
        px = CAMERA.project(se3.transform(T, points))
        index = np.flatnonzero(CAMERA.is_inside(px, 6.0))
        px = px[index] + rng.normal(0, 0.2 * 2**level, (len(index), 2))
        return patch_alignment._AlignedFeatures(index, px, len(index))

    monkeypatch.setattr(patch_alignment, "_align", aligned)
    for _ in range(trials):
        views = []
        for image in images:
            jpeg, T = image.source.jpeg, poses[id(image)]
            views.append(textured_planes.with_depth_errors(room, T, jpeg, image.uv, rng, sigma))
            views[-1].__dict__["pyramid"] = image.pyramid  # decoded once
            poses[id(views[-1])] = T
        found = align_images(true, *views)
        assert found is not None
        xi = error(true, found.T_c_q)
        whitened.append(np.linalg.solve(np.linalg.cholesky(found.cov), xi))
        squared.append(nees(xi, found.cov))
        assert found.inliers > 0.9 * found.found
    assert 4.2 < np.mean(squared) < 7.0  # 5 directions as stated, the length surer
    spread = np.linalg.eigvalsh(np.cov(np.array(whitened).T))
    assert spread[1] > 0.4 and spread[-1] < 1.8


def test_an_error_that_all_depths_of_a_view_share_is_in_the_covariance(room: Planes, pairs) -> None:
    """As of a camera without a baseline: the pose is off with the depths' scale, and says so."""
    rng, sigma, squared = np.random.default_rng(4), 0.03, []
    for true, *images in pairs:
        for _ in range(8):
            views = [scaled_depths(image, float(np.exp(rng.normal(0, sigma))), sigma) for image in images]
            found = align_images(true, *views)
            assert found is not None and found.depth_scale is not None
            squared.append(nees(error(true, found.T_c_q), found.cov))
            assert found.depth_scale.shared_sigma == pytest.approx(2**0.5 * sigma, rel=1e-3)
    assert 1.0 < np.mean(squared) < 7.0


def test_depths_known_to_another_camera_put_the_pose_right(pairs) -> None:
    """One view's depths are 4 % too large, within its sigma; the other's are sure."""
    true, query, candidate = pairs[0]
    found = align_images(true, scaled_depths(query, 1.04, 0.04), scaled_depths(candidate, 1.0, 0.002))
    assert found is not None and found.depth_scale is not None
    assert np.linalg.norm(error(true, found.T_c_q)[3:]) < 0.0015
    assert found.depth_scale.log == pytest.approx(np.log(1.04), abs=0.004)


def scaled_depths(view: ImageView, scale: float, sigma: float) -> ImageView:
    """The view with depths `scale` times as large, and this relative sigma of each."""
    plane = view.plane / scale
    rho = (rays(view.uv) * plane).sum(axis=1)
    source = dataclasses.replace(view.source, plane=plane, rho_sigma=sigma * rho)
    return ImageView(source, CAMERA, T_BODY_CAM)


def test_the_covariance_of_aligned_images_is_not_too_small(room: Planes, pairs) -> None:
    """Here patches align better than stated, to less than 0.2 px."""
    rng, sigma, squared = np.random.default_rng(2), 0.01, []
    for true, *images in pairs:
        poses = true, np.eye(4)
        for _ in range(5):
            views = (
                textured_planes.with_depth_errors(room, T_WORLD_C @ T, v.source.jpeg, v.uv, rng, sigma)
                for v, T in zip(images, poses, strict=True)
            )
            found = align_images(true, *views)
            assert found is not None
            squared.append(nees(error(true, found.T_c_q), found.cov))
    assert 1.0 < np.mean(squared) < 7.0


def test_derivatives_of_the_residuals(pairs) -> None:
    true, query, candidate = pairs[0]
    exact = dataclasses.replace(query.source, rho_sigma=np.zeros_like(query.source.rho_sigma))
    query = ImageView(exact, CAMERA, T_BODY_CAM)  # so that residuals are whitened by 0.2 px alone
    T = se3.inverse(T_BODY_CAM) @ true @ T_BODY_CAM
    forward = patch_alignment._align(T, query, candidate, 0)
    assert len(forward.feature) > 40

    def predicted(T: np.ndarray, source: ImageView) -> np.ndarray:
        return -patch_alignment._residuals(T, source, candidate, forward, 1.0, 0.0).r

    at = patch_alignment._residuals(T, query, candidate, forward, 1.0, 0.0)
    step = 1e-6
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = step
        slope = (predicted(se3.exp(xi) @ T, query) - predicted(se3.exp(-xi) @ T, query)) / (2 * step)
        np.testing.assert_allclose(at.J_pose[:, :, k], slope, atol=5e-3)
    source, grown = query.source, 1e-3
    nearer, farther = (
        ImageView(dataclasses.replace(source, plane=source.plane * np.exp(log)), CAMERA, T_BODY_CAM)
        for log in (grown, -grown)
    )
    slope = (predicted(T, nearer) - predicted(T, farther)) / (2 * grown)
    np.testing.assert_allclose(at.J_scale, slope, atol=0.01 * np.abs(slope).max())


def test_residuals_are_whitened_by_pixels_and_depth() -> None:
    """Across the epipolar line by the pixel's error only; along it by the depth's too."""
    rng = np.random.default_rng(3)
    common = rng.normal(0, 2.0, (20, 2))
    common[0] = 0.0  # a known depth
    root = patch_alignment._whitened(np.broadcast_to(np.eye(2), (20, 2, 2)), 0.2, common)
    S = 0.2**2 * np.eye(2) + common[:, :, None] * common[:, None, :]
    np.testing.assert_allclose(root @ S @ root.swapaxes(1, 2), np.broadcast_to(np.eye(2), S.shape), atol=1e-9)


@pytest.mark.parametrize("scale", [1.05, 0.95])
def test_the_scale_of_the_querys_depths_and_what_it_does_to_the_pose(room: Planes, scale: float) -> None:
    rng = np.random.default_rng(4)
    true = se3.inverse(T_WORLD_C) @ moved(MOTIONS[0])
    query = textured_planes.image_view(room, moved(MOTIONS[0]), rng, depth_scale=scale)
    candidate = textured_planes.image_view(room, T_WORLD_C, rng)
    found = align_images(true @ se3.exp(OFF), query, candidate)
    assert found is not None and found.depth_scale is not None
    assert found.depth_scale.log == pytest.approx(np.log(scale), abs=0.01)
    assert 0 < found.depth_scale.sigma < 0.02
    corrected = se3.exp(found.depth_scale.pose_sensitivity * found.depth_scale.log) @ found.T_c_q
    before, after = (np.linalg.norm(error(true, T)[3:]) for T in (found.T_c_q, corrected))
    assert after < 0.5 * before and after < 0.002
    reverse = align_images(se3.inverse(true), candidate, query)
    assert reverse is not None and reverse.depth_scale is not None
    assert reverse.depth_scale.log == pytest.approx(-np.log(scale), abs=0.01)


def verified(T: np.ndarray) -> Verification:
    """What ORB features say."""
    return Verification(T, np.diag([1e-5] * 3 + [1e-4] * 3), 60, 40, None)


def test_a_verified_pose_is_replaced_and_its_covariance_has_a_floor(pairs) -> None:
    true, query, candidate = pairs[0]
    orb = verified(true @ se3.exp(OFF))
    found = align_verified(orb, query, candidate)
    assert isinstance(found, Verification)
    assert np.linalg.norm(error(true, found.T_c_q)[3:]) < 0.0015
    assert found.matches >= found.inliers > 100  # patches, not descriptors
    floor = np.diag([np.radians(0.02) ** 2] * 3 + [0.001**2] * 3)
    assert np.linalg.eigvalsh(found.cov - 4 * floor)[0] > 0
    assert np.trace(found.cov[3:, 3:]) < 0.01**2


def test_a_pose_of_the_map_is_refined(pairs) -> None:
    true, query, candidate = pairs[1]
    found = align_from_map(true @ se3.exp(OFF), query, candidate)
    assert isinstance(found, Verification)
    assert np.linalg.norm(error(true, found.T_c_q)[3:]) < 0.0015


@pytest.mark.parametrize("factor", [1, 2])
def test_a_pose_of_the_map_is_refined_from_further_off_by_coarse_images(pairs, factor: int) -> None:
    """Twice as far off, patches of the whole size are out of reach."""
    true, query, candidate = pairs[1]
    off = true @ se3.exp(factor * OFF)
    at_once = align_images(off, query, candidate, levels=(0,))
    is_in_reach = at_once is not None and at_once.found > 0.7 * at_once.predicted
    assert is_in_reach == (factor == 1)
    found = align_from_map(off, query, candidate)
    assert isinstance(found, Verification) and np.linalg.norm(error(true, found.T_c_q)[3:]) < 0.0015


def test_another_place_is_refused(room: Planes, pairs) -> None:
    """Whatever pose is assumed, its patches are not there."""
    elsewhere = textured_planes.image_view(Planes(ROOM, seed=8), T_WORLD_C, np.random.default_rng(5))
    for true, query, _ in pairs:
        assert align_images(true, query, elsewhere) is None
        refusal = align_from_map(true, query, elsewhere)
        assert isinstance(refusal, Refusal) and "patches align" in refusal.reason


def test_a_quarter_of_the_patches_confirms_no_pose_of_the_map(room: Planes) -> None:
    """They agree with one pose, but most of what should be there is not."""
    rng, true = np.random.default_rng(5), se3.inverse(T_WORLD_C) @ moved(MOTIONS[0])
    query, candidate = (
        textured_planes.image_view(room, T, rng, count=220) for T in (moved(MOTIONS[0]), T_WORLD_C)
    )
    elsewhere = textured_planes.image_view(Planes(ROOM, seed=8), T_WORLD_C, rng)
    assert candidate.pixels is not None and elsewhere.pixels is not None
    mixed, edge = candidate.pixels.copy(), int(0.34 * CAMERA.width)
    mixed[:, edge:] = elsewhere.pixels[:, edge:]
    changed = ImageView(dataclasses.replace(candidate.source, jpeg=compress(mixed)), CAMERA, T_BODY_CAM)
    refusal = align_from_map(true, query, changed)
    assert isinstance(refusal, Refusal) and refusal.reason.endswith("patches align from the map's pose")
    assert refusal.reason[0].isdigit()
    assert isinstance(align_verified(verified(true), query, changed), Verification)


def test_a_pose_that_features_leave_uncertain_is_found_by_the_images(pairs) -> None:
    """From either of two poses that fit, of which one may be elsewhere; not where both are."""
    true, query, candidate = pairs[0]
    near, far = true @ se3.exp(2 * OFF), true @ se3.exp(np.array([0.0, 0.1, 0.0, 0.1, 0.1, 0.0]))
    for poses in ((near,), (near, true @ se3.exp(-OFF)), (near, far), (far, near)):
        found = align_undetermined(Refusal("uncertain", poses), query, candidate)
        assert isinstance(found, Verification)
        assert np.linalg.norm(error(true, found.T_c_q)[3:]) < 0.0015
    for poses in ((), (far,)):
        refused = Refusal("uncertain", poses)
        assert align_undetermined(refused, query, candidate) is refused


def test_a_pose_that_the_images_leave_uncertain_too_is_refused(
    pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    true, query, candidate = pairs[0]
    refused = Refusal("uncertain", (true,))
    assert isinstance(align_undetermined(refused, query, candidate), Verification)
    monkeypatch.setattr(patch_alignment, "_MAX_SIGMA_DEG", 0.01)
    assert align_undetermined(refused, query, candidate) is refused


def test_two_poses_by_which_the_images_align_are_none(pairs, monkeypatch: pytest.MonkeyPatch) -> None:
    true, query, candidate = pairs[0]
    off = true @ se3.exp(10 * OFF)
    monkeypatch.setattr(patch_alignment, "_align_from_map", lambda T, *_: verified(T))
    refused = Refusal("two poses fit", (true, off))
    assert align_undetermined(refused, query, candidate) is refused
    refused = Refusal("two poses fit", (true, true @ se3.exp(0.01 * OFF)))
    assert align_undetermined(refused, query, candidate) is not refused


def test_a_pose_of_the_map_that_is_far_off_is_refused(pairs) -> None:
    true, query, candidate = pairs[0]
    off = np.array([0.0, 0.1, 0.0, 0.1, 0.1, 0.0])
    assert isinstance(align_from_map(true @ se3.exp(off), query, candidate), Refusal)


def test_views_without_common_ground_are_refused(pairs) -> None:
    _, query, candidate = pairs[0]
    behind = T_BODY_CAM @ se3.exp(np.array([0, np.pi, 0, 0, 0, 0])) @ se3.inverse(T_BODY_CAM)
    assert isinstance(align_from_map(behind, query, candidate), Refusal)


def test_a_pose_whose_patches_disagree_is_kept_and_trusted_less(pairs) -> None:
    """Surfaces whose depths are nonsense: patches are found, but no pose explains where."""
    true, query, candidate = pairs[0]
    rng = np.random.default_rng(6)
    wild = dataclasses.replace(
        query.source, plane=query.source.plane * rng.choice([0.93, 1.07], (len(query.uv), 1))
    )
    wild_c = dataclasses.replace(
        candidate.source, plane=candidate.source.plane * rng.choice([0.93, 1.07], (len(candidate.uv), 1))
    )
    views = [ImageView(image, CAMERA, T_BODY_CAM) for image in (wild, wild_c)]
    orb = dataclasses.replace(verified(true), depth_scale=DepthScale(0.01, 0.02))
    kept = align_verified(orb, *views)
    np.testing.assert_array_equal(kept.T_c_q, true)
    shared_sigma = np.hypot(*(view.shared_depth_sigma for view in views))
    assert kept.depth_scale == DepthScale(0.01, 0.02, None, shared_sigma)
    np.testing.assert_allclose(kept.cov, 10 * verified(true).cov)
    assert orb.is_confirmed and not kept.is_confirmed
    refusal = align_from_map(true, *views)
    assert isinstance(refusal, Refusal) and "agree with one pose" in refusal.reason


def damaged_views(view: ImageView) -> list[ImageView]:
    jpeg = view.source.jpeg
    large = compress(np.zeros((CAMERA.height, CAMERA.width + 8), np.uint8))
    empty = KeyframeImage.empty()
    broken = [jpeg[:0], jpeg[:-400], jpeg[::-1].copy(), large]
    images = [dataclasses.replace(view.source, jpeg=data) for data in broken]
    return [ImageView(image, CAMERA, T_BODY_CAM) for image in (*images, empty)]


def test_a_damaged_image_changes_nothing(pairs) -> None:
    """The pose by ORB features stands; one of the map is not confirmed; no features are found."""
    true, query, candidate = pairs[0]
    for broken in damaged_views(query):
        assert broken.pyramid == ()
        assert align_images(true, broken, candidate) is align_images(true, candidate, broken) is None
        orb = verified(true)
        assert align_verified(orb, broken, candidate) is orb
        assert isinstance(align_from_map(true, broken, candidate), Refusal)
        view = broken.describe()
        assert isinstance(view, View) and len(view) == 0


def test_an_image_without_surfaces_is_described_but_not_aligned_alone(pairs) -> None:
    _, query, _ = pairs[0]
    none = ImageView(dataclasses.replace(KeyframeImage.empty(), jpeg=query.source.jpeg), CAMERA, T_BODY_CAM)
    assert np.isnan(none.describe().points).all() and len(none.describe()) > 100
    assert align_images(np.eye(4), none, none) is None
