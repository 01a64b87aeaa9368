"""Field recordings laid on a motion capture: the paths from above, and how both turn, by one clock."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from share.io.figure import save
from share.io.trajectory import Trajectory
from share.mocap.align import Aligned
from share.mocap.offset import WINDOW_NS, imu_turning, mocap_turning
from share.types import F64, I64

_COLOURS = ("#d1495b", "#00798c", "#edae49", "#66508c", "#3a7d44", "#8d5b4c")
_SHOWN_NS = 10 * 10**9  # of the turning: longer, and nobody sees whether they agree
_HOLE_NS = 100_000_000  # farther apart, and no line joins two poses


def draw_alignment(path: Path, devices: Mapping[str, tuple[Aligned, Trajectory]]) -> None:
    """PNG of {name: (device, its truth)}."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(13, max(5.0, 1.9 * len(devices))), layout="constrained")
    grid = figure.add_gridspec(len(devices), 2, width_ratios=(2, 3))
    above = figure.add_subplot(grid[:, 0])
    for k, (name, (aligned, truth)) in enumerate(devices.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        p = _broken(truth)
        above.plot(p[:, 0], p[:, 1], color=colour, linewidth=1.2, label=f"{name}, {aligned.seconds:.1f} s")
        above.plot(*p[0, :2], "o", color=colour)
        _turning(figure.add_subplot(grid[k, 1]), name, aligned, colour)
    above.set(title="truth from above", xlabel="x [m]", ylabel="y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.grid(alpha=0.3)
    above.legend()
    save(figure, path, 110)


def _broken(truth: Trajectory) -> F64:
    """Positions (N, 3), with NaN where the truth has a gap."""
    return np.insert(truth.T[:, :3, 3], _after_holes(truth.stamps_ns), np.nan, axis=0)


def _after_holes(stamps_ns: I64) -> I64:
    return np.flatnonzero(np.diff(stamps_ns) > _HOLE_NS) + 1


def _turning(axes: Any, name: str, aligned: Aligned, colour: str) -> None:
    """Both turning rates by the motion capture's clock, about when the device turned most."""
    own, felt = _rate(*imu_turning(aligned.imu))
    own = own - aligned.offset_ns
    times, seen = _rate(*mocap_turning(aligned.mocap))
    start = _busiest(times, seen)
    for stamps, rate, look in (
        (own, felt, {"color": colour, "linewidth": 2.5, "alpha": 0.5, "label": "gyro"}),
        (times, seen, {"color": "black", "linewidth": 0.8, "label": "motion capture"}),
    ):
        keep = (stamps >= start) & (stamps <= start + _SHOWN_NS)
        holes = _after_holes(stamps[keep])
        axes.plot(np.insert(stamps[keep] * 1e-9, holes, np.nan), np.insert(rate[keep], holes, np.nan), **look)
    axes.set(title=name, ylabel="turning [rad/s]", xlabel="motion capture's clock [s]")
    axes.ticklabel_format(useOffset=False)
    axes.grid(alpha=0.3)
    axes.set_ylim(0, 1.35 * axes.get_ylim()[1])  # room for the legend
    axes.legend(loc="upper right", ncols=2, frameon=False)


def _rate(stamps: I64, turned: F64) -> tuple[I64, F64]:
    return stamps, np.linalg.norm(turned, axis=1) / (WINDOW_NS * 1e-9)


def _busiest(stamps: I64, rate: F64) -> int:
    """Where the stretch begins in which the rate varies most."""
    width = max(1, int(np.searchsorted(stamps, stamps[0] + _SHOWN_NS)))
    first, second = (np.cumsum(np.append(0.0, values)) for values in (rate, rate**2))
    n = max(1, len(rate) - width)
    mean = (first[width : width + n] - first[:n]) / width
    return int(stamps[int(((second[width : width + n] - second[:n]) / width - mean**2).argmax())])
