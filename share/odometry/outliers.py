"""Which features belong to the room, where some move by themselves: consensus guided by the IMU.

A person or robot that fills much of the view is as rigid as the room, so counting votes decides nothing.
What decides is what the IMU says of the motion, and how much of the image agrees. After IMU-PARSAC of
RD-VIO (Li et al. 2024), with a prior in place of its thresholds and no random numbers: every part of the
image proposes a motion, every feature judges it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Camera, rays
from share.odometry import filter
from share.odometry.filter import Sight
from share.odometry.relocalisation import consensus
from share.odometry.result import median
from share.odometry.state import POSE, State
from share.types import F32, F64, I64
from share.vision.corners import cells

_AGREES = 3.0  # sigmas of a feature's own
_SPLIT = 0.15  # of the features may disagree with the rest before anybody is asked
_REGIONS, _CELLS = (4, 3), (8, 6)  # of the image: who proposes, and what counts
_SMALLEST_GROUP = 4  # features that propose
_LOOSE = 10.0  # times the prior's sigmas: what a proposal may be off
_DOUBT = 2.0  # times the prior's sigmas: what the filter is really worth
_UNLIKELY = 4.0  # a surprise that asks for a second look,
_MOST = 12.0  # and cells that one can cost
_ROUNDS = 3
_VAGUE = 6.0  # times a feature's sigma: where the filter knows a place no better, it is no help
_VOTE_PX = 3.0
_FARTHEST = 1e-3  # 1/m
_FLOOR = np.repeat([1e-4, 2e-4], 3) ** 2  # rad^2, m^2


def as_expected(residual: F64, sigma: float, lasting: float) -> bool:
    """Whether nearly all features are where the IMU alone has them, so that nobody needs to be asked.
    residual (M, 2), sigma and lasting of each coordinate."""
    off = (residual**2).sum(axis=1) / (sigma**2 + lasting**2)
    return bool((off < _AGREES**2).mean() > 1 - _SPLIT)


def of_the_room(
    state: State, rows: Sight, px: F32, proven: NDArray[np.bool_], camera: Camera
) -> NDArray[np.bool_]:
    """Which rows (M,) of one camera move with the room; all where there is no doubt. px (M, 2): where they
    are seen. proven (M,): whose word counts."""
    everything, size = np.ones(len(rows.which), bool), (camera.width, camera.height)
    if len(rows.which) < 2 * _SMALLEST_GROUP:
        return everything
    fit = _Fit(state, rows)
    if fit.looseness > _VAGUE:
        return by_votes(state, rows.which, px, camera)
    agree = fit.agree(fit.robust(proven if proven.sum() >= 2 * _SMALLEST_GROUP else everything))
    if agree.mean() > 1 - _SPLIT and fit.surprise(agree) < _UNLIKELY:
        return everything
    region, cell = cells(px, size, _REGIONS), cells(px, size, _CELLS)
    proposals = [agree, *(_grown(fit, region == k) for k in np.unique(region))]
    scores = [len(np.unique(cell[group & proven])) - fit.surprise(group) for group in proposals]
    return proposals[int(np.argmax(scores))]


def by_votes(state: State, which: I64, px: F32, camera: Camera) -> NDArray[np.bool_]:
    """Which of features `which` (M,), seen at px (M, 2), agree on a pose, whatever the filter expects; all
    where less than half do."""
    T_odom_host = state.poses[state.host[which]] @ state.T_body_cam
    in_host = rays(state.ray[which]) / np.maximum(state.rho[which, None], _FARTHEST)
    points = (T_odom_host[:, :3, :3] @ in_host[:, :, None])[:, :, 0] + T_odom_host[:, :3, 3]
    agree = consensus(points, camera.normalise(px.astype(np.float64)), camera.focal, _VOTE_PX, seed=0)
    if agree is None or agree.inliers.mean() < 0.5:
        return np.ones(len(which), bool)
    return agree.inliers


def _grown(fit: _Fit, group: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """All that agree with the motion of a group (M,), that of all that agree with that, and so on."""
    if group.sum() < _SMALLEST_GROUP:
        return np.zeros(len(group), bool)
    for _ in range(_ROUNDS):
        group = fit.agree(fit.motion(group, _LOOSE))
        if group.sum() < _SMALLEST_GROUP:
            break
    return group


class _Fit:
    """A common motion e (6,) of the camera: rows' residuals = J e + their own noise, e being about 0 by IMU.
    In units of the prior's sigmas."""

    def __init__(self, state: State, rows: Sight) -> None:
        prior = filter.motion_since(state) + np.diag(_FLOOR)
        J = rows.core[:, :, POSE] @ se3.adjoint(state.T) @ np.linalg.cholesky(prior)
        rho_variance = state.rho_variance[rows.which, None, None]
        own: F64 = rows.by_rho[:, :, None] * rows.by_rho[:, None, :] * rho_variance
        seen = (rows.sigma**2 + rows.lasting**2)[:, None, None] * np.eye(2)
        white = np.linalg.inv(np.linalg.cholesky(own + seen))
        self._J, self._r = white @ J, (white @ rows.residual[:, :, None])[:, :, 0]

    @property
    def looseness(self) -> float:
        """How well the places of features are known beforehand, median, in sigmas of what is seen."""
        return float(np.median(np.linalg.norm(self._J, axis=(1, 2))) / np.sqrt(2))

    def motion(self, group: NDArray[np.bool_], sigmas: float, weight: F64 | None = None) -> F64:
        """The best (6,) of a group (M,) of rows."""
        J, r = self._J[group].reshape(-1, 6), self._r[group].ravel()
        weighted = J if weight is None else J * np.repeat(weight[group], 2)[:, None]
        out: F64 = np.linalg.solve(weighted.T @ J + np.eye(6) / sigmas**2, weighted.T @ r)
        return out

    def robust(self, group: NDArray[np.bool_]) -> F64:
        """Of a group (M,), from what the IMU says, those that are off counting less (Cauchy)."""
        e = np.zeros(6)
        for _ in range(_ROUNDS):
            e = self.motion(group, _DOUBT, 1 / (1 + (self.off(e) / _AGREES) ** 2))
        return e

    def off(self, e: F64) -> F64:
        """(M,) sigmas."""
        out: F64 = np.linalg.norm(self._r - self._J @ e, axis=1)
        return out

    def agree(self, e: F64) -> NDArray[np.bool_]:
        out: NDArray[np.bool_] = self.off(e) < _AGREES
        return out

    def surprise(self, group: NDArray[np.bool_]) -> float:
        """How unlikely the IMU finds a group's motion, up to _MOST."""
        if group.sum() < _SMALLEST_GROUP:
            return np.inf
        e = self.motion(group, _LOOSE) / _DOUBT
        return min(float(e @ e) / 2, _MOST)


