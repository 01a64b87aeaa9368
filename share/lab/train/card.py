"""The model card: what an error model was taught on, how well it does, and what it is not for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from share.lab.train.score import ErrorModelScore, score_table

_LIMITS = (
    "It estimates the error of SHARE's own trackers over that window, not how far odometry has drifted.",
    "It was taught on emulated rooms. `strange` says where a picture is unlike all of them.",
    "What leaves no trace in a keyframe, as a wrong extrinsic, it cannot see.",
)


def model_card(about: Mapping[str, Any], scores: Sequence[ErrorModelScore], size: int, origin: str) -> str:
    """Markdown. about: of the model; scores: on rooms that it has not learnt from; size: bytes;
    origin: where its backbone comes from, empty if nobody says."""
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
