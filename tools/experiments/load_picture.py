"""Draw load.json, grow.json and hour.json of measure_load and measure_load_curve as one picture.

python tools/experiments/load_picture.py FOLDER PICTURE
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Draw three panels, left to right: many agents, a growing map, an hour in one room."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder, picture = Path(sys.argv[1]), Path(sys.argv[2])
    style = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    with pyplot.rc_context(style):
        figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
        _load(left, json.loads((folder / "load.json").read_text()))
        _grow(middle, json.loads((folder / "grow.json").read_text()))
        _hour(right, json.loads((folder / "hour.json").read_text()))
        figure.savefig(picture, dpi=80)


def _load(axes: Any, rows: list[dict[str, Any]]) -> None:
    agents = [row["agents"] for row in rows]
    for name in ("front", "mapper", "solver"):
        axes.plot(agents, [row["cpu"][name] for row in rows], "o-", label=f"CPU, {name} [s/s]")
    axes.plot(agents, [row["looked_up"] for row in rows], "s--", label="keyframes looked up")
    axes.plot(agents, [row["correction_ms"]["p95"] / 1e3 for row in rows], "d:", label="correction p95 [s]")
    axes.set(xlabel="agents", ylim=(0, None), title="many agents, one edge")
    axes.legend(frameon=False, fontsize=8)


def _grow(axes: Any, rows: list[dict[str, Any]]) -> None:
    for kind in ("add", "query", "verify", "judge", "solve", "apply"):
        has = [row for row in rows if kind in row]
        axes.loglog([row["keyframes"] for row in has], [row[kind] for row in has], "o-", label=kind)
    axes.set(xlabel="keyframes, none taken out", ylabel="CPU ms, median", title="what one costs")
    axes.legend(frameon=False, fontsize=8)


def _hour(axes: Any, rows: list[dict[str, Any]]) -> None:
    minutes = [row["minutes"] for row in rows]
    axes.plot(minutes, [row["rss_mb"] for row in rows], label="memory [MB]")
    axes.plot(minutes, [row["file_mb"] for row in rows], label="file [MB]")
    axes.plot(minutes, [row["kept"] / 10 for row in rows], label="keyframes / 10")
    axes.plot(minutes, [row["loops"] / 10 for row in rows], label="loops / 10")
    axes.set(xlabel="minutes of three agents", ylim=(0, None), title="the same room, on and on")
    axes.legend(frameon=False, fontsize=8)


if __name__ == "__main__":
    main()
