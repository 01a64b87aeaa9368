"""Is this the same place, and where does the one camera stand as seen from the other?

Two views agree if descriptors match, if either view's 3D points give a pose in the other's image,
if the two poses are the same one, and if the result does not contradict gravity. Every refusal
says which of these failed and by how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.config import PlaceConfig
from share.geometry import se3
from share.geometry.absolute_pose import Terms, absolute_pose
from share.geometry.camera import rays
from share.mapping.recognition.guided import beside
from share.mapping.recognition.refinement import Noise, refine
from share.mapping.recognition.scale import Scale, relative_scale
from share.types import F64, View
from share.vision.matching import Pairs, hamming, mutual, near

_NEAR, _FAR = 0.05, 1000.0  # m; a depth outside says nothing


MIN_ITERATIONS = 50  # of each consensus: one wrong place costs more than a millisecond
CONFIDENCE = 0.99  # of each consensus; the two directions seldom err alike


@dataclass(frozen=True, eq=False)
class Sight:
    """A view, and what must be known of who saw it.

    focal of cam0 [px]; T_body_cam0 (4, 4); up (3,): against gravity in the body frame, zeros if
    unknown (as in `Keyframe.up`).
    """

    view: View
    focal: float
    T_body_cam0: F64
    up: F64

    @property
    def y(self) -> F64:
        """Keypoints (N, 3): u, v and inverse depth [1/m], NaN where depth is unknown or absurd."""
        uv, z = self.view.uv.astype(np.float64), self.view.points[:, 2].astype(np.float64)
        z[~((z > _NEAR) & (z < _FAR))] = np.nan
        return np.column_stack([uv, 1 / z])


@dataclass(frozen=True, eq=False)
class Verified:
    """T_c_q (4, 4): body of the query in the body frame of the candidate; cov (6, 6) of it.

    matches: descriptor pairs; inliers: those that agree with the pose. scale: of the query's depths over the
    candidate's; None where too few points have both.
    """

    T_c_q: F64
    cov: F64
    matches: int
    inliers: int
    scale: Scale | None = None

    @property
    def reason(self) -> str:
        return f"{self.inliers} inliers of {self.matches} matches"


@dataclass(frozen=True)
class Refusal:
    """Why not, for a person: "17 inliers of 25 needed"."""

    reason: str


class _RefusedError(Exception):
    """A check that did not pass; its text is the reason."""


def verify(query: Sight, candidate: Sight, config: PlaceConfig, seed: int = 0) -> Verified | Refusal:
    """The pose of the query's body in the candidate's body frame, or why there is none.

    Deterministic for a given seed. Does not raise on any two valid views.
    """
    try:
        return _verify(query, candidate, config, seed)
    except _RefusedError as failed:
        return Refusal(str(failed))
    except np.linalg.LinAlgError:
        return Refusal("degenerate geometry: the matches do not determine a pose")


@dataclass(frozen=True, eq=False)
class _Fit:
    """What a rough pose becomes: T_c_q of the cameras, its covariance, the matches beside it (M, 3), (M, 3),
    and those of them, y_q, y_c (N, 3), that are inliers."""

    T: F64
    cov: F64
    beside: tuple[F64, F64]
    y_q: F64
    y_c: F64

    @property
    def matches(self) -> int:
        return len(self.beside[0])

    @property
    def inliers(self) -> int:
        return len(self.y_q)


def _verify(query: Sight, candidate: Sight, config: PlaceConfig, seed: int) -> Verified:
    y_q, y_c = query.y, candidate.y
    alike = near(hamming(query.view.descriptors, candidate.view.descriptors), config.guided_bits)
    pairs = mutual(alike.only(alike.bits <= config.max_distance_bits))
    _need(len(pairs.rows), config.min_matches, "matches")
    roughs = _both_ways(y_q[pairs.rows], y_c[pairs.cols], query.focal, candidate.focal, config, seed)
    noises = _noise(query, config), _noise(candidate, config)
    upright = bool(query.up.any() and candidate.up.any())
    if not upright and len(roughs) > 1:
        raise _RefusedError("the two directions differ, and no gravity decides")
    fit = _best(_fits(roughs, alike, y_q, y_c, noises, config), config)
    _need(fit.inliers, config.min_inliers, "inliers")
    for y, whose in ((fit.y_q, "query"), (fit.y_c, "candidate")):
        known = int(np.isfinite(y[:, 2]).sum())
        _need(known, config.min_direction_inliers, f"inliers with the {whose}'s depth")
        _check_spread(y, whose, config)
    _check_uncertainty(fit.cov, config.max_sigma_deg)
    if upright:
        _check_gravity(fit.T, query, candidate, config)
    T, cov = _between_bodies(fit.T, fit.cov, query.T_body_cam0, candidate.T_body_cam0)
    scale = _scale(fit, noises, config, candidate.T_body_cam0)
    return Verified(T, cov + _floor(config), fit.matches, fit.inliers, scale)


def _scale(fit: _Fit, noises: tuple[Noise, Noise], config: PlaceConfig, T_body_cam_c: F64) -> Scale | None:
    """None where the matches do not tell: a pose may be told all the same."""
    try:
        found = relative_scale(fit.T, *fit.beside, *noises, config.inlier_chi2)
    except np.linalg.LinAlgError:
        return None
    if found is None or found.lean is None:
        return found
    return found._replace(lean=se3.adjoint(T_body_cam_c) @ found.lean)


def _noise(sight: Sight, config: PlaceConfig) -> Noise:
    return Noise(config.sigma_px / sight.focal, config.sigma_inverse_depth)


def _fits(
    roughs: list[F64], alike: Pairs, y_q: F64, y_c: F64, noises: tuple[Noise, Noise], config: PlaceConfig
) -> list[_Fit]:
    """What the rough poses become, but for those that have too few matches to matter."""
    radius = noises[0].uv / config.sigma_px * config.guided_px
    matched = [(mutual(beside(alike, rough, y_q, y_c, radius)), rough) for rough in roughs]
    matched.sort(key=lambda found: -len(found[0].rows))
    _need(len(matched[0][0].rows), config.min_inliers, "matches beside where the pose moves the points")
    fits: list[_Fit] = []
    for pairs, rough in matched:
        if not fits or len(pairs.rows) > config.rival_share * max(fit.inliers for fit in fits):
            fits.append(_fit(rough, y_q[pairs.rows], y_c[pairs.cols], noises, config))
    return fits


def _fit(rough: F64, y_q: F64, y_c: F64, noises: tuple[Noise, Noise], config: PlaceConfig) -> _Fit:
    """The pose from matched keypoints, and which of them agree with it."""
    fine = refine(rough, y_q, y_c, *noises, config.inlier_chi2)
    inlier = fine.d2 < config.inlier_chi2
    return _Fit(fine.T, fine.cov, (y_q, y_c), y_q[inlier], y_c[inlier])


def _best(fits: list[_Fit], config: PlaceConfig) -> _Fit:
    """The one with most inliers; another pose with nearly as many forbids any."""
    best, *others = sorted(fits, key=lambda fit: -fit.inliers)
    for other in others:
        if other.inliers > config.rival_share * best.inliers and _differ(
            best.T, other.T, _depth(best.y_q, best.y_c), config
        ):
            raise _RefusedError(f"two poses fit: {best.inliers} and {other.inliers} inliers")
    return best


def _need(have: int, want: int, what: str) -> None:
    if have < want:
        raise _RefusedError(f"{have} {what} of {want} needed")


def _both_ways(
    y_q: F64, y_c: F64, focal_q: float, focal_c: float, config: PlaceConfig, seed: int
) -> list[F64]:
    """T_c_q by the query's points in the candidate's image and by the reverse: one if they agree.

    Of a flat scene two poses look nearly alike (Schweighofer and Pinz, PAMI 2006); the two directions
    seldom fall for the same wrong one, if only one of them trusts the order of the matches.
    """
    forward = _absolute_pose(y_q, y_c, focal_c, "query's", config, seed, config.ransac_iterations, True)
    iterations = config.reverse_iterations
    backward = _absolute_pose(y_c, y_q, focal_q, "candidate's", config, seed, iterations, False)
    backward = se3.inverse(backward)
    depth = _depth(y_q, y_c)
    return [forward, backward] if _differ(forward, backward, depth, config) else [forward]


def _depth(y_q: F64, y_c: F64) -> float:
    """Median, m."""
    rho = np.concatenate([y_q[:, 2], y_c[:, 2]])
    rho = rho[np.isfinite(rho)]
    return float(1 / np.partition(rho, len(rho) // 2)[len(rho) // 2])  # a fourth of np.nanmedian's time


def _differ(a: F64, b: F64, depth: float, config: PlaceConfig) -> bool:
    apart = se3.inverse(a) @ b
    metres, degrees = float(np.linalg.norm(apart[:3, 3])), float(np.degrees(se3.angle(apart)))
    return metres > config.agree_depth_ratio * depth or degrees > config.agree_deg


def _absolute_pose(
    source: F64,
    target: F64,
    focal: float,
    whose: str,
    config: PlaceConfig,
    seed: int,
    iterations: int,
    best_first: bool,
) -> F64:
    """T_target_source from 3D points of the source seen by the target."""
    known = np.isfinite(source[:, 2])
    _need(int(known.sum()), config.min_consensus, f"matches with the {whose} depth")
    y = source[known]
    points, seen = rays(y[:, :2]) / y[:, 2:], target[known, :2]
    terms = Terms(config.ransac_px, seed, MIN_ITERATIONS, iterations, best_first, CONFIDENCE)
    T, inliers = absolute_pose(points, seen, focal, terms)
    _need(int(inliers.sum()), config.min_consensus, f"inliers of the {whose} points")
    if not np.isfinite(T).all():
        raise _RefusedError(f"no pose from the {whose} points")
    return T


def _check_spread(y: F64, whose: str, config: PlaceConfig) -> None:
    """The narrow side of the cloud of inliers: a pose from one corner or one line is not to be trusted."""
    apart = y[:, :2] - y[:, :2].mean(0)
    narrow = float(np.linalg.svd(apart, compute_uv=False)[-1] / np.sqrt(len(y) - 1))
    if narrow < config.min_spread:
        raise _RefusedError(
            f"inliers crowd in the {whose} image: spread {narrow:.3f} of {config.min_spread} needed"
        )


def _check_uncertainty(cov: F64, allowed: float) -> None:
    """Inliers can be many and yet leave the pose loose; most wrong poses that pass the rest show here."""
    degrees = float(np.degrees(np.sqrt(np.trace(cov[:3, :3]))))
    if degrees > allowed:
        raise _RefusedError(f"pose uncertain by {degrees:.2f}°, {allowed:.2f}° allowed")


def _check_gravity(T_c_q: F64, query: Sight, candidate: Sight, config: PlaceConfig) -> None:
    up_q, up_c = (s.T_body_cam0[:3, :3].T @ s.up for s in (query, candidate))
    cosine = float((T_c_q[:3, :3] @ up_q) @ up_c / (np.linalg.norm(up_q) * np.linalg.norm(up_c)))
    degrees = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if degrees > config.gravity_deg:
        raise _RefusedError(f"gravity differs by {degrees:.1f}°, {config.gravity_deg:.1f}° allowed")


def _between_bodies(T_c_q: F64, cov: F64, T_body_cam_q: F64, T_body_cam_c: F64) -> tuple[F64, F64]:
    """From cameras to bodies: X_c T Exp(xi) X_q^-1 = (X_c T X_q^-1) Exp(Ad(X_q) xi)."""
    Ad = se3.adjoint(T_body_cam_q)
    return T_body_cam_c @ T_c_q @ se3.inverse(T_body_cam_q), Ad @ cov @ Ad.T


def _floor(config: PlaceConfig) -> Any:
    """What many inliers do not average away: calibration, depth bias, rolling shutter."""
    return np.diag([np.radians(config.floor_deg) ** 2] * 3 + [config.floor_m**2] * 3)
