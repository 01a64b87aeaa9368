"""How well models of the error do on the same keyframes, and the table of it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import DataError
from share.files.json_file import nan_to_none, none_to_nan, parse_json
from share.files.reading import MAX_SETTINGS_BYTES, read_text


@dataclass(frozen=True)
class ErrorModelScore:
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


def score_table(scores: Sequence[ErrorModelScore]) -> str:
    """Markdown, as the paper's: error, and time a keyframe."""
    head = (
        "| | RMSE cm | mean error cm | rank correlation | QoE off | in the interval | ms |",
        "|---|" + 6 * "---|",
    )
    rows = [
        f"| {s.name} | {s.rmse_cm:.3f} | {s.mae_cm:.3f} | {s.rank:.2f} | {s.qoe_off:.3f} "
        f"| {_percent(s.covered)} | {_ms_text(s.ms)} |"
        for s in scores
    ]
    return "\n".join([*head, *rows])


def scores_json(scores: Sequence[ErrorModelScore]) -> str:
    return json.dumps([nan_to_none(dataclasses.asdict(score)) for score in scores])


def read_scores(path: Path) -> list[ErrorModelScore]:
    """What `scores_json` wrote. Raises DataError."""
    try:
        rows = parse_json(read_text(path, MAX_SETTINGS_BYTES))
        if not isinstance(rows, list):
            raise ValueError("it is no list")
        return [_score_from_row(none_to_nan(row)) for row in rows]
    except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
        raise DataError(f"{path}: is not by `share train compare --json`, or damaged: {error}") from None


def _score_from_row(row: dict[str, Any]) -> ErrorModelScore:
    numbers = (value for name, value in row.items() if name != "name")
    if not isinstance(row["name"], str) or not all(isinstance(value, int | float) for value in numbers):
        raise ValueError("it has text where numbers should be")
    return ErrorModelScore(**row)


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def _ms_text(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"
