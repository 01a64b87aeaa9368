"""The model card: what an error model was trained on, its scores and its limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from share.lab.train.score import ErrorModelScore, score_table

_LIMITS = (
    "It estimates the error of SHARE's own trackers over that window, not how far odometry has drifted.",
    "It was trained on emulated rooms. `strange` marks keyframes unlike all of them.",
    "It cannot detect errors that leave no trace in a keyframe, such as a wrong extrinsic.",
)


def model_card(about: Mapping[str, Any], scores: Sequence[ErrorModelScore], size: int, origin: str) -> str:
    """Return the card as Markdown. about: the model's metadata; scores: on the test rooms; size: bytes;
    origin: source and licence of the backbone, empty if unknown."""
    rooms, counts = about["rooms"], about["keyframes"]
    parts = [f"| {part} | {len(rooms[part])} | {counts[part]} | {', '.join(rooms[part])} |" for part in rooms]
    return "\n".join(
        [
            "# Error model",
            "",
            f"By SHARE {about['version']}; errors over {about['window_s']:g} s; {size / 1e6:.1f} MB.",
            "",
            "| part | sessions | keyframes | |",
            "|---|---|---|---|",
            *parts,
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
