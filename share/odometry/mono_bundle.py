"""The first seconds of a single camera and its IMU, fitted at once.

To a camera, how fast the body is and how far the room is are one product. A filter has to take slopes
of that product before it knows either, and believes what they say. Here all images of a window are fitted
together (Levenberg-Marquardt), so that slopes are taken where the fit is.

Unknown are poses and velocities of the shots, tied by the IMU; both biases; inverse depths, about that
of the room; and what each image is off by in common. Errors are those of `share.odometry.state`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from share.columns import Columns
from share.geometry import se3
from share.geometry.camera import ImuNoise, rays
from share.odometry import measurement
from share.odometry.imu_propagation import Motion, integrate
from share.odometry.measurement import lever
from share.odometry.normal_equations import SHOT, Normal, inverse
from share.odometry.state import EXTRINSIC, State
from share.types import F64, I64, ImuBatch

# ---- A start for the fit of a single camera's first seconds, from nothing.
#
# The IMU carries the first shot's state to all others: they hang on its tilt and velocity and the biases. In
# these and in depths, that rays meet is nearly linear (Dong-Si and Mourikis 2012): from anywhere, a few
# rounds of weighted least squares lead there.

SIDE = EXTRINSIC.start  # columns of pose, velocity and biases
_USUAL_DEPTHS = (
    100.0,
    30.0,
    10.0,
    5.0,
    3.0,
    3.0,
)  # sigmas, round by round: what is further off counts ever less
_NEAREST = 0.1  # m


@dataclass(frozen=True, eq=False)
class Sights(Columns):
    """M times a feature was seen: by shot `at` (M,), at uv (M, 2) with sigma (M,); feature `which` (M,),
    which shot `host` (M,) sees on ray (M, 2)."""

    at: I64
    host: I64
    which: I64
    ray: F64
    uv: F64
    sigma: F64


class Shooting:
    """first: the state at the first shot and how well it is known. carry: motions by IMU from shot to shot,
    K - 1 of them, of a state there. depth: about how far features are, m, for N of them."""

    def __init__(
        self,
        first: State,
        carry: Callable[[State], list[Motion]],
        sights: Sights,
        features: int,
        depth: float,
    ) -> None:
        self._first, self._carry, self._sights, self._usual_depth = first, carry, sights, depth
        self._prior = inverse(first.cov[:SIDE, :SIDE])
        self.state, self.depth = first, np.full(features, depth)
        self.T, self.v, self._by_first = self._carried()

    def solve(self) -> None:
        """Raises numpy.linalg.LinAlgError where nothing can be solved."""
        for usual in _USUAL_DEPTHS:
            r, J, by_depth = self._residuals(usual)
            self._step(r, J, by_depth)
            self.T, self.v, self._by_first = self._carried()

    def _carried(self) -> tuple[F64, F64, F64]:
        """T (K, 4, 4), v (K, 3) of all shots, and how errors depend on that of the first (K, 15, 15)."""
        motions = self._carry(self.state)
        s, by_first = self.state, [np.eye(SIDE)]
        for m in motions:
            by_first.append(m.transition @ by_first[-1])
        T, v = np.array([s.T, *(m.T for m in motions)]), np.array([s.v, *(m.v for m in motions)])
        return T, v, np.array(by_first)

    def _residuals(self, usual: float) -> tuple[F64, F64, F64]:
        """(M, 2) in sigmas, weighted, and what the first state's error (M, 2, 15) and depth (M, 2) take of
        them. It is the way across the ray that was seen, as large as it looks from the depth that we
        have."""
        s, cams = self._sights, self.T @ self.state.T_body_cam
        at, host, ray = cams[s.at], cams[s.host], rays(s.ray)[:, :, None]
        along = host[:, :3, :3] @ ray
        point = along[:, :, 0] * self.depth[s.which, None] + host[:, :3, 3]
        turn = at[:, :3, :3].transpose(0, 2, 1)
        seen = (turn @ (point - at[:, :3, 3])[:, :, None])[:, :, 0]
        across = np.concatenate([np.tile(np.eye(2), (len(s.at), 1, 1)), -s.uv[:, :, None]], axis=2)
        across /= (np.maximum(seen[:, 2], _NEAREST) * s.sigma)[:, None, None]
        r = -(across @ seen[:, :, None])[:, :, 0]
        weight = 1 / np.sqrt(1 + (r**2).sum(axis=1) / usual**2)
        across = (across @ turn) * weight[:, None, None]
        by_pose = lever(np.eye(3), point, np.ones(len(point)))
        J = across @ (by_pose @ (self._by_first[s.host, :6] - self._by_first[s.at, :6]))
        return r * weight[:, None], J, (across @ along)[:, :, 0]

    def _step(self, r: F64, J: F64, by_depth: F64) -> None:
        """Least squares with depths eliminated."""
        which, N = self._sights.which, len(self.depth)
        own = 1 / self._usual_depth**2
        known = own + np.bincount(which, (by_depth**2).sum(axis=1), N)
        wanted = own * (self._usual_depth - self.depth) + np.bincount(which, (by_depth * r).sum(axis=1), N)
        shared = (J * by_depth[:, :, None]).sum(axis=1)
        cross = np.stack([np.bincount(which, column, N) for column in shared.T])
        flat = J.reshape(-1, SIDE)
        A = self._prior + flat.T @ flat - (cross / known) @ cross.T
        b = self._prior @ off(self._first, self.state) + flat.T @ r.ravel() - cross @ (wanted / known)
        x = np.asarray(np.linalg.solve(A, b), np.float64)
        self.depth = np.maximum(self.depth + (wanted - cross.T @ x) / known, _NEAREST)
        by, s = se3.exp(x[:6]), self.state
        v = by[:3, :3] @ s.v + x[6:9]
        self.state = replace(s, T=by @ s.T, v=v, bg=s.bg + x[9:12], ba=s.ba + x[12:])


def off(to: State, of: State) -> F64:
    """The error (15,) of pose, velocity and biases that takes one state to another."""
    return np.concatenate([gap(to.T, to.v, of.T, of.v), to.bg - of.bg, to.ba - of.ba])


def gap(T: F64, v: F64, from_T: F64, from_v: F64) -> F64:
    """The error (9,) that takes one pose and velocity to another."""
    by = T @ se3.inverse(from_T)
    return np.concatenate([se3.log(by), v - by[:3, :3] @ from_v])


_ROUNDS, _GAIN = 20, 0.1  # at most; of the cost, squared sigmas, below which it is settled
_DAMPING = 1e-4
_USUAL = 2.0  # sigmas; what is further off counts ever less (Cauchy)
_BEHIND = 1e3  # sigmas, of what is behind the camera
_LEAST = 1e-12


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame at stamp_ns, IMU time, with imu since the shot before. It sees at uv (M, 2) the features ids
    (M,), which the keyframes `host` (M,) see on rays (M, 2). keyframe: its own id, -1 where it is none."""

    stamp_ns: int
    imu: ImuBatch
    keyframe: int
    ids: I64
    host: I64
    ray: F64
    uv: F64


