"""A wearer without a browser: how well a headset is aligned, and how far from its place a cube is drawn.

Both by the references in Python, which the page's modules are held to (tests/headset/test_page_maths.py).

align: seeds of 60 s of walking and looking around, 30 pairs a second. The map's pose errs by 5 mm and 0.08°
an axis (one sigma), lasting 8 s; the headset's own tracking drifts by 1 mm and 0.0115° an axis in the root
of a second, and trembles. The mount: as exact as a calibration leaves it (1 mm, 0.03°), or 2° wrong about
an axis. Errors of the viewer from 2 s on. A wrong mount counts as noticed once over a tenth of the newest
100 pairs contradict the alignment, as in the page.

follow: a recorded motion (TUM-VI's truth), of which the moments count in which it turns by at most 1.5
rad/s. 72 frames a second, shown 20 ms after the page draws; poses of 30 Hz with the errors above and 0.3
mm, 0.02° more from pose to pose, as old as a policy makes them (means; half of it constant, half
exponential), then 10 to 30 ms on the way to the page. A cube is 1.5 m ahead; 25 px are a degree (Quest 3).
In align the headset's prediction of its own pose counts as true.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from helpers.headset_reference import PairOutcome, PosePair, SpaceAlignment, pose_cov, predict_pose
from helpers.headset_wearer import MAP_SIGMA, T_body_viewer, wearer

from share.errors import UsageError
from share.geometry import se3
from share.headset.frame_times import MotionEstimate
from share.types import F64

_HZ = 30
_JUDGED, _MAX_REFUSED_SHARE = 100, 0.1  # as in placement.js
_MOUNT_SIGMA = np.repeat([np.radians(0.03), 0.001], 3) / np.sqrt(3)
_SIGMAS = np.sqrt(3) * MAP_SIGMA[3], np.sqrt(3) * MAP_SIGMA[0]  # as an agent says them, m and rad
_AGE_MS = {"share": 19.7, "covins-g": 34.9}  # mean of headsets on wifi5 (docs/lab/scheduling-figures.md)
_DISPLAY_HZ, _SHOWN_S = 72, 0.020
_WAY_S = 0.010, 0.030
_AHEAD_M, _PX_RAD = 1.5, 25 * 180 / np.pi
_MAX_TURN = 1.5  # rad/s
_SECONDS = 60.0

Figures = dict[str, Any]


def measure_alignment(seeds: Sequence[int]) -> Figures:
    rotation, translation, false_alarms = [], [], 0
    for seed in seeds:
        error = np.random.default_rng([seed, 1]).normal(size=6) * _MOUNT_SIGMA
        errors, noticed_s = _aligned(seed, error)
        rotation.append(np.degrees(np.linalg.norm(errors[2 * _HZ :, :3], axis=1)))
        translation.append(1e3 * np.linalg.norm(errors[2 * _HZ :, 3:], axis=1))
        false_alarms += noticed_s is not None
    wrong = {}
    for axis, name in enumerate("xyz"):
        times = [_aligned(seed, np.eye(6)[axis] * np.radians(2))[1] for seed in seeds]
        seen = [one for one in times if one is not None]
        wrong[name] = {"noticed": len(seen), "median_s": float(np.median(seen)) if seen else None}
    return {
        "seeds": [min(seeds), max(seeds)],
        "viewer_mm": _percentiles(np.concatenate(translation)),
        "viewer_deg": _percentiles(np.concatenate(rotation)),
        "called_wrong_though_calibrated": false_alarms,
        "mount_2_deg_wrong_about": wrong,
    }


def _aligned(seed: int, mount_error: F64) -> tuple[F64, float | None]:
    """Return the errors (N, 6) of the viewer, rad and m, and when the mount was called wrong, s."""
    pairs, truth = wearer(seed, mount_error, _HZ)
    alignment, refused, errors, noticed_s = SpaceAlignment(T_body_viewer), list[bool](), [], None
    cov = pose_cov(*_SIGMAS)
    for pair, T in zip(pairs, truth, strict=True):
        seen = PosePair(pair.time_s, pair.map_id, pair.T_map_body, cov, pair.T_local_viewer)
        alignment, outcome = alignment.after(seen)
        refused.append(outcome is PairOutcome.REFUSED)
        newest = refused[-_JUDGED:]
        if noticed_s is None and len(newest) == _JUDGED and sum(newest) > _MAX_REFUSED_SHARE * _JUDGED:
            noticed_s = float(pair.time_s)
        assert alignment.T_map_local is not None
        errors.append(se3.log(se3.inverse(T) @ alignment.T_map_local @ pair.T_local_viewer))
    return np.array(errors), noticed_s


# ---------------------------------------------------------------- follow


class Motion:
    """T_map_viewer of a recording between gaps, and where the viewer looks (3,)."""

    def __init__(self, path: Path) -> None:
        rows = np.loadtxt(path, delimiter=",", comments="#")
        self._t = (rows[:, 0] - rows[0, 0]) * 1e-9
        self._p, q = rows[:, 1:4], rows[:, [5, 6, 7, 4]]
        self._R = np.stack([se3.matrix_from_quat(one / np.linalg.norm(one)) for one in q])
        calibration = (path.parents[1] / "calib" / "kalibr_imucam_chain.yaml").read_text()
        chain = yaml.safe_load(re.sub(r"^%YAML:.*", "", calibration))  # OpenCV's first line
        self.ahead: F64 = np.array(chain["cam0"]["T_cam_imu"])[:3, :3].T @ [0.0, 0.0, 1.0]
        self.end_s = float(self._t[-1])

    def at(self, t: float) -> F64 | None:
        """Return the pose (4, 4) at a time; None in a gap."""
        k = int(np.searchsorted(self._t, t))
        if k == 0 or k == len(self._t) or self._t[k] - self._t[k - 1] > 0.03:
            return None
        share = (t - self._t[k - 1]) / (self._t[k] - self._t[k - 1])
        turn = se3.so3_log(self._R[k - 1].T @ self._R[k])
        return se3.from_rt(
            self._R[k - 1] @ se3.so3_exp(share * turn), self._p[k - 1] + share * (self._p[k] - self._p[k - 1])
        )


def measure_follow(truth: Path | None, seeds: Sequence[int]) -> Figures:
    if truth is None:
        raise UsageError("follow: --truth FOLDER/groundtruth.csv of a recorded motion is missing")
    motion = Motion(truth)
    errors: dict[str, list[tuple[float, float]]] = {}
    rates = []
    for seed in seeds:
        for policy, age_ms in _AGE_MS.items():
            for name, values in _drawn(motion, seed, age_ms, rates).items():
                errors.setdefault(name if name == "align" else f"{policy}, {name}", []).extend(values)
    return {
        "motion": truth.parent.name,
        "seeds": [min(seeds), max(seeds)],
        "turns_rad_s": _percentiles(np.array(rates)[:, 0]),
        "moves_m_s": _percentiles(np.array(rates)[:, 1]),
        "cube": {
            name: {
                "n": len(values),
                "rms_mm": round(1e3 * float(np.sqrt(np.mean(np.square(values)[:, 0]))), 1),
                "rms_px": round(float(np.sqrt(np.mean(np.square(values)[:, 1]))), 1),
                "p95_px": round(float(np.percentile(np.array(values)[:, 1], 95)), 1),
            }
            for name, values in errors.items()
        },
    }


def _drawn(
    motion: Motion, seed: int, age_ms: float, rates: list[tuple[float, float]]
) -> dict[str, list[tuple[float, float]]]:
    """Return how far from its place a cube is drawn, m and px, a frame and way to draw."""
    rng = np.random.default_rng(seed)
    begin = rng.uniform(0.0, motion.end_s - _SECONDS - 1.0)
    T_local_map, lasting = se3.exp(rng.normal(size=6)), np.exp(-1 / (_HZ * 8))
    error, walk, tremble = np.zeros(6), np.zeros(6), np.repeat([0.0002, 0.0005], 3)
    alignment, estimate, arriving = SpaceAlignment(T_body_viewer), MotionEstimate(), list[tuple[float, Any]]()
    newest, cov, drawn = None, pose_cov(*_SIGMAS), {"align": [], "follow": [], "follow, predicted": []}
    next_pose, step_s = begin, 1 / _DISPLAY_HZ
    T_map_body, viewer_to_body = np.eye(4), se3.inverse(T_body_viewer)
    for k in range(round(_SECONDS * _DISPLAY_HZ)):
        now = begin + k * step_s
        walk += rng.normal(size=6) * np.repeat([0.0002, 0.001], 3) * np.sqrt(step_s)
        while next_pose <= now:
            stamp, next_pose = next_pose, next_pose + 1 / _HZ
            error = lasting * error + np.sqrt(1 - lasting**2) * MAP_SIGMA * rng.normal(size=6)
            if (T := motion.at(stamp)) is None:
                estimate.forget()
                continue
            small = se3.exp(np.repeat([np.radians(0.02), 0.0003], 3) * rng.normal(size=6))
            T_map_body = T @ viewer_to_body @ se3.exp(error) @ small
            moving = estimate.add(round(stamp * 1e9), T_map_body)
            viewer = T_local_map @ _drift(walk) @ T @ se3.exp(rng.normal(size=6) * tremble)
            arrival = stamp + age_ms * 1e-3 * (0.5 + 0.5 * rng.exponential()) + rng.uniform(*_WAY_S)
            arriving.append((arrival, (stamp, T_map_body, moving, viewer)))
        while arriving and arriving[0][0] <= now:
            newest = arriving.pop(0)[1]
            alignment, _ = alignment.after(PosePair(newest[0], "map", newest[1], cov, newest[3]))
        shown = now + _SHOWN_S
        T, later = motion.at(shown), motion.at(shown + 0.02)
        if newest is None or newest[2] is None or T is None or later is None or now - begin < 5.0:
            continue
        if shown - newest[0] > 0.2:  # a gap of the recording
            continue
        turns = float(np.linalg.norm(se3.so3_log(T[:3, :3].T @ later[:3, :3]))) / 0.02
        if turns > _MAX_TURN:
            continue
        rates.append((turns, float(np.linalg.norm(later[:3, 3] - T[:3, 3])) / 0.02))
        assert alignment.T_map_local is not None
        local = T_local_map @ _drift(walk) @ T @ se3.exp(rng.normal(size=6) * tremble)
        stamp, body, moving, _ = newest
        ahead = predict_pose(body, moving.velocity, moving.angular_velocity, shown - stamp)
        for name, drawn_from in (
            ("align", alignment.T_map_local @ local),
            ("follow", body @ T_body_viewer),
            ("follow, predicted", ahead @ T_body_viewer),
        ):
            drawn[name].append(_cube_error(T, drawn_from, motion.ahead))
    return drawn


def _drift(walk: F64) -> F64:
    return se3.from_rt(se3.so3_exp(walk[:3]), walk[3:])


def _cube_error(T_map_viewer: F64, T_drawn: F64, ahead: F64) -> tuple[float, float]:
    """Return how far from its place a viewer sees a cube before it, m and px."""
    place = ahead * _AHEAD_M
    seen = (se3.inverse(T_drawn) @ T_map_viewer @ np.append(place, 1.0))[:3]
    angle = np.arctan2(np.linalg.norm(np.cross(seen, place)), seen @ place)
    return float(np.linalg.norm(seen - place)), float(angle * _PX_RAD)


def _percentiles(values: F64) -> Figures:
    p50, p95 = np.percentile(values, [50, 95]).round(3).tolist()
    return {"median": p50, "p95": p95}
