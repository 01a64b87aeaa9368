"""Accuracy of an emulated session. Prints JSON, one agent a line.

    python tools/experiments/measure_emulation.py SESSION/NAME ...

`track_*`: the tracker without IMU. Of recorded motions also: `fit_*`: the path against its motion capture,
and the IMU against the path in units of its noise (rms of three axes; rotation, change of velocity).
`turn_*_mrad`: rms angle between two of three rotations from one picture to the next: by the recording's IMU
less the fitted bias, integrated; by the recorded pictures of cam0 (KLT, exact depth, PnP); by the path; of
the first two also the median, and `shift_ms` of best correlation.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.config import Config  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.absolute_pose import RansacOptions, absolute_pose  # noqa: E402
from share.geometry.camera import Camera, rays  # noqa: E402
from share.lab.emulate.motion.motion_plan import MotionPlan, plan_motions  # noqa: E402
from share.lab.emulate.motion.recorded import RecordedPath  # noqa: E402
from share.lab.emulate.world.layout import Layout  # noqa: E402
from share.lab.emulate.world.ray_casting import RayCaster  # noqa: E402
from share.lab.emulate.world.scenes import make_scene_layout  # noqa: E402
from share.lab.mocap.factors import interpolate_samples, preintegrate  # noqa: E402
from share.metrics.ate import ate_if_known  # noqa: E402
from share.recordings.session import read_session  # noqa: E402
from share.runtime.offline_tracking import track  # noqa: E402
from share.runtime.source import Source, open_source  # noqa: E402
from share.sensors.measurement import CAM0, IMU  # noqa: E402
from share.types import F64, I64, U8, ImuBatch  # noqa: E402
from share.vision.corners import detect  # noqa: E402
from share.vision.optical_flow import track_points  # noqa: E402

Row = dict[str, Any]
CORNERS, SPACING_PX, INLIER_PX, LEAST = 200, 16, 1.0, 20
SHIFTS_MS = np.arange(-12.0, 12.25, 0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sessions", nargs="+", metavar="SESSION/NAME")
    for name in parser.parse_args().sessions:
        print(json.dumps(of_session(name)), flush=True)


def of_session(name: str) -> Row:
    """Return figures of one agent of a session."""
    source = open_source(name)
    row: Row = {"agent": name} | tracked(source)
    about = read_session(Path(name).parent).provenance
    planned = replanned(about)
    path = next(a.path for a in planned.agents if a.name == Path(name).name)
    if isinstance(path, RecordedPath):
        row |= {"size_m": planned.layout.size} | fitted(path) | turned(source, path, planned.layout)
    return row


def replanned(about: Row) -> MotionPlan:
    """Plan a session's motions again from its recipe."""
    size = about["size"] and tuple(about["size"])
    return plan_motions(
        about["motions"],
        make_scene_layout(about["scene"], about["seed"], size),
        about["seconds"],
        about["seed"],
    )


def tracked(source: Source) -> Row:
    """Track by cameras alone, causal."""
    run = track(source, Config(), lambda _: None)
    whole = run.report["segments"] == 1
    found = ate_if_known(run.trajectory, source.truth()) if whole else None
    return {
        "track_frames": run.report["frames"],
        "track_tracked": run.report["tracked"],
        "track_init_s": run.report["init_s"],
        "track_lost_s": _round(run.report["lost_s"]),
        "track_stretches": run.report["segments"],
        "track_ate_cm": _round(100 * found.rmse) if found else None,
        "track_worst_cm": _round(100 * found.max) if found else None,
    }


def fitted(path: RecordedPath) -> Row:
    left = path.fit.residuals
    return {
        "fit_mm": _round(left.position_mm),
        "fit_p95_mm": _round(left.position_p95_mm),
        "fit_deg": _round(left.rotation_deg),
        "fit_imu_turn_sigmas": _round(_rms(left.imu_sigmas[:3])),
        "fit_imu_velocity_sigmas": _round(_rms(left.imu_sigmas[3:])),
        "fit_gaps": len(path.gaps),
    }


def turned(source: Source, path: RecordedPath, room: Layout) -> Row:
    """Compare rotations between pictures, by three sources."""
    imu, stamps = inertial(source), I64_of(stamp for stamp, _ in pictures(source))
    start, end, seen = rotations_by_pictures(source, path, room)
    inside = (start >= imu.stamps_ns[0] + _ns(SHIFTS_MS[-1])) & (end <= imu.stamps_ns[-1] + _ns(SHIFTS_MS[0]))
    start, end, seen = start[inside], end[inside], seen[inside]
    felt, gone = rotations_by_gyro(imu, path, start, end), path_turns(path, start, end)
    return {
        "intervals": len(start),
        "of": len(stamps) - 1,
        "turn_median_mrad": _mrad(np.median(se3.rotation_angle(felt))),
        "turn_most_mrad": _mrad(se3.rotation_angle(felt).max()),
        "turn_imu_images_mrad": _mrad(_rms_between(felt, seen)),
        "turn_imu_images_median_mrad": _mrad(np.median(se3.rotation_angle(felt.swapaxes(1, 2) @ seen))),
        "turn_imu_path_mrad": _mrad(_rms_between(felt, gone)),
        "turn_images_path_mrad": _mrad(_rms_between(seen, gone)),
        "shift_ms": _round(best_shift_ms(imu, path, start, end, seen)),
    }


