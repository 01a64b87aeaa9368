"""What the shared map does to each agent's path: compare map.tum with odom.tum in finished runs.

    python tools/experiments/measure_map.py RUN ... [--json FILE]

RUN: a folder by `share evaluate run`. Prints a Markdown table with a line per run and agent, and the means.

Protocol: causal poses of all frames in the map, those of odometry at the same stamps; each path is aligned
alone (SE3). *late*: in the second half of the agent's time in the map. RPE over 1 s. A step is the change of
T_map_odom from one frame to the next, in mm at the body, and in mm at most at a point 3 m from it; one over
100 mm is a jump (at a merge) and counted apart. NaN where an agent has too few poses.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.errors import DataError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.lab.evaluate.scoring import score_session  # noqa: E402
from share.lab.evaluate.trial import Trial, read_trial  # noqa: E402
from share.metrics.ate import ate  # noqa: E402
from share.metrics.rpe import rpe_time  # noqa: E402
from share.recordings.trajectory import Trajectory, read_tum  # noqa: E402

_STEP_MM, _JUMP_MM, _AHEAD_M = 1.0, 100.0, 3.0


@dataclass(frozen=True)
class PathInMap:
    """Errors of one agent's path in cm; map_ and odom_: of the same frames. steps_per_s: over 1 mm at the
    body, ahead_per_s: at a point 3 m from it."""

    run: str
    agent: str
    joint_cm: float  # of the run
    seconds: float
    map_cm: float
    odom_cm: float
    late_map_cm: float
    late_odom_cm: float
    map_rpe_cm: float
    odom_rpe_cm: float
    steps_per_s: float
    ahead_per_s: float
    max_step_mm: float
    jumps: int

    @property
    def ratio(self) -> float:
        return self.map_cm / self.odom_cm

    @property
    def late_ratio(self) -> float:
        return self.late_map_cm / self.late_odom_cm


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    options = parser.parse_args()
    return exit_code("measure_map", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    paths = [path for folder in options.runs for path in paths_in_map(read_trial(folder))]
    print(table(paths))
    if options.json:
        options.json.write_text(json.dumps([asdict(path) for path in paths], indent=1) + "\n")


def paths_in_map(trial: Trial) -> list[PathInMap]:
    """Return a line for each agent that ends in the largest map."""
    joint = score_session(trial.session, trial.folders).joint
    if joint is None:
        return []
    out = []
    for name in joint.agents:
        in_map, odometry = (read_tum(trial.folders[name] / f"{kind}.tum") for kind in ("map", "odom"))
        truth = read_tum(trial.session.folder / "truth" / f"{name}.tum")
        out.append(path_in_map(trial.folder.name, name, 100 * joint.joint.rmse, in_map, odometry, truth))
    return out


def path_in_map(
    run: str, agent: str, joint_cm: float, in_map: Trajectory, odometry: Trajectory, truth: Trajectory
) -> PathInMap:
    """Compare one agent's two paths at the stamps that both have."""
    _, i, j = np.intersect1d(in_map.stamps_ns, odometry.stamps_ns, return_indices=True)
    pair = _at(in_map, i), _at(odometry, j)
    late = _at(in_map, i[len(i) // 2 :]), _at(odometry, j[len(j) // 2 :])
    seconds = float(np.ptp(pair[0].stamps_ns)) * 1e-9 if len(i) else math.nan
    steps_mm, ahead_mm = correction_steps(*pair)
    is_step = steps_mm < _JUMP_MM
    map_cm, odom_cm, late_map_cm, late_odom_cm = (_ate_cm(path, truth) for path in (*pair, *late))
    map_rpe_cm, odom_rpe_cm = (_rpe_cm(path, truth) for path in pair)
    return PathInMap(
        run,
        agent,
        joint_cm,
        seconds,
        map_cm,
        odom_cm,
        late_map_cm,
        late_odom_cm,
        map_rpe_cm,
        odom_rpe_cm,
        float((is_step & (steps_mm > _STEP_MM)).sum()) / seconds,
        float((is_step & (ahead_mm > _STEP_MM)).sum()) / seconds,
        float(steps_mm[is_step].max(initial=0.0)),
        int((~is_step).sum()),
    )


def correction_steps(in_map: Trajectory, odometry: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each of N - 1 changes of T_map_odom moves the body (mm), and at most a point 3 m
    from it (mm)."""
    T_map_odom = in_map.T @ se3.inverse(odometry.T)
    change = se3.inverse(in_map.T[1:]) @ T_map_odom[:-1] @ odometry.T[1:]  # of the body's pose, in its frame
    moved_mm = 1e3 * np.linalg.norm(change[:, :3, 3], axis=1)
    return moved_mm, moved_mm + 1e3 * _AHEAD_M * se3.rotation_angle(change)


def _at(path: Trajectory, indices: np.ndarray) -> Trajectory:
    return Trajectory(path.stamps_ns[indices], path.T[indices])


def _ate_cm(path: Trajectory, truth: Trajectory) -> float:
    try:
        return 100 * ate(path, truth).rmse
    except DataError:
        return math.nan


def _rpe_cm(path: Trajectory, truth: Trajectory) -> float:
    try:
        return 100 * rpe_time(path, truth).translation.rmse
    except DataError:
        return math.nan


def table(paths: Sequence[PathInMap]) -> str:
    head = ["run", "agent", "s in map", "joint cm", "map / odometry cm", "ratio", "late ratio", "RPE ratio"]
    head += ["steps > 1 mm /s", "3 m ahead /s", "max mm", "jumps"]
    rows = [line(head), line(["---"] * len(head))]
    for p in paths:
        cells = [p.run, p.agent, f"{p.seconds:.0f}", f"{p.joint_cm:.2f}", f"{p.map_cm:.2f} / {p.odom_cm:.2f}"]
        cells += [f"{value:.2f}" for value in (p.ratio, p.late_ratio, p.map_rpe_cm / p.odom_rpe_cm)]
        cells += [f"{p.steps_per_s:.2f}", f"{p.ahead_per_s:.2f}", f"{p.max_step_mm:.1f}", str(p.jumps)]
        rows.append(line(cells))
    for name, values in (
        ("ratio", [p.ratio for p in paths]),
        ("late ratio", [p.late_ratio for p in paths]),
        ("RPE ratio", [p.map_rpe_cm / p.odom_rpe_cm for p in paths]),
    ):
        known = np.array([value for value in values if math.isfinite(value)])
        if len(known):
            geometric = math.exp(float(np.log(known).mean()))
            rows.append(
                f"\n{name}: mean {known.mean():.2f}, geometric {geometric:.2f}, most {known.max():.2f}, "
                f"{(known <= 1).sum()} of {len(known)} at most 1"
            )
    joints = sorted({(p.run, p.joint_cm) for p in paths})
    if joints:
        rows.append(f"\njoint ATE: {', '.join(f'{cm:.2f}' for _, cm in joints)} cm")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(main())
