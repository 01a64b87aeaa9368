"""Overlap of frusta against what can be worked out, and against chance."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from share.config import ControlConfig
from share.control.overlap import Frustum, Overlap
from share.errors import ConfigError
from share.geometry.se3 import exp, transform
from share.types import F64

WIDE = Frustum(math.radians(87), math.radians(58), 0.3, 5.0)
USUAL = Overlap.of(ControlConfig())
FINE = Overlap(WIDE, 0.12)
seeds = st.integers(0, 10_000)


def poses(seed: int, count: int, metres: float = 3.0) -> F64:
    """Anyhow in a cube of this side (count, 4, 4)."""
    rng = np.random.default_rng(seed)
    return exp(np.hstack([rng.normal(0, 1, (count, 3)), rng.uniform(0, metres, (count, 3))]))


def shifted(x: float = 0, y: float = 0, z: float = 0) -> F64:
    return exp(np.array([0, 0, 0, x, y, z], dtype=float))


def test_volume_by_hand() -> None:
    half = math.pi / 2  # 1 to 4 m, 90 degrees each way: 4/3 (64 - 1) = 84
    assert Frustum(half, half, 1, 4).volume == pytest.approx(84, abs=1e-12)


def test_a_view_overlaps_itself_wholly() -> None:
    for T in poses(0, 20):
        assert USUAL.iou(T, T[None])[0] == 1
        assert USUAL.volumes(T, T[None])[0] == WIDE.volume


@pytest.mark.parametrize("step", [0.25, 1.0, 2.2, 4.0, 4.7, 5.5])
def test_a_step_forward_is_as_worked_out(step: float) -> None:
    """Of the rear frustum there remains what is within the front one, from its near end on."""
    sx, sy = WIDE.slopes
    expected = 4 / 3 * sx * sy * max(0.0, (WIDE.far_m - step) ** 3 - WIDE.near_m**3)
    got = FINE.volumes(np.eye(4), shifted(z=step)[None])[0]
    assert got == pytest.approx(expected, abs=0.015 * WIDE.volume)
    assert (
        FINE.volumes(np.eye(4), shifted(z=step)[None])[0] == FINE.volumes(shifted(z=step), np.eye(4)[None])[0]
    )


def test_a_step_aside_is_as_worked_out() -> None:
    """At depth z both see a width of 2 z tan - step, as far as that is positive."""
    sx, sy = WIDE.slopes
    depth = np.linspace(WIDE.near_m, WIDE.far_m, 20_001)
    expected = np.trapezoid(np.maximum(0, 2 * sx * depth - 1.5) * 2 * sy * depth, depth)
    assert FINE.volumes(np.eye(4), shifted(x=1.5)[None])[0] == pytest.approx(expected, abs=0.01 * WIDE.volume)


def test_who_look_away_from_each_other_share_nothing() -> None:
    back = exp(np.array([0, math.pi, 0, 0, 0, 0]))
    others = np.array([back, shifted(z=50), shifted(x=20)])
    assert USUAL.volumes(np.eye(4), others).tolist() == [0, 0, 0]
    assert USUAL.iou(np.eye(4), others).tolist() == [0, 0, 0]
    assert USUAL.volumes(np.eye(4), np.zeros((0, 4, 4))).shape == (0,)


@pytest.mark.parametrize("seed", range(6))
def test_small_frusta_against_chance(seed: int) -> None:
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
    got = Overlap(frustum, 0.01).volumes(np.eye(4), T_a_b[None])[0]
    assert got == pytest.approx(expected, abs=0.01 * frustum.volume)


@given(seeds)
def test_symmetric_and_between_nothing_and_all(seed: int) -> None:
    a, b = poses(seed, 2)
    assert USUAL.volumes(a, b[None])[0] == USUAL.volumes(b, a[None])[0]
    assert 0 <= USUAL.iou(a, b[None])[0] <= 1
    assert 0 <= USUAL.volumes(a, b[None])[0] <= WIDE.volume * (1 + 1e-12)


@given(seeds)
def test_where_the_world_begins_does_not_matter(seed: int) -> None:
    a, b, moved = poses(seed, 3, 10.0)
    assert USUAL.iou(moved @ a, (moved @ b)[None])[0] == pytest.approx(USUAL.iou(a, b[None])[0], abs=1e-3)


@given(seeds)
@settings(max_examples=30)
def test_many_at_once_are_each_as_alone(seed: int) -> None:
    a, *others = poses(seed, 8, 12.0)
    together = USUAL.volumes(a, np.array(others))
    assert together.tolist() == [USUAL.volumes(a, other[None])[0] for other in others]


def test_the_usual_grid_is_as_exact_as_documented() -> None:
    views = poses(5, 80)
    wrong = [
        USUAL.iou(a, b[None])[0] - FINE.iou(a, b[None])[0]
        for a, b in zip(views[::2], views[1::2], strict=True)
    ]
    assert np.sqrt(np.mean(np.square(wrong))) < 0.01


@pytest.mark.parametrize(
    "frustum", [Frustum(1.5, 1.0, 0.3, 5), Frustum(0.2, 0.1, 1, 2), Frustum(3.0, 3.0, 0, 1)]
)
def test_sphere_holds_all_corners(frustum: Frustum) -> None:
    sx, sy = frustum.slopes
    z, radius = frustum.sphere
    far = [math.hypot(d * sx, d * sy, d - z) for d in (frustum.near_m, frustum.far_m)]
    assert max(far) == pytest.approx(radius)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"interval_m": 0.0}, "0.0 m apart are too many"),
        ({"interval_m": 1e-3}, "0.001 m apart are too many"),
        ({"interval_m": 50.0}, "50.0 m apart miss the frustum"),
        ({"horizontal_deg": 180.0}, "between 0 and pi"),
        ({"near_m": 6.0}, "from 6.0 to 5.0 m is no depth"),
    ],
)
def test_what_is_no_frustum_or_no_grid_is_refused(setting: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Overlap.of(ControlConfig(**setting))  # type: ignore[arg-type]
