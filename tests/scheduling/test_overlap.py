"""Overlap of view frusta: exact cases, Monte Carlo, symmetry."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from share.config import ControlConfig
from share.errors import ConfigError
from share.geometry.camera import Camera
from share.geometry.se3 import exp, transform
from share.plain_data import from_mapping
from share.scheduling.merge_gate import Frustum, SampledFrustum, overlap_volumes
from share.types import F64

WIDE = Frustum(math.radians(87), math.radians(58), 0.3, 5.0)
NARROW = Frustum(math.radians(50), math.radians(40), 0.5, 3.0)
USUAL, OTHER = SampledFrustum(WIDE, 0.5), SampledFrustum(NARROW, 0.5)
FINE, OTHER_FINE = SampledFrustum(WIDE, 0.12), SampledFrustum(NARROW, 0.12)
seeds = st.integers(0, 10_000)


def poses(seed: int, count: int, metres: float = 3.0) -> F64:
    """Random poses in a cube of this side (count, 4, 4)."""
    rng = np.random.default_rng(seed)
    return exp(np.hstack([rng.normal(0, 1, (count, 3)), rng.uniform(0, metres, (count, 3))]))


def shifted(x: float = 0, y: float = 0, z: float = 0) -> F64:
    return exp(np.array([0, 0, 0, x, y, z], dtype=float))


def ious(a: SampledFrustum, T_w_a: F64, b: SampledFrustum, T_w_b: F64) -> F64:
    """V_overlap / V_union (N,), 0 to 1."""
    overlap = overlap_volumes(a, T_w_a, b, T_w_b)
    return np.asarray(overlap / (a.frustum.volume + b.frustum.volume - overlap))


def test_frustum_from_a_calibration() -> None:
    frustum = Frustum.from_camera(Camera(640, 480, 320.0, 240.0, 319.5, 239.5), 0.3, 5.0)
    assert frustum.slopes == (pytest.approx(1.0), pytest.approx(1.0))
    assert Frustum.from_camera(Camera(8192, 480, 1.0, 240.0, 0, 0), 0.3, 5.0).horizontal_rad < math.pi


def test_volume_by_hand() -> None:
    half = math.pi / 2  # 1 to 4 m, 90 degrees each way: 4/3 (64 - 1) = 84
    assert Frustum(half, half, 1, 4).volume == pytest.approx(84, abs=1e-12)


def test_a_view_overlaps_itself_completely() -> None:
    for T in poses(0, 20):
        assert ious(USUAL, T, USUAL, T[None])[0] == 1
        assert overlap_volumes(USUAL, T, USUAL, T[None])[0] == WIDE.volume


@pytest.mark.parametrize("step", [0.25, 1.0, 2.2, 4.0, 4.7, 5.5])
def test_overlap_after_a_step_forward(step: float) -> None:
    """The overlap is the part of the rear frustum that is in the front one, from its near plane on."""
    sx, sy = WIDE.slopes
    expected = 4 / 3 * sx * sy * max(0.0, (WIDE.far_m - step) ** 3 - WIDE.near_m**3)
    got = overlap_volumes(FINE, np.eye(4), FINE, shifted(z=step)[None])[0]
    assert got == pytest.approx(expected, abs=0.015 * WIDE.volume)
    assert (
        overlap_volumes(FINE, np.eye(4), FINE, shifted(z=step)[None])[0]
        == overlap_volumes(FINE, shifted(z=step), FINE, np.eye(4)[None])[0]
    )


def test_overlap_after_a_step_aside() -> None:
    """At depth z both see a width of 2 z tan - step where that is positive."""
    sx, sy = WIDE.slopes
    depth = np.linspace(WIDE.near_m, WIDE.far_m, 20_001)
    expected = np.trapezoid(np.maximum(0, 2 * sx * depth - 1.5) * 2 * sy * depth, depth)
    assert overlap_volumes(FINE, np.eye(4), FINE, shifted(x=1.5)[None])[0] == pytest.approx(
        expected, abs=0.01 * WIDE.volume
    )


def test_opposite_and_distant_views_do_not_overlap() -> None:
    back = exp(np.array([0, math.pi, 0, 0, 0, 0]))
    others = np.array([back, shifted(z=50), shifted(x=20)])
    assert overlap_volumes(USUAL, np.eye(4), USUAL, others).tolist() == [0, 0, 0]
    assert ious(USUAL, np.eye(4), USUAL, others).tolist() == [0, 0, 0]
    assert overlap_volumes(USUAL, np.eye(4), USUAL, np.zeros((0, 4, 4))).shape == (0,)


@pytest.mark.parametrize("seed", range(6))
def test_overlap_agrees_with_monte_carlo(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frustum = Frustum(0.9, 0.6, 0.1, 0.5)
    T_a_b = exp(np.hstack([rng.normal(0, 0.2, 3), rng.normal(0, 0.05, 3)]))
    sx, sy = frustum.slopes
    top = np.array([sx * 0.5, sy * 0.5, 0.5])
    points = rng.uniform([-top[0], -top[1], 0.1], top, (400_000, 3))
    in_a, in_b = (
        (p[:, 2] >= 0.1)
        & (p[:, 2] <= 0.5)
        & (np.abs(p[:, 0]) <= sx * p[:, 2])
        & (np.abs(p[:, 1]) <= sy * p[:, 2])
        for p in (points, transform(np.linalg.inv(T_a_b), points))
    )
    expected = (in_a & in_b).mean() * 4 * top[0] * top[1] * 0.4
    one = SampledFrustum(frustum, 0.01)
    got = overlap_volumes(one, np.eye(4), one, T_a_b[None])[0]
    assert got == pytest.approx(expected, abs=0.01 * frustum.volume)


@given(seeds)
def test_overlap_is_symmetric_and_between_zero_and_the_volume(seed: int) -> None:
    a, b = poses(seed, 2)
    assert overlap_volumes(USUAL, a, USUAL, b[None])[0] == overlap_volumes(USUAL, b, USUAL, a[None])[0]
    assert 0 <= ious(USUAL, a, USUAL, b[None])[0] <= 1
    assert 0 <= overlap_volumes(USUAL, a, USUAL, b[None])[0] <= WIDE.volume * (1 + 1e-12)


@given(seeds)
def test_overlap_does_not_depend_on_the_origin_of_the_world(seed: int) -> None:
    a, b, moved = poses(seed, 3, 10.0)
    assert ious(USUAL, moved @ a, USUAL, (moved @ b)[None])[0] == pytest.approx(
        ious(USUAL, a, USUAL, b[None])[0], abs=1e-3
    )


@given(seeds)
@settings(max_examples=30)
def test_a_batch_gives_the_same_as_single_views(seed: int) -> None:
    a, *others = poses(seed, 8, 12.0)
    together = overlap_volumes(USUAL, a, USUAL, np.array(others))
    assert together.tolist() == [overlap_volumes(USUAL, a, USUAL, other[None])[0] for other in others]


def test_the_default_grid_has_the_documented_accuracy() -> None:
    views = poses(5, 80)
    wrong = [
        ious(USUAL, a, USUAL, b[None])[0] - ious(FINE, a, FINE, b[None])[0]
        for a, b in zip(views[::2], views[1::2], strict=True)
    ]
    assert np.sqrt(np.mean(np.square(wrong))) < 0.01


@pytest.mark.parametrize(
    "frustum", [Frustum(1.5, 1.0, 0.3, 5), Frustum(0.2, 0.1, 1, 2), Frustum(3.0, 3.0, 0, 1)]
)
def test_bounding_sphere_contains_all_corners(frustum: Frustum) -> None:
    sx, sy = frustum.slopes
    z, radius = frustum.bounding_sphere
    far = [math.hypot(d * sx, d * sy, d - z) for d in (frustum.near_m, frustum.far_m)]
    assert max(far) == pytest.approx(radius)


@given(seeds)
def test_two_different_cameras(seed: int) -> None:
    """The overlap is symmetric, within the smaller frustum, and the same in a batch."""
    a, *others = poses(seed, 6, 6.0)
    together = overlap_volumes(USUAL, a, OTHER, np.array(others))
    assert together.tolist() == [overlap_volumes(OTHER, b, USUAL, a[None])[0] for b in others]
    assert (together <= NARROW.volume * 1.1).all()
    union = WIDE.volume + NARROW.volume - together
    assert ious(USUAL, a, OTHER, np.array(others)).tolist() == (together / union).tolist()


def test_two_different_cameras_agree_with_a_finer_grid() -> None:
    views = poses(7, 160, 2.0)
    pairs = list(zip(views[::2], views[1::2], strict=True))
    rough = np.array([overlap_volumes(USUAL, a, OTHER, b[None])[0] for a, b in pairs])
    fine = np.array([overlap_volumes(FINE, a, OTHER_FINE, b[None])[0] for a, b in pairs])
    assert (fine > 1).sum() >= 10
    assert np.abs(rough - fine).max() < 0.1 * NARROW.volume


def test_a_narrow_view_inside_a_wide_one() -> None:
    """From the same pose the narrow camera sees nothing that the wide one does not."""
    got = overlap_volumes(FINE, np.eye(4), OTHER_FINE, np.eye(4)[None])[0]
    assert got == pytest.approx(NARROW.volume, rel=0.02)


@pytest.mark.parametrize("interval_m", [1e-3, 50.0])
@pytest.mark.parametrize("frustum", [Frustum(3.0, 3.0, 0, 1), Frustum(0.01, 3.0, 0.3, 5)])
def test_the_number_of_sample_points_is_bounded_for_any_interval(frustum: Frustum, interval_m: float) -> None:
    assert 9 <= SampledFrustum(frustum, interval_m).points.shape[1] <= 2_048_000


def test_a_far_plane_before_the_near_plane_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"far_m: 0.2 m is not beyond the near plane, 0.3 m"):
        from_mapping(ControlConfig, {"far_m": 0.2}, "control")


@pytest.mark.parametrize("frustum", [(0.0, 1.0, 0.3, 5.0), (1.0, math.pi, 0.3, 5.0), (1.0, 1.0, 5.0, 5.0)])
def test_an_invalid_frustum_is_refused(frustum: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="frustum: "):
        Frustum(*frustum)