def pictures(source: Source) -> Iterator[tuple[int, Any]]:
    return ((m.stamp_ns, m.payload) for m in source.measurements() if m.stream == CAM0)


def inertial(source: Source) -> ImuBatch:
    """Return the recording's IMU samples."""
    found = [(m.stamp_ns, *m.payload) for m in source.measurements() if m.stream == IMU]
    values = np.array([row[1:] for row in found])
    return ImuBatch(I64_of(row[0] for row in found), values[:, :3], values[:, 3:])


def rotations_by_pictures(source: Source, path: RecordedPath, room: Layout) -> tuple[I64, I64, F64]:
    """Return stamps (N,) of a picture and the next, and R_body_next (N, 3, 3) by the pictures alone: depths
    are those of the room at the first camera's true pose, and PnP finds the second. Pairs with a gap (lost
    frames, no ground truth) or too few matches are left out."""
    rig, scene = source.rig, scene_of([p.shape.mesh.triangles for p in room.all_pieces])
    R = rig.T_body_cam0[:3, :3]
    longest = 1.5 * float(np.median(np.diff(I64_of(stamp for stamp, _ in pictures(source)))))
    found = []
    for (t0, before), (t1, after) in pairwise((t, image.load()) for t, image in pictures(source)):
        if t1 - t0 > longest or not path.start_ns <= t0 < t1 <= path.end_ns:
            continue
        T_world_cam = path.poses(np.array([t0]))[0] @ rig.T_body_cam0
        T = relative(before, after, rig.cam0, scene, T_world_cam)
        if T is not None:
            found.append((t0, t1, R @ T[:3, :3].T @ R.T))
    start, end, turns = zip(*found, strict=True)
    return I64_of(start), I64_of(end), np.array(turns)


def relative(before: U8, after: U8, camera: Camera, scene: RayCaster, T_world_cam: F64) -> F64 | None:
    """Return T_after_before (4, 4) of a camera, None where the pictures do not determine it."""
    px = detect(before, np.zeros((0, 2), np.float32), CORNERS, SPACING_PX)
    there, ok = track_points(before, after, px, px)
    directions = rays(camera.normalise(px[ok].astype(float)))
    points, hit = first_hits(scene, T_world_cam, directions)
    points = se3.transform(se3.inverse(T_world_cam), points)[hit]
    if len(points) < LEAST:
        return None
    uv = camera.normalise(there[ok][hit].astype(float))
    T, inliers = absolute_pose(points, uv, camera.focal, RansacOptions(INLIER_PX, seed=0))
    return T if inliers.sum() >= LEAST else None


def rotations_by_gyro(imu: ImuBatch, path: RecordedPath, start: I64, end: I64) -> F64:
    """Return R_start_end (N, 3, 3) of the body by the gyro, less the fitted bias."""
    nodes = ImuBatch(path.fit.stamps_ns, path.fit.gyro_bias, path.fit.accel_bias)
    bias = interpolate_samples(nodes, start, nodes.gyro)
    return preintegrate(imu, start, end, bias, 0 * bias).dR


def path_turns(path: RecordedPath, start: I64, end: I64) -> F64:
    return np.asarray(path.poses(start)[:, :3, :3].swapaxes(1, 2) @ path.poses(end)[:, :3, :3], np.float64)


def best_shift_ms(imu: ImuBatch, path: RecordedPath, start: I64, end: I64, seen: F64) -> float:
    """Return the delay of the gyro: the peak of the normalised correlation of the rotations, interpolated by
    a parabola."""
    turns = se3.so3_log(seen)
    scores = []
    for shift in SHIFTS_MS:
        felt = se3.so3_log(rotations_by_gyro(imu, path, start + _ns(shift), end + _ns(shift)))
        scores.append(float((turns * felt).sum() / np.sqrt((turns**2).sum() * (felt**2).sum())))
    k = int(np.argmax(scores).clip(1, len(scores) - 2))
    a, b, c = scores[k - 1 : k + 2]
    return float(SHIFTS_MS[k] + (SHIFTS_MS[1] - SHIFTS_MS[0]) * 0.5 * (a - c) / (a - 2 * b + c))


def scene_of(triangles: list[Any]) -> RayCaster:
    return RayCaster(np.concatenate(triangles).astype(np.float32))


def first_hits(scene: RayCaster, T_world_cam: F64, rays: F64) -> tuple[F64, np.ndarray]:
    """Return world points (N, 3) that a camera's rays (N, 3) meet first, and which meet any (N,)."""
    start = np.tile(T_world_cam[:3, 3], (len(rays), 1)).astype(np.float32)
    which, weights = scene.first_hits(start, (rays @ T_world_cam[:3, :3].T).astype(np.float32))
    points: F64 = np.einsum("nc,ncd->nd", weights.astype(float), scene.triangles[which].astype(float))
    return points, which >= 0


def I64_of(values: Any) -> I64:
    return np.array(list(values), np.int64)


def _rms_between(a: F64, b: F64) -> float:
    """Return the rms angle between rotations (N, 3, 3), rad."""
    return _rms(se3.rotation_angle(a.swapaxes(1, 2) @ b))


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _ns(ms: float) -> int:
    return round(ms * 1e6)


def _mrad(rad: Any) -> float:
    return _round(1e3 * float(rad))


def _round(value: Any) -> float:
    return round(float(value), 3)


if __name__ == "__main__":
    main()
