"""Motion capture and IMU of one body in one batch: where the IMU really was.

Mocap alone is noisy, its body is not the IMU's, its world not quite level, its clock another. So all
are solved for at once: pose, velocity and biases at nodes, IMU preintegrated between them, mocap
poses at their own times, robust, through an unknown tilt, mounting and delay. The mathematics and
what it attains: docs/mocap-fit.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.errors import DataError, MisfitError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.batch import CHECK, Batch, Solved, node_covariances
from share.lab.mocap.mocap import Mocap, check_imu, holes
from share.lab.mocap.offset import coarse_offset
from share.lab.mocap.residuals import Residuals, residuals
from share.lab.mocap.scale import axis_scales
from share.lab.mocap.start import first_state, hand_eye, standing, up_in
from share.lab.mocap.state import FitOptions
from share.types import F64, I64, ImuBatch

_EDGE_NS = 50_000_000  # mocap this near to the ends is left out: the offset may yet carry it beyond
_LEAST_S = 2.0
_WORST_MM = 100.0  # a path farther than this from the mocap is not the same motion


@dataclass(frozen=True, eq=False)
class Fit:
    """What was found. World: the mocap's, levelled: z up, same origin, same heading.

    stamps_ns (N,), IMU clock; T_world_body (N, 4, 4) of the IMU; velocity (N, 3) m/s, world;
    gyro_bias, accel_bias (N, 3). gaps (G, 2) ns, IMU clock: where the mocap says nothing for longer
    than is bridged. breaks (N - 1,) bool: nothing joins this node to the next.
    R_mocap_world (3, 3): from the levelled world to the mocap's, which lies on its side where that has
    another axis `up` than z.
    T_body_mocap (4, 4). offset_ns: IMU clock minus mocap clock, in the middle of the path; drift_ppm: by
    how much it grows, microseconds a second.
    cov_shared (10, 10): of tilt (2) rad, T_body_mocap (rotation rad, translation m; at the right), offset
    s, drift. cov_poses (N, 6, 6): of T_world_body, perturbed at the right.
    too_long (3,): by how much the mocap's x, y, z are too long for the accelerometer (0.01: 1 %), which is
    not taken off; too_long_sigma (3,). strayed: by how many of its sigmas T_body_mocap has left the guess
    on its worst axis, 0 without one.
    """

    stamps_ns: I64
    T_world_body: F64
    velocity: F64
    gyro_bias: F64
    accel_bias: F64
    gaps: I64
    breaks: np.ndarray
    R_mocap_world: F64
    T_body_mocap: F64
    offset_ns: int
    drift_ppm: float
    cov_shared: F64
    cov_poses: F64
    too_long: F64
    too_long_sigma: F64
    strayed: float
    residuals: Residuals
    gravity: float

    @property
    def up(self) -> str:
        """The axis of the mocap's world that is nearest to up, such as "z" or "-y"."""
        up = self.R_mocap_world[:, 2]
        k = int(np.abs(up).argmax())
        return ("-" if up[k] < 0 else "") + "xyz"[k]

    @property
    def tilt_deg(self) -> float:
        """How far that axis is from the vertical."""
        return float(np.degrees(np.arccos(min(1.0, np.abs(self.R_mocap_world[:, 2]).max()))))


def fit(imu: ImuBatch, noise: ImuNoise, mocap: Mocap, options: FitOptions | None = None) -> Fit:
    """The path of the IMU over the time that both cover.

    Raises DataError for stamps out of order, holes in the IMU, no or too little overlap, a body that
    does not turn; MisfitError (a DataError) where the two do not tell of one motion.
    """
    options = options or FitOptions()
    check_imu(imu)
    inflated = _inflated(noise, options.imu_inflation)
    coarse_ns = 0 if options.within_s == 0 else coarse_offset(imu, mocap, options.within_s)
    near = _overlap(imu, mocap.shifted(coarse_ns)).thinned(round(1e9 / options.most_hz))
    guess, bias = _mounting(imu, near, options)
    turn = standing(up_in(near, imu, guess))
    near = near.turned(turn)
    nodes, breaks = _nodes(near, options)
    batch = Batch(imu, inflated, _inner(near, nodes, breaks), breaks, guess, options)
    return _report(batch, batch.settle(first_state(nodes, imu, near, guess, bias)), coarse_ns, turn)


def _inflated(noise: ImuNoise, times: float) -> ImuNoise:
    return replace(
        noise,
        gyro_density=noise.gyro_density * times,
        accel_density=noise.accel_density * times,
        gyro_walk=noise.gyro_walk * times,
        accel_walk=noise.accel_walk * times,
    )


def _overlap(imu: ImuBatch, mocap: Mocap) -> Mocap:
    """The mocap while the IMU runs."""
    start = max(int(imu.stamps_ns[0]), int(mocap.stamps_ns[0]))
    end = min(int(imu.stamps_ns[-1]), int(mocap.stamps_ns[-1]))
    if end - start < _LEAST_S * 1e9:
        raise DataError(
            f"mocap and IMU overlap by {max(end - start, 0) * 1e-9:.1f} s, at least {_LEAST_S:.0f} s "
            "are needed; are they of one recording?"
        )
    return mocap.between(start, end)


