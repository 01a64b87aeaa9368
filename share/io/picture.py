"""The trajectories of a run as one picture: seen from above, and height over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from share.geometry.se3 import transform
from share.io.figure import save
from share.io.trajectory import Trajectory
from share.types import F64

_COLOURS = ("#d1495b", "#00798c", "#edae49", "#66508c", "#3a7d44", "#8d5b4c")


def draw_trajectories(
    path: Path,
    agents: Mapping[str, tuple[Trajectory | None, Trajectory]],
    T_truth_map: F64,
    title: str,
) -> None:
    """PNG of {name: (poses in the shared map or None, truth)}; T_truth_map (4, 4) lays one on the other."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (above, error) = pyplot.subplots(
        1, 2, figsize=(13, 6.2), width_ratios=(3, 2), layout="constrained"
    )
    start = min(truth.stamps_ns[0] for _, truth in agents.values())
    for (name, (estimate, truth)), colour in zip(agents.items(), _COLOURS * len(agents), strict=False):
        p = truth.T[:, :3, 3]
        above.plot(p[:, 0], p[:, 1], color=colour, alpha=0.3, linewidth=5, solid_capstyle="round")
        if estimate is None:
            continue
        q = transform(T_truth_map, estimate.T[:, :3, 3])
        above.plot(q[:, 0], q[:, 1], color=colour, linewidth=1.2, label=name)
        above.plot(*q[0, :2], "o", color=colour, markersize=6)
        t = (estimate.stamps_ns - start) * 1e-9
        at = np.array([np.interp(estimate.stamps_ns, truth.stamps_ns, p[:, k]) for k in range(3)]).T
        error.plot(t, 100 * np.linalg.norm(q - at, axis=1), color=colour, linewidth=1.2, label=name)
    above.set(title="from above: truth (broad), in the shared map (thin)", xlabel="x [m]", ylabel="y [m]")
    above.set_aspect("equal")
    error.set(title="position error in the shared map", xlabel="time [s]", ylabel="cm")
    error.set_ylim(bottom=0)
    for axes in (above, error):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    figure.suptitle(title)
    save(figure, path, 110)
