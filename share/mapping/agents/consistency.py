"""Whether two agents' odometries and depths are of one world, by the loops between them.

Every loop i between keyframes a of one stretch and b of another measures where the other odometry lies in
the one: Z = T_a T_a_b T_b^-1, as T_a, T_b are known since the starts of their stretches. If both tell the
truth all Z are one pose G, but for noise: of the loop, and of either odometry's random walk, which loops have
in common as far as both have walked. In left perturbations, xi = log(Z G^-1), that walk simply adds up:

    cov(xi_i, xi_j) = P_a(min) + Ad_G P_b(min) Ad_G' + [i = j] Ad_(G T_b) S_i Ad_(G T_b)',   P(k) = sum to k

What agents may be wrong about are further unknowns of these equations: a path that is longer by e^l than the
other's moves xi by -l times where the loop is, a camera that is turned on its body by phi turns it by
Ad_(G T_b) (phi, 0). Generalised least squares gives each with its sigma; loops are under a Cauchy kernel, for
some are false. The noise that is left for a loop, per degree of freedom, in the median, says whether the
covariances are too sure.
Source: Barfoot, *State Estimation for Robotics* (2017), chapters 5 and 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.mapping.recognition.scale import Scale
from share.types import F64, I64

_SURER = 2.0  # honest agents' sigmas of odometry are up to this much too small,
_LOOP_SURER = 1.3  # those of loops this much
_CAUCHY = 12.0  # squared width of the kernel, of 6 dof
_ROUNDS = 6
_MEDIAN = 5.35  # of chi-square with 6 dof
_PRIOR = np.array([0.2, 0.1, 0.1, 0.1])  # log scale, rad: only so that two loops have a solution
_MAD = 0.6745  # median of |x| of a standard normal distribution
_OUTSIDE = 0.3  # weight of a loop below which it does not fit
_SCALE_FLOOR = 0.004  # of the log scale of one loop's points, beside what it says: occlusions, pixels
_AS_CLAIMED = (1.0, 1.0)
_ALIKE = 0.003  # of honest agents' log scales: no two are calibrated better


@dataclass(frozen=True, eq=False)
class Walked:
    """Where odometry has come: keyframe k of a stretch at T (4, 4) since its start, cov (6, 6) of its left
    perturbation."""

    k: int
    T: F64
    cov: F64

    @staticmethod
    def start() -> Walked:
        """At the first keyframe of a stretch."""
        return Walked(0, np.eye(4), np.zeros((6, 6)))

    def on(self, T_ref_body: F64, cov: F64) -> Walked:
        """One step further; cov (6, 6): of the step, right perturbation."""
        T = se3.orthonormal(self.T @ T_ref_body)
        Ad = se3.adjoint(T)
        return Walked(self.k + 1, T, self.cov + Ad @ cov @ Ad.T)


@dataclass(frozen=True, eq=False)
class Witness:
    """A loop as evidence: T_a_b (4, 4), cov (6, 6), between what either side has walked. scale: of b's depths
    over a's. tilt: (angle between both ups, its sigma), rad; None where gravity is not known."""

    a: Walked
    b: Walked
    T_a_b: F64
    cov: F64
    scale: Scale | None = None
    tilt: tuple[float, float] | None = None


@dataclass(frozen=True)
class Estimate:
    """Of n loops."""

    value: float
    sigma: float
    n: int

    @property
    def significance(self) -> float:
        """In sigmas."""
        return abs(self.value) / self.sigma


@dataclass(frozen=True, eq=False)
class Comparison:
    """Of b with a. points: log scale of b's depths; path: log of how much longer its way is. turn: of its
    camera on its body, rad. nis: of the loops' noise beyond all this, 1 if covariances are right.
    weight (N,): of each loop under the kernel."""

    path: Estimate
    turn: Estimate
    nis: float
    weight: F64

    @property
    def inside(self) -> float:
        """Share of the loops that fit."""
        return float((self.weight > _OUTSIDE).mean())


@dataclass(frozen=True, eq=False)
class Equations:
    """Of N loops between two stretches: xi (N, 6); J (N, 6, 10), how it moves with G, the path's log scale
    and the camera's turn; and what adds up to its covariance, as claimed: either walk (N, 6, N, 6), each
    loop's own noise (N, 6, 6)."""

    xi: F64
    J: F64
    walk_a: F64
    walk_b: F64
    own: F64


def points_scale(scales: Sequence[Scale]) -> Estimate:
    """Robust mean of log scales, at least one. sigma: as they are spread, where that is more than said."""
    log, variance = np.array([s.log for s in scales]), np.array([s.sigma for s in scales]) ** 2
    variance = variance + _SCALE_FLOOR**2
    mean, weight = float(np.median(log)), np.ones(len(log))
    usual = float(np.median(np.abs(log - mean)) / _MAD) ** 2  # variance
    variance = variance * max(1.0, usual / float(np.median(variance)))
    for _ in range(_ROUNDS):
        weight = 1 / (1 + (log - mean) ** 2 / (4 * variance))
        mean = float((weight * log / variance).sum() / (weight / variance).sum())
    told = weight / variance
    spread = float((told**2 * (log - mean) ** 2).sum()) ** 0.5 / float(told.sum())  # Huber's sandwich
    return Estimate(mean, float(np.hypot(max(told.sum() ** -0.5, spread), _ALIKE)), len(log))