@dataclass(frozen=True, eq=False)
class Model:
    """IMU noise and gravity; sigma of a coordinate that is seen; common (6, 6), covariance of what a whole
    image is off by. Rooms: inverse depth 1/m, sigma of its logarithm, and by how much of it a feature
    may differ."""

    noise: ImuNoise
    gravity: float
    sigma: float
    common: F64
    room: float
    rooms: float
    differ: float


@dataclass(frozen=True, eq=False)
class Fit:
    """Of K shots T (K, 4, 4) and v (K, 3), the biases (3,), inverse depths rho (N,) of features ids (N,).
    cov: of the errors, 9 a shot, 6 of the biases, one a feature. cost: of a sight, squared sigmas."""

    T: F64
    v: F64
    bg: F64
    ba: F64
    ids: I64
    rho: F64
    cov: F64
    cost: float

    @property
    def moved(self) -> float:
        """How far the body came, as a part of how far features are."""
        far = np.linalg.norm(self.T[:, :3, 3] - self.T[0, :3, 3], axis=1).max()
        return float(far * np.median(self.rho))


def fit(shots: list[Shot], first: State, model: Model) -> Fit:
    """first: what was known at the first shot, which is a keyframe. Raises numpy.linalg.LinAlgError where
    nothing can be solved."""
    problem, damping = _Problem(shots, first, model), _DAMPING
    best = problem.normal()
    for _ in range(_ROUNDS):
        before = problem.means
        problem.move(*best.step(damping))
        new = problem.normal()
        if not new.cost <= best.cost:
            problem.means, damping = before, damping * 10
            continue
        gained, best, damping = best.cost - new.cost, new, damping / 10
        if gained < _GAIN:
            break
    return problem.result(best)


