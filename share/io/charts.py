"""Figures of an evaluation: bars side by side, one group a trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_COLOURS = ("#00798c", "#d1495b", "#edae49", "#66508c", "#3a7d44", "#8d5b4c")


def draw_bars(
    path: Path,
    panels: Mapping[str, Mapping[str, Sequence[float]]],
    groups: Sequence[str],
    unit: str,
    line: float | None = None,
) -> None:
    """PNG, a panel for each of `panels`: {series: a value for each of `groups`}; NaN is left out.

    line: a level to be told from, drawn across.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    width = max(6.0, 0.16 * len(groups) * max(map(len, panels.values())) + 2)
    figure, axes = pyplot.subplots(
        len(panels), 1, figsize=(width, 2.6 * len(panels)), layout="constrained", sharex=True, squeeze=False
    )
    at = np.arange(len(groups))
    for axis, (title, series) in zip(axes[:, 0], panels.items(), strict=True):
        wide = 0.8 / len(series)
        for k, (name, values) in enumerate(series.items()):
            offset = (k - (len(series) - 1) / 2) * wide
            axis.bar(at + offset, values, wide, label=name, color=_COLOURS[k % len(_COLOURS)])
        if line is not None:
            axis.axhline(line, color="black", linewidth=1, linestyle="--")
        axis.set(title=title, ylabel=unit)
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
    axes[-1, 0].set_xticks(at, groups, rotation=30, ha="right")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper right", ncols=len(names), fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