def compare(loops: Sequence[Witness], widths: tuple[float, float] = _AS_CLAIMED) -> Comparison:
    """Of at least three loops between the same two stretches. widths: see `solved`."""
    return solved(equations(loops), widths)


def equations(loops: Sequence[Witness]) -> Equations:
    """Of loops between the same two stretches, about the middle of where they are."""
    T_a, T_b, T_a_b = (np.array(x) for x in zip(*((w.a.T, w.b.T, w.T_a_b) for w in loops), strict=True))
    middle = np.eye(4)
    middle[:3, 3] = -(T_a @ T_a_b)[:, :3, 3].mean(0)
    Ad = se3.adjoint(middle)
    T_a = middle @ T_a
    G = _start(T_a @ T_a_b @ se3.inverse(T_b))
    walk_a, walk_b = _walk([w.a for w in loops], Ad), _walk([w.b for w in loops], se3.adjoint(G))
    own = (
        se3.adjoint(T_a @ T_a_b) @ np.array([w.cov for w in loops]) @ se3.adjoint(T_a @ T_a_b).swapaxes(1, 2)
    )
    xi = se3.log(T_a @ T_a_b @ se3.inverse(T_b) @ se3.inverse(G))
    return Equations(xi, _columns(T_a @ T_a_b), walk_a, walk_b, own)


def _start(Z: F64) -> F64:
    """The one of N poses that most others agree with."""
    xi = se3.log((Z[:, None] @ se3.inverse(Z)[None]).reshape(-1, 4, 4)).reshape(len(Z), len(Z), 6)
    far = np.minimum(1.0, np.linalg.norm(xi * (10, 10, 10, 1, 1, 1), axis=2))
    return np.asarray(Z[far.sum(1).argmin()])


def _walk(at: Sequence[Walked], Ad: F64) -> F64:
    """What N loops have in common of one side's walk (N, 6, N, 6), since the first of them."""
    k: I64 = np.array([w.k for w in at])
    P = np.array([w.cov for w in at])
    P = Ad @ (P - P[k.argmin()]) @ Ad.T
    first = np.where(k[:, None] <= k, np.arange(len(k))[:, None], np.arange(len(k)))
    return np.asarray(P[first].transpose(0, 2, 1, 3))


def _columns(T_b: F64) -> F64:
    """How xi (N, 6) moves with G, the path's log scale and the camera's turn: (N, 6, 10)."""
    out = np.zeros((len(T_b), 6, 10))
    out[:, :, :6] = np.eye(6)
    out[:, 3:, 6] = -T_b[:, :3, 3]
    out[:, :, 7:] = se3.adjoint(T_b)[:, :, :3]
    return out


def solved(e: Equations, widths: tuple[float, float] = _AS_CLAIMED) -> Comparison:
    """What the agents are wrong about. widths: by what the variances of either walk are multiplied where the
    camera's turn is told, for the noise of an agent that is too sure passes for one at few places. Its way it
    is held to as it claims: one that is too long and too sure bends the others, and is found out sooner so.
    Raises LinAlgError where absurd numbers leave no solution."""
    told = _solved(e, _AS_CLAIMED)
    return told if widths == _AS_CLAIMED else replace(told, turn=_solved(e, widths).turn)


def _solved(e: Equations, widths: tuple[float, float]) -> Comparison:
    xi, J, n = e.xi, e.J, len(e.xi)
    walk, own = _SURER**2 * (widths[0] * e.walk_a + widths[1] * e.walk_b), _LOOP_SURER**2 * e.own
    rows, prior = J.reshape(6 * n, 10), np.zeros((10, 10))
    prior[range(6, 10), range(6, 10)] = _PRIOR**-2
    information, weight = np.linalg.inv(own), np.ones(n)
    for _ in range(_ROUNDS):
        C = walk.copy()
        C[range(n), :, range(n)] += own / weight[:, None, None]
        inverse = np.linalg.inv(C.reshape(6 * n, 6 * n))
        normal = rows.T @ inverse @ rows + prior
        theta = np.linalg.solve(normal, rows.T @ inverse @ xi.ravel())
        left = xi.ravel() - rows @ theta
        told = (inverse @ left).reshape(n, 6)
        noise = (own @ told[:, :, None])[:, :, 0] / weight[:, None]
        chi2 = np.einsum("ni,nij,nj->n", noise, information, noise)
        weight = 1 / (1 + chi2 / _CAUCHY)
    nis = float(np.median(chi2)) / _MEDIAN
    misfit = float(left @ inverse @ left) / max(1, 6 * n - 10)  # of loops and ways: a wrong model shows here
    cov = np.linalg.inv(normal) * max(1.0, nis, misfit)
    turn = theta[7:]
    chi = max(1e-6, float(turn @ np.linalg.solve(cov[7:, 7:], turn))) ** 0.5
    size = float(np.linalg.norm(turn))
    return Comparison(
        Estimate(float(theta[6]), float(np.sqrt(cov[6, 6])), n),
        Estimate(size, size / chi if size else 1.0, n),
        nis,
        weight,
    )
