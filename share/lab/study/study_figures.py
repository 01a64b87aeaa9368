"""Figures of a study: each measure by condition, and preferences."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.colours import series_colours
from share.lab.evaluate.charts import agg_pyplot, draw_bars, save_png
from share.lab.study.observations import Observations
from share.lab.study.study_analysis import StudyAnalysis

_COLUMNS = 2  # of panels: a phone shows two
_JITTER = 0.22  # of dots, of a bar's place


def _label(name: str) -> str:
    """Return a name that matplotlib does not take for a formula."""
    return name.replace("$", r"\$")


def draw_measures(path: Path, study: StudyAnalysis, table: Observations) -> None:
    """Write a PNG with a panel for each measure: bars of means, whiskers of 95 %, a dot for each
    participant."""
    pyplot = agg_pyplot()
    columns = min(_COLUMNS, len(study.measures))
    rows = -(-len(study.measures) // columns)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(3.4 * columns, 2.7 * rows), layout="constrained", squeeze=False
    )
    colours = series_colours(study.conditions)
    rng = np.random.default_rng(1)  # of the dots' places
    for axis, measure in zip(axes.ravel(), study.measures, strict=False):
        for k, one in enumerate(measure.conditions):
            if not one.count:
                continue
            axis.bar(k, one.mean.value, 0.7, color=colours[one.condition], alpha=0.75)
            values = table.measures[measure.name][:, k]
            known = values[np.isfinite(values)]
            axis.scatter(k + rng.uniform(-_JITTER, _JITTER, len(known)), known, s=7, color="#333", alpha=0.45)
            if np.isfinite(one.mean.low):
                whiskers = [[one.mean.value - one.mean.low], [one.mean.high - one.mean.value]]
                axis.errorbar(k, one.mean.value, whiskers, color="black", capsize=4)
        axis.set_xticks(range(len(study.conditions)), list(map(_label, study.conditions)))
        axis.set_title(_label(measure.name), fontsize=9)
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
        if all(one.least == one.greatest == 0 for one in measure.conditions if one.count):
            axis.set_ylim(0, 1)  # nothing to be seen, and not below zero
    for axis in axes.ravel()[len(study.measures) :]:
        axis.set_visible(False)
    save_png(figure, path, 110)


def draw_choices(path: Path, study: StudyAnalysis) -> None:
    """Write a PNG of how often each condition was preferred most and least."""
    series = {
        _label(condition): [float(one.counts[k]) for one in study.choices.values()]
        for k, condition in enumerate(study.conditions)
    }
    draw_bars(path, {"": series}, [f"{kind} preferred" for kind in study.choices], "participants")