@dataclass(frozen=True, eq=False)
class _Means:
    """Poses (K, 4, 4), velocities (K, 3), biases (3,), logarithm of the room's inverse depth, inverse
    depths (N,), and by how much the body of each image is off (K, 6), on its right."""

    T: F64
    v: F64
    bg: F64
    ba: F64
    room: float
    rho: F64
    off: F64


class _Problem:
    def __init__(self, shots: list[Shot], first: State, model: Model) -> None:
        self._shots, self._first, self._model = shots, first, model
        self._prior = inverse(first.cov[:SIDE, :SIDE])
        self._common = inverse(model.common)
        number = {s.keyframe: k for k, s in enumerate(shots) if s.keyframe >= 0}
        ids, hosts, ray = (
            np.concatenate([getattr(s, name) for s in shots]) for name in ("ids", "host", "ray")
        )
        known = np.isin(hosts, list(number))
        self._ids, at = np.unique(ids[known], return_index=True)
        self._host = np.array([number[h] for h in hosts[known][at].tolist()], np.int64)
        self._ray = ray[known][at]
        self._sights = [self._of_shot(k) for k in range(len(shots))]
        self.means = self._start()

    def _of_shot(self, k: int) -> Sights:
        """What a shot sees of features of other ones, by host."""
        shot = self._shots[k]
        which = np.searchsorted(self._ids, shot.ids).clip(0, len(self._ids) - 1)
        rows = np.flatnonzero((self._ids[which] == shot.ids) & (self._host[which] != k))
        rows = rows[np.argsort(self._host[which[rows]], kind="stable")]
        which, each = which[rows], np.ones(len(rows))
        at, sigma = np.full(len(rows), k), self._model.sigma * each
        return Sights(at, self._host[which], which, self._ray[which], shot.uv[rows], sigma)

    def _start(self) -> _Means:
        first, others = self._sights[0], self._sights[1:]
        start = Shooting(
            self._first, self._carried, first.join(*others), len(self._ids), 1 / self._model.room
        )
        start.solve()
        s, rho = start.state, 1 / start.depth
        room = float(np.log(np.median(rho)))
        return _Means(start.T, start.v, s.bg, s.ba, room, rho, np.zeros((len(self._shots), 6)))

    def _carried(self, s: State) -> list[Motion]:
        """By IMU from the first shot on, where the state is s."""
        out: list[Motion] = []
        for k in range(len(self._shots) - 1):
            T, v = (out[-1].T, out[-1].v) if out else (s.T, s.v)
            out.append(self._motion(k, T, v, s.bg, s.ba))
        return out

    def _motion(self, k: int, T: F64, v: F64, bg: F64, ba: F64) -> Motion:
        """From shot k to the next."""
        m, a, b = self._model, self._shots[k], self._shots[k + 1]
        return integrate(T, v, bg, ba, b.imu, a.stamp_ns, b.stamp_ns, m.noise, m.gravity)

    def move(self, step: F64, by_rho: F64) -> None:
        """Means by what `Normal.step` says."""
        m, K = self.means, len(self._shots)
        e, rest = step[: SHOT * K].reshape(-1, SHOT), step[SHOT * K :]
        by = se3.exp(e[:, :6])
        v = (by[:, :3, :3] @ m.v[:, :, None])[:, :, 0] + e[:, 6:]
        room, of_image = m.room + float(rest[6]), m.off + rest[7:].reshape(K, 6)
        self.means = _Means(by @ m.T, v, m.bg + rest[:3], m.ba + rest[3:6], room, m.rho + by_rho, of_image)

    def normal(self) -> Normal:
        """Where the means are."""
        K, m = len(self._shots), self.means
        out = Normal(K, len(self._ids))
        now = self._at(0)
        out.add(np.r_[0:SHOT, out.biases], np.eye(SIDE), off(self._first, now), self._prior)
        self._add_room(out)
        for k in range(K - 1):
            motion = self._motion(k, m.T[k], m.v[k], m.bg, m.ba)
            F = motion.transition[:SHOT]
            J = np.concatenate([-F[:, :SHOT], np.eye(SHOT), -F[:, SHOT:]], axis=1)
            W = inverse(motion.noise[:SHOT, :SHOT] + _LEAST * np.eye(SHOT))
            at = np.r_[SHOT * k : SHOT * (k + 2), out.biases]
            out.add(at, J, gap(motion.T, motion.v, m.T[k + 1], m.v[k + 1]), W)
        for k in range(K):
            self._add_image(out, k)
        return out

    def _at(self, k: int, by: F64 | None = None) -> State:
        """The state at shot k; by: its image's body is off by so much."""
        m = self.means
        T = m.T[k] if by is None else m.T[k] @ se3.exp(by)
        now = replace(self._first, T=T, v=m.v[k], bg=m.bg, ba=m.ba, poses=m.T)
        return replace(now, ids=self._ids, host=self._host, ray=self._ray, rho=m.rho)

    def _add_room(self, out: Normal) -> None:
        """How far rooms are, and that features are as far as the room, more or less."""
        m, room = self._model, self.means.room
        out.add(np.array([out.room]), np.eye(1), np.array([np.log(m.room) - room]), np.eye(1) / m.rooms**2)
        share = self.means.rho * np.exp(-room)
        by_rho, by_room, r = np.exp(-room) / m.differ, -share / m.differ, (1 - share) / m.differ
        out.A[out.room, out.room] += by_room @ by_room
        out.b[out.room] += by_room @ r
        out.cross[out.room] += by_room * by_rho
        out.depth += by_rho**2
        out.b_rho += by_rho * r
        out.cost += float(r @ r)

    def _add_image(self, out: Normal, k: int) -> None:
        common = out.common(k)
        out.add(common, np.eye(6), -self.means.off[k], self._common)
        which, host = self._sights[k].which, self._sights[k].host
        if len(which) == 0:
            return
        r, J, by_rho = self._seen(k)
        square = np.nan_to_num((r**2).sum(axis=1), nan=_BEHIND**2)
        out.cost += float(_USUAL**2 * np.log1p(square / _USUAL**2).sum())
        weight = 1 / np.sqrt(1 + square / _USUAL**2)
        r, by_rho = (np.nan_to_num(x) * weight[:, None] for x in (r, by_rho))
        J = np.nan_to_num(J) * weight[:, None, None]
        out.depth[which] += (by_rho**2).sum(axis=1)
        out.b_rho[which] += (by_rho * r).sum(axis=1)
        shared = (J * by_rho[:, :, None]).sum(axis=1).T
        for h in np.unique(host).tolist():
            part = host == h
            at, mine = np.r_[out.pose(k), out.pose(h), common], J[part].reshape(-1, 18)
            out.A[np.ix_(at, at)] += mine.T @ mine
            out.b[at] += mine.T @ r[part].ravel()
            out.cross[np.ix_(at, which[part])] += shared[:, part]

    def _seen(self, k: int) -> tuple[F64, F64, F64]:
        """Of the M sights of shot k, in sigmas: residuals (M, 2), NaN behind the camera, and slopes by
        pose, host's pose and what the image is off by (M, 2, 18), and by inverse depth (M, 2)."""
        sights, sigma, now = self._sights[k], self._model.sigma, self._at(k, self.means.off[k])
        seen = measurement.predict(now, sights.which)
        by_pose = seen.by_pose / sigma
        J = np.concatenate([by_pose, -by_pose, by_pose @ se3.adjoint(now.T)], axis=2)
        return (sights.uv - seen.uv) / sigma, J, seen.by_rho / sigma

    def result(self, best: Normal) -> Fit:
        """best: `normal` of the means."""
        m, sights = self.means, sum(len(s.which) for s in self._sights)
        return Fit(m.T, m.v, m.bg, m.ba, self._ids, m.rho, best.covariance(), best.cost / max(sights, 1))
