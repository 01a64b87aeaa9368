"""Batch fit of motion capture and IMU of one body: the IMU's true path.

Mocap alone is noisy, its body is not the IMU's, its world is not quite level, its clock is another. So all
are estimated together: pose, velocity and biases at nodes, IMU preintegration between them, mocap poses at
their own times with robust weights, through an unknown tilt, mounting and time offset. Mathematics and
accuracy: docs/understand/mocap-fit.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.least_squares import ArrowFactor
from share.lab.mocap.initialisation import initial_rotation, initial_state, nearest_axis_rotation, up_vector
from share.lab.mocap.offset import find_offset
from share.lab.mocap.problem import CHECK, BatchSolution, MocapImuProblem, axis_scales
from share.lab.mocap.state import MocapFitOptions
from share.lab.mocap.trajectory import MocapTrajectory, check_imu, find_gaps
from share.types import F64, I64, ImuBatch

_END_MARGIN_NS = 50_000_000  # mocap nearer to the ends is left out: the final offset may shift it beyond
_MIN_DURATION_S = 2.0
_NODE_NS = 50_000_000  # between nodes
_MAX_INTEGRATED_NS = 10 * 10**9  # the IMU is not integrated across longer mocap gaps
_MIN_SPACING_NS = 4_000_000  # denser mocap samples are thinned
_MAX_RMS_MM = 100.0  # a path farther from the mocap is another motion


@dataclass(frozen=True, eq=False)
class FitResiduals:
    """position_mm, rotation_deg: rms distance of the path from the inlier mocap samples. position_sigmas: the
    former in units of the stated mocap noise. position_p95_mm, rotation_p95_deg: of all samples. samples:
    their number.

    imu_sigmas (6,): rms residual of rotation (x, y, z) and velocity change (x, y, z) between nodes, in units
    of the data sheet's noise. gyro (3,) rad/s, accel (3,) m/s^2: the same as mean rates.
    """

    position_mm: float
    rotation_deg: float
    position_sigmas: float
    position_p95_mm: float
    rotation_p95_deg: float
    samples: int
    outlier_share: float
    imu_sigmas: F64
    gyro: F64
    accel: F64


@dataclass(frozen=True, eq=False)
class MocapFit:
    """Result of a fit. World: the mocap's, levelled: z up, same origin, same heading.

    * stamps_ns (N,), IMU clock; T_world_body (N, 4, 4) of the IMU; velocity (N, 3) m/s, world; gyro_bias,
      accel_bias (N, 3).
    * gaps (G, 2) ns, IMU clock: mocap gaps too long to bridge. is_break (N - 1,) bool: nothing joins
      this node to the next.
    * R_mocap_world (3, 3): from the levelled world to the mocap's; with a quarter or half turn where another
      axis than z is `up`.
    * T_body_mocap (4, 4). offset_ns: IMU clock minus mocap clock, in the middle of the path; drift_ppm: its
      growth, microseconds a second.
    * cov_shared (10, 10): of tilt (2) rad, T_body_mocap (rotation rad, translation m; on the right), offset
      s, drift. cov_poses (N, 6, 6): of T_world_body, perturbed on the right.
    * scale_error (3,): by how much the mocap's x, y, z are too long by the accelerometer (0.01: 1 %), not
      corrected; scale_error_sigma (3,).
    * mounting_prior_sigmas: deviation of T_body_mocap from its guess on the worst axis, in sigmas of the
      guess; 0 without one.
    """

    stamps_ns: I64
    T_world_body: F64
    velocity: F64
    gyro_bias: F64
    accel_bias: F64
    gaps: I64
    is_break: np.ndarray
    R_mocap_world: F64
    T_body_mocap: F64
    offset_ns: int
    drift_ppm: float
    cov_shared: F64
    cov_poses: F64
    scale_error: F64
    scale_error_sigma: F64
    mounting_prior_sigmas: float
    residuals: FitResiduals
    gravity: float

    @property
    def up(self) -> str:
        """The axis of the mocap's world nearest to vertical, such as "z" or "-y"."""
        up = self.R_mocap_world[:, 2]
        k = int(np.abs(up).argmax())
        return ("-" if up[k] < 0 else "") + "xyz"[k]

    @property
    def tilt_deg(self) -> float:
        """Angle of that axis to the vertical."""
        return float(np.degrees(np.arccos(min(1.0, np.abs(self.R_mocap_world[:, 2]).max()))))


