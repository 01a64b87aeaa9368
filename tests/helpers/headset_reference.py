"""References in Python of the headset page's mathematics: alignment of a headset's space, and prediction.

Where a headset's own space is in the shared map: T_map_local from pairs of poses of one head, by a Kalman
filter over pairs at one moment: the device's pose in the map, through the mount, and the viewer's pose in the
headset's space. Both drift, so the alignment does: a random walk at the wearer, where it is seen; the lever
arm would exaggerate a walk at either origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from share.geometry import se3
from share.types import F64

# Random walk of the alignment at the wearer, rad and m in the root of a second: drift of both trackers.
_WALK = np.repeat([np.radians(0.03), 0.003], 3)
_TREMBLE = np.repeat([np.radians(0.05), 0.001], 3)  # of headset poses, rad and m
_CORRELATION_S = 2.0  # how long errors of map poses last
_USUAL_SIGMA_M, _USUAL_SIGMA_RAD = 0.01, 0.004  # of a pose that names none, of three axes together
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.005, 0.002  # an agent knows no better what its camera and IMU do
_MAX_NIS = 40.0  # of a pair, 6 degrees of freedom, as if errors did not last: one in 10^6
_MAX_REFUSED_S = 1.0  # of refused pairs in a row, after which they are right


def pose_cov(sigma_m: float | None, sigma_rad: float | None) -> F64:
    """Return the covariance (6, 6) of a pose in the map by what its agent says, of three axes together.
    None: it does not say."""
    position = max(_USUAL_SIGMA_M if sigma_m is None else sigma_m, _LEAST_SIGMA_M)
    rotation = max(_USUAL_SIGMA_RAD if sigma_rad is None else sigma_rad, _LEAST_SIGMA_RAD)
    return np.diag(np.repeat([rotation**2 / 3, position**2 / 3], 3))


class PairOutcome(Enum):
    """What became of a pair."""

    STARTED = "started"  # the first one: what is drawn jumps to its place
    USED = "used"
    REFUSED = "refused"  # it contradicts the alignment
    RESTARTED = "restarted"  # those refused agree with each other: what is drawn jumps


@dataclass(frozen=True, eq=False)
class PosePair:
    """Poses of one head at one moment: T_map_body (4, 4) with cov (6, 6), perturbed on the right, and
    T_local_viewer (4, 4)."""

    time_s: float
    map_id: str
    T_map_body: F64
    cov: F64
    T_local_viewer: F64


@dataclass(frozen=True, eq=False)
class SpaceAlignment:
    """T_map_local (4, 4) with cov (6, 6), perturbed on the left in the map; of `map_id`, None before a pair.

    T_body_viewer (4, 4): the mount.
    """

    T_body_viewer: F64
    map_id: str | None = None
    T_map_local: F64 | None = None
    cov: F64 | None = None
    time_s: float = 0.0
    refused_since_s: float | None = None

    def after(self, pair: PosePair) -> tuple[SpaceAlignment, PairOutcome]:
        """Return the alignment after a pair, and what became of the pair."""
        if self.T_map_local is None or self.map_id != pair.map_id:
            return self._started(pair), PairOutcome.STARTED
        elapsed_s = max(pair.time_s - self.time_s, 0.0)
        P = self.T_map_local @ pair.T_local_viewer
        innovation = se3.log(se3.inverse(P) @ pair.T_map_body @ self.T_body_viewer)
        prior = self.cov_at(pair.T_local_viewer) + np.diag(_WALK**2) * elapsed_s
        noise = self._pair_noise(pair)
        if innovation @ np.linalg.solve(prior + noise, innovation) > _MAX_NIS:
            return self._refused(pair)
        lasting = noise * max(1.0, _CORRELATION_S / max(elapsed_s, 1e-3))
        gain = np.linalg.solve(prior + lasting, prior).T
        posterior = prior - gain @ prior
        left = se3.adjoint(P)
        return replace(
            self,
            T_map_local=se3.orthonormal(P @ se3.exp(gain @ innovation) @ se3.inverse(pair.T_local_viewer)),
            cov=left @ posterior @ left.T,
            time_s=pair.time_s,
            refused_since_s=None,
        ), PairOutcome.USED

    def cov_at(self, T_local_viewer: F64) -> F64:
        """Return the covariance (6, 6) of T_map_local at a viewer, perturbed on its right."""
        assert self.T_map_local is not None and self.cov is not None
        right = se3.adjoint(se3.inverse(self.T_map_local @ T_local_viewer))
        return np.asarray(right @ self.cov @ right.T, np.float64)

    def forgotten(self) -> SpaceAlignment:
        """Return the alignment before any pair: the headset's space was reset."""
        return SpaceAlignment(self.T_body_viewer)

    def _started(self, pair: PosePair) -> SpaceAlignment:
        P = pair.T_map_body @ self.T_body_viewer
        left = se3.adjoint(P)
        return replace(
            self,
            map_id=pair.map_id,
            T_map_local=P @ se3.inverse(pair.T_local_viewer),
            cov=left @ self._pair_noise(pair) @ left.T,
            time_s=pair.time_s,
            refused_since_s=None,
        )

    def _refused(self, pair: PosePair) -> tuple[SpaceAlignment, PairOutcome]:
        since_s = pair.time_s if self.refused_since_s is None else self.refused_since_s
        if pair.time_s - since_s >= _MAX_REFUSED_S:
            return self._started(pair), PairOutcome.RESTARTED
        return replace(self, refused_since_s=since_s), PairOutcome.REFUSED

    def _pair_noise(self, pair: PosePair) -> F64:
        """Return the covariance (6, 6) of a pair, at the viewer."""
        to_viewer = se3.adjoint(se3.inverse(self.T_body_viewer))
        return np.asarray(to_viewer @ pair.cov @ to_viewer.T + np.diag(_TREMBLE**2), np.float64)


MAX_AHEAD_S = 0.1  # beyond, a head has turned otherwise


def predict_pose(T_world_body: F64, velocity: F64, angular_velocity: F64, ahead_s: float) -> F64:
    """Return T_world_body (4, 4) `ahead_s` later, at most MAX_AHEAD_S.

    velocity (3,) m/s along the world's axes, angular_velocity (3,) rad/s about the body's.
    """
    ahead_s = min(max(ahead_s, 0.0), MAX_AHEAD_S)
    R = T_world_body[:3, :3] @ se3.so3_exp(np.asarray(angular_velocity) * ahead_s)
    return se3.from_rt(R, T_world_body[:3, 3] + np.asarray(velocity) * ahead_s)
