"""Verdict on a camera calibration: what passes, and each reason of a failure."""

from dataclasses import replace

import numpy as np
import pytest

from share.geometry.camera import Camera
from share.lab.calibrate.camera_bundle import CameraBundleSolution, CameraBundleState
from share.lab.calibrate.camera_verdict import CELL_GRID, Coverage, judge_cameras
from share.types import F64

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (0.0,) * 4)
ALL = Coverage(np.full(CELL_GRID, 5), np.zeros((20, 2)), np.linspace(0.5, 1.0, 20))


def _solution(residuals: list[F64], focal_sigma: float = 0.1) -> CameraBundleSolution:
    state = CameraBundleState((CAMERA,), np.eye(4), np.stack([np.eye(4)] * len(residuals)))
    covariance = np.diag([focal_sigma**2] * 2 + [0.01] * 6)
    return CameraBundleSolution(
        state, covariance, np.zeros_like(covariance), tuple((r,) for r in residuals), 0.2
    )


def _views(rng: np.random.Generator, count: int = 20) -> list[F64]:
    return [rng.normal(0, 0.2, (50, 2)) for _ in range(count)]


def test_good_views_pass_with_the_rms_of_their_distances(rng: np.random.Generator) -> None:
    verdict = judge_cameras(_solution(_views(rng)), [ALL])
    assert verdict.passed
    assert verdict.rms_px[0] == pytest.approx(0.2 * np.sqrt(2), rel=0.05)


def test_an_outlier_view_is_named(rng: np.random.Generator) -> None:
    views = _views(rng)
    views[7] = 3 * views[7]
    assert judge_cameras(_solution(views), [ALL]).outlier_views == (7,)


def test_outlier_corners_are_counted_and_excluded_from_the_rms(rng: np.random.Generator) -> None:
    views = _views(rng)
    views[3][:4] = 30.0
    verdict = judge_cameras(_solution(views), [ALL])
    assert verdict.outlier_corners == (4,)
    assert verdict.rms_px[0] < 0.35


def test_each_reason_of_a_failure_is_given(rng: np.random.Generator) -> None:
    half = replace(ALL, cells=np.repeat([[5] * 4 + [0] * 4], CELL_GRID[0], axis=0))
    with_outliers = _views(rng)
    for view in with_outliers:
        view[:5] = 30.0
    blurred = replace(_solution([4 * view for view in _views(rng)]), sigma_px=0.8)
    for solution, cover, reason in (
        (_solution(_views(rng, 11)), ALL, "11 views, 12 needed"),
        (_solution(_views(rng), focal_sigma=1.5), ALL, "focal length known to 0.30%"),
        (_solution(_views(rng)), half, "corners in 50% of the image"),
        (_solution(with_outliers), ALL, "100 of 1000 corners do not fit within 0.5 px"),
        (blurred, ALL, "px RMS, at most 0.5"),
    ):
        reasons = judge_cameras(solution, [cover]).reasons
        assert len(reasons) == 1
        assert reason in reasons[0]