def fit_mocap(
    imu: ImuBatch, noise: ImuNoise, mocap: MocapTrajectory, options: MocapFitOptions | None = None
) -> MocapFit:
    """Fit the IMU's path over the time that both cover.

    Raises DataError for unordered stamps, gaps in the IMU, too little overlap, a body that does not turn;
    CalibrationMismatchError (a DataError) where the two are not of one motion.
    """
    options = options or MocapFitOptions()
    check_imu(imu)
    inflated = _inflated_noise(noise, options.imu_inflation)
    coarse_ns = 0 if options.within_s == 0 else find_offset(imu, mocap, options.within_s).offset_ns
    overlap = _overlap(imu, mocap.shifted(coarse_ns)).thinned(_MIN_SPACING_NS)
    guess, bias = _initial_mounting(imu, overlap, options)
    up_rotation = nearest_axis_rotation(up_vector(overlap, imu, guess))
    overlap = overlap.rotated(up_rotation)
    nodes, breaks = _node_stamps(overlap)
    batch = MocapImuProblem(imu, inflated, _without_ends(overlap, nodes, breaks), breaks, guess, options)
    return _make_fit(
        batch, batch.solve_robustly(initial_state(nodes, imu, overlap, guess, bias)), coarse_ns, up_rotation
    )


def _inflated_noise(noise: ImuNoise, factor: float) -> ImuNoise:
    return replace(
        noise,
        gyro_density=noise.gyro_density * factor,
        accel_density=noise.accel_density * factor,
        gyro_walk=noise.gyro_walk * factor,
        accel_walk=noise.accel_walk * factor,
    )


def _overlap(imu: ImuBatch, mocap: MocapTrajectory) -> MocapTrajectory:
    """Return the mocap while the IMU runs."""
    start = max(int(imu.stamps_ns[0]), int(mocap.stamps_ns[0]))
    end = min(int(imu.stamps_ns[-1]), int(mocap.stamps_ns[-1]))
    if end - start < _MIN_DURATION_S * 1e9:
        raise DataError(
            f"mocap and IMU overlap by {max(end - start, 0) * 1e-9:.1f} s, at least {_MIN_DURATION_S:.0f} s "
            "are needed; are they of one recording?"
        )
    return mocap.between(start, end)


def _initial_mounting(imu: ImuBatch, mocap: MocapTrajectory, options: MocapFitOptions) -> tuple[F64, F64]:
    """Return a first T_body_mocap (4, 4), and gyro bias (3,)."""
    if options.T_body_mocap is not None:
        return options.T_body_mocap, np.zeros(3)
    R, bias = initial_rotation(imu, mocap)
    return se3.from_rt(R, np.zeros(3)), bias


def _node_stamps(mocap: MocapTrajectory) -> tuple[I64, np.ndarray]:
    """Return evenly spaced nodes (N,) ns, none in gaps that break the chain or in parts too short to fit,
    and (N - 1,) bool: where the chain breaks."""
    nodes = np.arange(mocap.stamps_ns[0], mocap.stamps_ns[-1] + 1, _NODE_NS)
    for start, end in find_gaps(mocap.stamps_ns, _MAX_INTEGRATED_NS):
        nodes = nodes[(nodes <= start) | (nodes >= end)]
    parts = np.split(nodes, np.flatnonzero(np.diff(nodes) > _MAX_INTEGRATED_NS) + 1)
    parts = [part for part in parts if len(part) * _NODE_NS > _MIN_DURATION_S * 1e9]
    if not parts:
        raise DataError(
            f"mocap: the body is never seen for {_MIN_DURATION_S:.0f} s without a gap; record again"
        )
    nodes = np.concatenate(parts)
    return nodes, np.diff(nodes) > _MAX_INTEGRATED_NS


def _without_ends(mocap: MocapTrajectory, nodes: I64, breaks: np.ndarray) -> MocapTrajectory:
    """Return the mocap without samples that the final offset may shift beyond the ends of the chain or of
    its parts."""
    t = mocap.stamps_ns
    ends = np.concatenate([nodes[:1], nodes[:-1][breaks], nodes[1:][breaks], nodes[-1:]])
    is_near_end = np.abs(t[:, None] - ends).min(1) < _END_MARGIN_NS
    inside = np.isin(np.searchsorted(nodes, t, "right") - 1, np.flatnonzero(~breaks))
    keep = inside & ~is_near_end
    return MocapTrajectory(t[keep], mocap.T[keep])


