"""Charts of an evaluation as PNG files: bars, ratios with intervals, lines, paths from above, heat maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.colours import agent_colours, series_colours
from share.files.writing import atomic_write
from share.geometry.se3 import transform
from share.lab.evaluate.statistics import Interval
from share.recordings.trajectory import Trajectory
from share.types import F64


def save_png(figure: Any, path: Path, dpi: int) -> None:
    """Write a matplotlib figure, complete or not at all, and close it. Raises as `atomic_write`."""
    from matplotlib import pyplot

    try:
        data = BytesIO()
        figure.savefig(data, dpi=dpi, format="png")
    finally:
        pyplot.close(figure)
    atomic_write(path, data.getvalue())


_NO_INTERVAL = Interval(float("nan"), float("nan"), float("nan"))
_WIDTH_IN, _MAX_COLUMNS = 6.5, 2  # of a figure, which a phone shows too; of its panels


def draw_bars(
    path: Path,
    panels: Mapping[str, Mapping[str, Sequence[float]]],
    groups: Sequence[str],
    unit: str,
    line: float | None = None,
    names: Sequence[str] = (),
) -> None:
    """Write a PNG with a panel for each of `panels`: {series: a value for each of `groups`}; NaN is left out.

    `line`: a level to draw across. `names`: all series of several pictures, so that each keeps its colour.
    """
    pyplot = agg_pyplot()
    width = max(6.0, 0.16 * len(groups) * max(map(len, panels.values())) + 2)
    figure, axes = pyplot.subplots(
        len(panels), 1, figsize=(width, 2.6 * len(panels)), layout="constrained", sharex=True, squeeze=False
    )
    positions = np.arange(len(groups))
    colours = series_colours([*names, *(name for series in panels.values() for name in series)])
    for axis, (title, series) in zip(axes[:, 0], panels.items(), strict=True):
        bar_width = 0.8 / len(series)
        for k, (name, values) in enumerate(series.items()):
            offset = (k - (len(series) - 1) / 2) * bar_width
            axis.bar(positions + offset, values, bar_width, label=name, color=colours[name])
        if line is not None:
            axis.axhline(line, color="black", linewidth=1, linestyle="--")
        axis.set(title=title, ylabel=unit)
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
    axes[-1, 0].set_xticks(positions, groups, rotation=30, ha="right")
    _save_with_legend(figure, path, *axes[0, 0].get_legend_handles_labels())


def draw_ratios(path: Path, series: Mapping[str, Mapping[str, Interval]], base: str) -> None:
    """Write a PNG with a bar per measure for each of `series`, as ratios to `base`; whiskers are intervals,
    where they are known."""
    pyplot = agg_pyplot()
    known = {name for of in series.values() for name, one in of.items() if np.isfinite(one.value)}
    measures = [name for name in next(iter(series.values())) if name in known]
    figure, axis = pyplot.subplots(figsize=(_WIDTH_IN, 0.5 + 0.5 * len(measures)), layout="constrained")
    positions, bar_width = np.arange(len(measures)), 0.8 / len(series)
    colours = series_colours(series)
    for k, (name, values) in enumerate(series.items()):
        intervals = [values.get(measure, _NO_INTERVAL) for measure in measures]
        value, low, high = (
            np.array([getattr(one, of) for one in intervals]) for of in ("value", "low", "high")
        )
        has_whiskers = np.isfinite(high - low).any()
        whiskers = np.nan_to_num(np.stack([value - low, high - value])).clip(0) if has_whiskers else None
        y = positions + (k - (len(series) - 1) / 2) * bar_width
        axis.barh(y, value, bar_width, xerr=whiskers, label=name, color=colours[name], ecolor="#555")
    axis.axvline(1, color="black", linewidth=1, linestyle="--")
    axis.set_yticks(positions, measures)
    axis.invert_yaxis()
    axis.set(xlabel=f"ratio to {base}", xlim=(0, None))
    axis.grid(axis="x", alpha=0.3)
    axis.set_axisbelow(True)
    _save_with_legend(figure, path, *axis.get_legend_handles_labels())


def draw_lines(
    path: Path, panels: Mapping[str, Mapping[str, tuple[F64, F64]]], x_label: str, units: Sequence[str]
) -> None:
    """Write a PNG with a panel for each of `panels`, in one of `units` each: {series: (x (N,), y (N,))}."""
    pyplot = agg_pyplot()
    figure, axes = pyplot.subplots(
        len(panels),
        1,
        figsize=(_WIDTH_IN, 2.2 * len(panels)),
        layout="constrained",
        sharex=True,
        squeeze=False,
    )
    colours = series_colours(name for series in panels.values() for name in series)
    for axis, unit, (title, series) in zip(axes[:, 0], units, panels.items(), strict=True):
        for name, (x, y) in series.items():
            axis.step(x, y, where="post", label=name, color=colours[name])
        axis.set(title=title, ylabel=unit)
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel(x_label)
    handles = [pyplot.Line2D([], [], color=colour) for colour in colours.values()]
    _save_with_legend(figure, path, handles, list(colours))


def draw_paths(path: Path, panels: Mapping[str, Mapping[str, tuple[F64, F64]]]) -> None:
    """Write a PNG of paths from above, a panel for each of `panels`: {agent: (path (N, 2) m, dots (M, 2)
    m)}."""
    pyplot = agg_pyplot()
    columns = min(_MAX_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    width, height = np.ptp(
        [xy for series in panels.values() for path_xy, _ in series.values() for xy in path_xy], axis=0
    )
    size = 3.2 * columns, (3.0 * np.clip(height / max(width, 1e-9), 0.3, 2) + 0.5) * rows + 0.5
    figure, axes = pyplot.subplots(
        rows, columns, figsize=size, layout="constrained", sharex=True, sharey=True
    )
    flat = np.atleast_1d(axes).ravel()
    colours = agent_colours(dict.fromkeys(name for series in panels.values() for name in series))
    for axis, (title, series) in zip(flat, panels.items(), strict=False):
        for name, (path_xy, dots) in series.items():
            axis.plot(*path_xy.T, color=colours[name], linewidth=0.6, alpha=0.6)
            axis.scatter(*dots.T, color=colours[name], s=9, alpha=0.35, linewidths=0)
        axis.set(title=title, aspect="equal")
        axis.grid(alpha=0.3)
    for axis in flat[len(panels) :]:
        axis.set_visible(False)
    figure.supxlabel("m")
    figure.supylabel("m")
    handles = [pyplot.Line2D([], [], color=colour, marker="o") for colour in colours.values()]
    _save_with_legend(figure, path, handles, list(colours))


def draw_heat_maps(
    path: Path,
    maps: Mapping[str, NDArray[np.floating[Any]]],
    y_axis: tuple[str, Sequence[str]],
    x_axis: tuple[str, Sequence[str]],
) -> None:
    """Write a PNG with a heat map for each of `maps`: (V, W) over V values of y_axis and W of x_axis,
    (label, values) each."""
    pyplot = agg_pyplot()
    figure, axes = pyplot.subplots(
        1, len(maps), figsize=(1 + 3.2 * len(maps), 3.4), layout="constrained", squeeze=False
    )
    for axis, (title, cells) in zip(axes[0], maps.items(), strict=True):
        image = axis.imshow(cells, cmap="Blues", aspect="auto", origin="lower")
        axis.set_xticks(range(len(x_axis[1])), x_axis[1])
        axis.set_yticks(range(len(y_axis[1])), y_axis[1])
        axis.set(xlabel=x_axis[0], ylabel=y_axis[0], title=title)
        for (i, j), cell in np.ndenumerate(cells):
            dark = np.isfinite(cell) and image.norm(cell) > 0.5
            axis.text(j, i, f"{cell:.3g}", ha="center", va="center", color="white" if dark else "black")
    save_png(figure, path, 110)


def _save_with_legend(figure: Any, path: Path, handles: Sequence[Any], names: Sequence[str]) -> None:
    figure.legend(handles, names, loc="outside upper right", ncols=max(1, len(names)), fontsize=8)
    save_png(figure, path, 110)


def agg_pyplot() -> Any:
    """Return matplotlib's pyplot, which draws to files only."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def draw_trajectories(
    path: Path,
    agents: Mapping[str, tuple[Trajectory | None, Trajectory]],
    T_truth_map: F64,
    title: str,
) -> None:
    """Write a PNG of a run from above, and of the position errors over time.

    agents: {name: (poses in the shared map or None, truth)}. T_truth_map (4, 4) aligns the map with the
    truth.
    """
    pyplot = agg_pyplot()
    figure, (top_view, error) = pyplot.subplots(
        1, 2, figsize=(13, 6.2), width_ratios=(3, 2), layout="constrained"
    )
    start = min(truth.stamps_ns[0] for _, truth in agents.values())
    colours = agent_colours(agents)
    for name, (estimate, truth) in agents.items():
        colour = colours[name]
        p = truth.T[:, :3, 3]
        top_view.plot(p[:, 0], p[:, 1], color=colour, alpha=0.3, linewidth=5, solid_capstyle="round")
        if estimate is None:
            continue
        q = transform(T_truth_map, estimate.T[:, :3, 3])
        top_view.plot(q[:, 0], q[:, 1], color=colour, linewidth=1.2, label=name)
        top_view.plot(*q[0, :2], "o", color=colour, markersize=6)
        t = (estimate.stamps_ns - start) * 1e-9
        true_positions = np.array(
            [np.interp(estimate.stamps_ns, truth.stamps_ns, p[:, k]) for k in range(3)]
        ).T
        error.plot(
            t, 100 * np.linalg.norm(q - true_positions, axis=1), color=colour, linewidth=1.2, label=name
        )
    top_view.set(title="from above: truth (broad), shared map (thin)", xlabel="x [m]", ylabel="y [m]")
    top_view.set_aspect("equal")
    error.set(title="position error in the shared map", xlabel="time [s]", ylabel="cm")
    error.set_ylim(bottom=0)
    for axes in (top_view, error):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    figure.suptitle(title)
    save_png(figure, path, 110)
