"""How much larger one camera sees the same points than another: whose depths are wrong, relative to whose.

Of a matched point both views know a depth. With T_c_q in the candidate's units, a query whose depths are all
too large by e^l has inverse depths that are too small by it, so y' = h(T, (u, v, rho e^l)) has to meet y_c:
the residual of `share.mapping.recognition.refinement`, with one unknown more. Both a wrong stereo baseline
and a wrong focal length show here at once, from one pair of views. A pose that takes both as of one scale is
off, by some mm for each percent and metre of depth: `Scale.lean` says how."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from share.geometry import se3
from share.mapping.recognition.refinement import Noise, by_keypoint, by_pose, move
from share.types import F64

_LEAST = 10  # matches with both depths: fewer say little
_STEPS = 2
_MOST = 1.0  # log scale; beyond, the matches are none
_RIDGE = 1e-6 * np.eye(7)


class Scale(NamedTuple):
    """log: of the query's depths over the candidate's; sigma: of log. lean (6,): where T_c_q goes, perturbed
    on the left, by each unit of log that is taken into account; None where not known."""

    log: float
    sigma: float
    lean: F64 | None = None

    def reverse(self) -> Scale:
        """The same, from the other end, but for the lean."""
        return Scale(-self.log, self.sigma)


def relative_scale(
    T_c_q: F64, y_q: F64, y_c: F64, noise_q: Noise, noise_c: Noise, gate: float
) -> Scale | None:
    """Of cameras, from T_c_q (4, 4) as refined and matched keypoints y_q, y_c (N, 3), NaN where a depth is
    unknown. gate: squared Mahalanobis distance of an inlier. None where too few matches have both depths.
    Raises LinAlgError where they determine nothing."""
    both = np.isfinite(y_q[:, 2]) & np.isfinite(y_c[:, 2])
    source, target = y_q[both].T, y_c[both].T
    T, log = T_c_q, 0.0
    for _ in range(_STEPS):
        J, information, residual = _linear(T, log, source, target, noise_q, noise_c)
        WJ = information @ J
        d2 = (residual * (information @ residual[:, :, None])[:, :, 0]).sum(1)
        inside = d2 < gate
        if inside.sum() < _LEAST:
            return None
        J, WJ, residual = J[inside], WJ[inside], residual[inside]
        J, WJ = J.reshape(-1, 7), WJ.reshape(-1, 7)
        normal = J.T @ WJ + _RIDGE
        step = np.linalg.solve(normal, WJ.T @ residual.ravel())
        T, log = se3.exp(step[:6]) @ T, log + float(step[6])
    if not abs(log) < _MOST:
        return None
    variance = max(1.0, float(d2[inside].sum()) / max(1, 3 * int(inside.sum()) - 7))
    lean = -np.linalg.solve(normal[:6, :6], normal[:6, 6])
    return Scale(log, float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance)), lean)


def _linear(
    T: F64, log: float, source: F64, target: F64, noise_q: Noise, noise_c: Noise
) -> tuple[F64, F64, F64]:
    """J (N, 3, 7), information (N, 3, 3) and residual (N, 3); no information of a point behind the camera."""
    y = source.copy()
    y[2] *= np.exp(log)
    moved = move(T, y)
    K = by_keypoint(T, y, moved)  # (3, 3, N)
    J = np.concatenate([by_pose(moved), (K[:, 2] * y[2])[None]]).transpose(2, 1, 0)
    by = K.transpose(2, 0, 1)
    covariance = (by * noise_q.variances) @ by.swapaxes(1, 2) + np.diag(noise_c.variances)
    residual = (target - moved).T
    seen = np.isfinite(moved.sum(0))
    J, residual = np.where(seen[:, None, None], J, 0.0), np.where(seen[:, None], residual, 0.0)
    information = np.zeros_like(covariance)
    information[seen] = np.linalg.inv(covariance[seen])
    return J, information, residual