def _mounting(imu: ImuBatch, mocap: Mocap, options: FitOptions) -> tuple[F64, F64]:
    """A first T_body_mocap (4, 4), and gyro bias (3,)."""
    if options.T_body_mocap is not None:
        return options.T_body_mocap, np.zeros(3)
    R, bias = hand_eye(imu, mocap)
    return se3.compose(R, np.zeros(3)), bias


def _nodes(mocap: Mocap, options: FitOptions) -> tuple[I64, np.ndarray]:
    """Nodes (N,) ns at even times, none in holes that break the chain or in parts
    too short to stand alone; (N - 1,) bool: where it breaks."""
    step = round(options.node_s * 1e9)
    nodes = np.arange(mocap.stamps_ns[0], mocap.stamps_ns[-1] + 1, step)
    longest = round(options.break_s * 1e9)
    for start, end in holes(mocap.stamps_ns, longest):
        nodes = nodes[(nodes <= start) | (nodes >= end)]
    parts = np.split(nodes, np.flatnonzero(np.diff(nodes) > longest) + 1)
    parts = [part for part in parts if len(part) * step > _LEAST_S * 1e9]
    if not parts:
        raise DataError(f"mocap: nowhere sees the body for {_LEAST_S:.0f} s; record again")
    nodes = np.concatenate(parts)
    return nodes, np.diff(nodes) > longest


def _inner(mocap: Mocap, nodes: I64, breaks: np.ndarray) -> Mocap:
    """The mocap, less what the offset may yet carry beyond the ends of the chain or of its parts."""
    t = mocap.stamps_ns
    ends = np.concatenate([nodes[:1], nodes[:-1][breaks], nodes[1:][breaks], nodes[-1:]])
    near_end = np.abs(t[:, None] - ends).min(1) < _EDGE_NS
    inside = np.isin(np.searchsorted(nodes, t, "right") - 1, np.flatnonzero(~breaks))
    keep = inside & ~near_end
    return Mocap(t[keep], mocap.T[keep])


def _report(batch: Batch, solved: Solved, coarse_ns: int, turn: F64) -> Fit:
    state, options = solved.state, batch.options
    trusted = solved.trusted
    if trusted.mean() < 0.5:
        raise MisfitError(_apart(f"{100 * (1 - trusted.mean()):.0f} % of the mocap's poses are elsewhere"))
    dt = np.diff(state.stamps_ns)[~batch.breaks] * 1e-9
    sigma = np.repeat([options.sigma_rotation, options.sigma_position], 3)
    off = np.linalg.norm((solved.seen.residual * sigma).reshape(-1, 2, 3), axis=2)
    joined = solved.chain.without(batch.breaks)
    left = residuals(joined, dt, options.imu_inflation, off[:, 1], off[:, 0], trusted, options.sigma_position)
    if not left.position_mm < _WORST_MM:
        raise MisfitError(_apart(f"{left.position_mm:.0f} mm rms are left"))
    offset_ns = coarse_ns + round(state.offset_s * 1e9)
    at = state.in_imu_clock(batch.mocap.stamps_ns[trusted])
    scales, scales_cov = axis_scales(solved, batch.mocap, options.sigma_position, batch.share)
    covs = node_covariances(solved.normal, solved.cov_shared)
    return Fit(
        stamps_ns=state.stamps_ns,
        T_world_body=se3.compose(state.R, state.p),
        velocity=state.v,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        gaps=holes(_closed(at, state.stamps_ns), round(options.bridge_s * 1e9)),
        breaks=batch.breaks,
        R_mocap_world=turn.T @ state.R_mocap_world,
        T_body_mocap=state.T_body_mocap,
        offset_ns=offset_ns,
        drift_ppm=state.drift * 1e6,
        cov_shared=solved.cov_shared,
        cov_poses=_right(state.R, covs[:, :6, :6]),
        too_long=np.abs(turn.T) @ scales,
        too_long_sigma=np.abs(turn.T) @ np.sqrt(np.diag(scales_cov)),
        strayed=_strayed(state.T_body_mocap, options),
        residuals=left,
        gravity=options.gravity,
    )


def _strayed(T_body_mocap: F64, options: FitOptions) -> float:
    if options.T_body_mocap is None:
        return 0.0
    error = se3.log(se3.inverse(options.T_body_mocap) @ T_body_mocap)
    return float(np.abs(error / np.repeat(options.guess_sigma, 3)).max())


def _apart(what: str) -> str:
    return f"mocap and IMU do not tell of one motion: {what}; {CHECK}"


def _closed(seen: I64, nodes: I64) -> I64:
    """Stamps of what was seen, with both ends of the path."""
    return np.concatenate([nodes[:1], seen, nodes[-1:]])


def _right(R: F64, cov: F64) -> F64:
    """Covariances (N, 6, 6) with positions in the world -> perturbations at the right of the pose."""
    J = np.tile(np.eye(6), (len(R), 1, 1))
    J[:, 3:, 3:] = R.swapaxes(1, 2)
    return np.asarray(J @ cov @ J.swapaxes(1, 2), np.float64)
