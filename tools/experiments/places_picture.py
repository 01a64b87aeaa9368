"""Curves of place recognition: recall of the query, precision against recall of verification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image  # comes with matplotlib
from places_curves import Point

from share.types import F64

_COLOURS = ("#00798c", "#d1495b", "#b8860b", "#5f4b8b", "#3b7a3b")
_PALETTE = 64


def draw(
    path: Path,
    recalls: dict[str, F64],
    curves: dict[str, tuple[list[Point], list[Point]]],
    here: dict[str, Point],
) -> None:
    """Write a PNG. recalls: by name, of the first k results. curves: over inliers and over sigma. here: at
    SHARE's limits."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    style = {"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}
    with pyplot.rc_context(style):
        figure, panels = pyplot.subplots(1, 3, figsize=(14, 4.6), layout="constrained")
        for (name, recall), colour in zip(recalls.items(), _COLOURS, strict=False):
            panels[0].plot(range(1, len(recall) + 1), 100 * recall, color=colour, label=name)
        for panel, over in ((panels[1], 0), (panels[2], 1)):
            for (name, both), colour in zip(curves.items(), _COLOURS, strict=False):
                _precision(panel, both[over], here[name], colour, name)
        _words(panels)
        figure.legend(
            handles=panels[0].lines[: len(recalls)],
            loc="outside lower center",
            ncols=len(recalls),
            frameon=False,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=90)
        pyplot.close(figure)
    Image.open(path).convert("RGB").quantize(_PALETTE).save(path, optimize=True)


def _precision(panel: Any, points: list[Point], here: Point, colour: str, name: str) -> None:
    panel.plot(
        [100 * p.recall for p in points], [100 * p.precision for p in points], color=colour, label=name
    )
    panel.plot(100 * here.recall, 100 * here.precision, "o", color=colour)


def _words(panels: Any) -> None:
    panels[0].set(title="query", xlabel="first k answers", ylabel="recall of true pairs [%]", xlim=(1, None))
    panels[0].axvline(8, color="black", linewidth=0.6, linestyle=":")
    for panel, over in ((panels[1], "least inliers"), (panels[2], "largest sigma")):
        panel.set(
            title=f"verification, over {over}", xlabel="recall of true pairs [%]", ylabel="precision [%]"
        )
        panel.set_ylim(0, 102)
    for panel in panels:
        panel.grid(alpha=0.3)
