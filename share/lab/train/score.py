"""Scores of error models on the same keyframes, as a table, as JSON and in the card of a model."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share.errors import DataError
from share.files.json_file import nan_to_none, none_to_nan, parse_json
from share.files.reading import MAX_SETTINGS_BYTES, read_text
from share.lab.tables import markdown_table


@dataclass(frozen=True)
class ErrorModelScore:
    """Score of one model on N keyframes. rmse_cm, mae_cm: of the estimate; rank: Spearman correlation with
    the true error; qoe_error: mean absolute error of a headset's QoE without delay; coverage: share of errors
    within their intervals, NaN without intervals; cpu_ms: CPU time a keyframe without the inputs, NaN if not
    measured."""

    name: str
    rmse_cm: float
    mae_cm: float
    rank: float
    qoe_error: float
    coverage: float = math.nan
    cpu_ms: float = math.nan


def score_table(scores: Sequence[ErrorModelScore]) -> str:
    """Return a Markdown table with the paper's columns: errors, and time a keyframe."""
    head = ["", "RMSE cm", "mean error cm", "rank correlation", "QoE error", "in the interval", "ms"]
    rows = [
        [
            *(s.name, f"{s.rmse_cm:.3f}", f"{s.mae_cm:.3f}", f"{s.rank:.2f}", f"{s.qoe_error:.3f}"),
            *(_cell(100 * s.coverage, 0, " %"), _cell(s.cpu_ms, 2)),
        ]
        for s in scores
    ]
    return markdown_table([head, *rows])


def scores_json(scores: Sequence[ErrorModelScore]) -> str:
    return json.dumps([nan_to_none(dataclasses.asdict(score)) for score in scores])


def read_scores(path: Path) -> list[ErrorModelScore]:
    """Read what `scores_json` wrote. Raises DataError."""
    try:
        rows = parse_json(read_text(path, MAX_SETTINGS_BYTES))
        if not isinstance(rows, list):
            raise ValueError("not a list")
        return [_score_from_row(none_to_nan(row)) for row in rows]
    except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
        raise DataError(f"{path}: not a file of `share train compare --json`, or damaged: {error}") from None


def _score_from_row(row: dict[str, Any]) -> ErrorModelScore:
    numbers = (value for name, value in row.items() if name != "name")
    if not isinstance(row["name"], str) or not all(isinstance(value, int | float) for value in numbers):
        raise ValueError("text in place of a number")
    return ErrorModelScore(**row)


def _cell(value: float, digits: int, unit: str = "") -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}{unit}"


_LIMITS = (
    "It estimates the error of SHARE's own trackers over that window, not how far odometry has drifted.",
    "It was trained on emulated rooms. Keyframes unlike all of them are marked out of distribution.",
    "It cannot detect errors that leave no trace in a keyframe, such as a wrong extrinsic.",
)


def model_card(about: Mapping[str, Any], scores: Sequence[ErrorModelScore], size: int, origin: str) -> str:
    """Return the card as Markdown. about: the model's metadata; scores: on the test rooms; size: bytes;
    origin: source and licence of the backbone, empty if unknown."""
    rooms, counts = about["rooms"], about["keyframes"]
    parts = [[part, str(len(rooms[part])), str(counts[part]), ", ".join(rooms[part])] for part in rooms]
    return "\n".join(
        [
            "# Error model",
            "",
            f"By SHARE {about['version']}; errors over {about['window_s']:g} s; {size / 1e6:.1f} MB.",
            "",
            markdown_table([["part", "sessions", "keyframes", ""], *parts]),
            "",
            "On the rooms of *test*:",
            "",
            score_table(scores),
            "",
            *([f"* Its backbone is {origin}."] if origin else []),
            *(f"* {limit}" for limit in _LIMITS),
            "",
        ]
    )