# ---- Whether images and IMU tell of one motion, and whether the filter is where it takes itself to be.

_OVER_S, _LEAST_S = 5.0, 1.0  # averaged over; of frames, before anything is said
_BEGIN_S = 1.0  # in which a filter that has just begun finds its bearings
_FEWEST_MEASURED = 25  # features that say something
_ASTRAY, _REFUSED_S = 3, 1.0  # frames with nothing of what should be there; time with nothing believed
_LONGEST_S = 0.2  # that one frame counts for
_SURPRISED = 0.8  # of the median squared Mahalanobis distance, which is 0.05 to 0.6 where all is well


class Agreement:
    """A camera that is turned or shifted against its calibration, or whose clock is off, is tracked all the
    same, a little beside where the IMU says, all features alike, frame after frame: none is refused for it.
    With 5 degrees and 5 cm the median rises to 1.2 to 3 (docs/vio.md)."""

    def __init__(self) -> None:
        self._mean, self._seconds = 0.0, 0.0

    def add(self, surprise: F64, seconds: float) -> None:
        """`ekf.surprise` (M,) of a frame's features, and how long it was since the frame before."""
        if len(surprise) < _FEWEST_MEASURED:
            return
        self._seconds += seconds
        heard = self._seconds - _BEGIN_S
        if heard <= 0:
            return
        share = min(seconds / min(heard, _OVER_S), 1.0)
        self._mean += share * (median(surprise) - self._mean)

    @property
    def sound(self) -> bool:
        """False where they contradict each other."""
        return self._seconds < _BEGIN_S + _LEAST_S or self._mean < _SURPRISED


class Straying:
    """Frames that show something and nothing of what they should, or for long nothing that is believed: then
    the filter is wrong, and not the light. What has left the view tells nothing."""

    def __init__(self, weak: int, blind: int) -> None:
        """So many features are little to go by; with fewer than `blind` there is no seeing."""
        self._weak, self._blind = weak, blind
        self._frames, self._refused_s = 0, 0.0

    def add(self, textured: bool, due: int, found: int, seen: int, seconds: float) -> None:
        """A frame, `seconds` after the one before. textured: it shows something. Of the filter's features
        `due` should be in view, `found` look as they should, `seen` were believed as well."""
        if textured and due >= self._weak:
            self._frames = self._frames + 1 if found < self._blind else 0
        if due >= self._blind:  # else all was refused in the frame before, and is gone
            refused = textured and seen < self._blind
            self._refused_s = self._refused_s + min(seconds, _LONGEST_S) if refused else 0.0

    @property
    def suspected(self) -> bool:
        """True from the first such frame on."""
        return self._frames > 0 or self._refused_s > 0

    @property
    def certain(self) -> bool:
        """True where it has gone on for too long."""
        return self._frames >= _ASTRAY or self._refused_s > _REFUSED_S


def trusted(s: State, config: InertialConfig) -> bool:
    """Finite, no faster than a person or robot can be, and not gone too far unseen."""
    finite = np.isfinite(s.T).all() and np.isfinite(s.v).all() and np.isfinite(s.cov).all()
    return bool(finite and np.linalg.norm(s.v) < config.max_speed_m_s and filter.drift_m(s) < config.lost_m)