def _make_fit(batch: MocapImuProblem, solved: BatchSolution, coarse_ns: int, turn: F64) -> MocapFit:
    state, options = solved.state, batch.options
    inliers = solved.is_inlier
    if inliers.mean() < 0.5:
        raise CalibrationMismatchError(
            _misfit_text(f"{100 * (1 - inliers.mean()):.0f} % of the mocap's poses are outliers")
        )
    fit_residuals = _residual_statistics(batch, solved)
    if not fit_residuals.position_mm < _MAX_RMS_MM:
        raise CalibrationMismatchError(_misfit_text(f"{fit_residuals.position_mm:.0f} mm rms residual"))
    mounting_prior_sigmas = 0.0
    if options.T_body_mocap is not None:
        error = se3.log(se3.inverse(options.T_body_mocap) @ state.T_body_mocap)
        mounting_prior_sigmas = float(np.abs(error / np.repeat(options.guess_sigma, 3)).max())
    inlier_stamps = state.in_imu_clock(batch.mocap.stamps_ns[inliers])
    scales, scales_cov = axis_scales(solved, batch.mocap, options.sigma_position, batch.sample_weight)
    covs = solved.system.node_covariances()
    return MocapFit(
        stamps_ns=state.stamps_ns,
        T_world_body=se3.from_rt(state.R, state.p),
        velocity=state.v,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        gaps=find_gaps(
            np.concatenate([state.stamps_ns[:1], inlier_stamps, state.stamps_ns[-1:]]),
            round(options.max_bridged_s * 1e9),
        ),
        is_break=batch.is_break,
        R_mocap_world=turn.T @ state.R_mocap_world,
        T_body_mocap=state.T_body_mocap,
        offset_ns=coarse_ns + round(state.offset_s * 1e9),
        drift_ppm=state.drift * 1e6,
        cov_shared=ArrowFactor(solved.system).border_covariance,
        cov_poses=_right_perturbed(state.R, covs[:, :6, :6]),
        scale_error=np.abs(turn.T) @ scales,
        scale_error_sigma=np.abs(turn.T) @ np.sqrt(np.diag(scales_cov)),
        mounting_prior_sigmas=mounting_prior_sigmas,
        residuals=fit_residuals,
        gravity=options.gravity,
    )


def _misfit_text(reason: str) -> str:
    return f"mocap and IMU are not of one motion: {reason}; {CHECK}"


def _right_perturbed(R: F64, cov: F64) -> F64:
    """Return covariances (N, 6, 6), given with positions in the world, as perturbations on the right of
    the pose."""
    J = np.tile(np.eye(6), (len(R), 1, 1))
    J[:, 3:, 3:] = R.swapaxes(1, 2)
    return np.asarray(J @ cov @ J.swapaxes(1, 2), np.float64)


def _residual_statistics(batch: MocapImuProblem, solved: BatchSolution) -> FitResiduals:
    options, inliers, joined = batch.options, solved.is_inlier, ~batch.is_break
    sigma = np.repeat([options.sigma_rotation, options.sigma_position], 3)
    vectors = (solved.observations.residual * sigma).reshape(-1, 2, 3)
    angles, distances = np.linalg.norm(vectors, axis=2).T
    mm, deg = distances * 1e3, np.degrees(angles)
    rotation_and_velocity = [0, 1, 2, 6, 7, 8]
    raw = solved.chain.raw[joined][:, rotation_and_velocity]
    variances = np.diagonal(solved.chain.cov[joined], axis1=1, axis2=2)[:, rotation_and_velocity]
    rates = _rms(raw / (np.diff(solved.state.stamps_ns)[joined] * 1e-9)[:, None])
    return FitResiduals(
        position_mm=float(_rms(mm[inliers])),
        rotation_deg=float(_rms(deg[inliers])),
        position_sigmas=float(_rms(distances[inliers])) / (options.sigma_position * np.sqrt(3)),
        position_p95_mm=float(np.percentile(mm, 95)),
        rotation_p95_deg=float(np.percentile(deg, 95)),
        samples=len(mm),
        outlier_share=float(1 - inliers.mean()),
        imu_sigmas=_rms(raw / np.sqrt(variances) * options.imu_inflation),
        gyro=rates[:3],
        accel=rates[3:],
    )


def _rms(values: F64) -> F64:
    return np.asarray(np.sqrt((values**2).mean(0)), np.float64)
