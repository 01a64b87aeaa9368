"""How well models of the error do on the same keyframes, and the table of it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from share.errors import DataError
from share.io.json_file import known, with_nan


@dataclass(frozen=True)
class Score:
    """Of one model on N keyframes. rmse_cm, mae_cm; rank: correlation with the true error (Spearman);
    qoe_off: by how much a headset's QoE is off, on average, where nothing is late; covered: how many errors
    lie in their intervals, NaN without any; ms: of CPU a keyframe, the features not included, NaN where it
    was not measured."""

    name: str
    rmse_cm: float
    mae_cm: float
    rank: float
    qoe_off: float
    covered: float = math.nan
    ms: float = math.nan


def table(scores: Sequence[Score]) -> str:
    """Markdown, as the paper's: error, and time a keyframe."""
    head = (
        "| | RMSE cm | mean error cm | rank correlation | QoE off | in the interval | ms |",
        "|---|" + 6 * "---|",
    )
    rows = [
        f"| {s.name} | {s.rmse_cm:.3f} | {s.mae_cm:.3f} | {s.rank:.2f} | {s.qoe_off:.3f} "
        f"| {_percent(s.covered)} | {_told(s.ms)} |"
        for s in scores
    ]
    return "\n".join([*head, *rows])


def to_json(scores: Sequence[Score]) -> str:
    return json.dumps([known(dataclasses.asdict(score)) for score in scores])


def read_scores(path: Path) -> list[Score]:
    """What `to_json` wrote. Raises DataError."""
    try:
        rows = json.loads(path.read_text())
        if not isinstance(rows, list):
            raise ValueError("it is no list")
        return [Score(**with_nan(row)) for row in rows]
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: is not by `share train compare --json`, or damaged: {error}") from None


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def _told(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"
