"""What happens to a trial, and what it does: the events and effects of `TrialMachine`.

Places are in the floor's frame (`share.lab.study.floor`), m."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from share.lab.study.standstill import RobotSample

Place = tuple[float, float]


@dataclass(frozen=True)
class CalledSpot:
    """A goal of the trial. number: from 1. spot: its number in the plan; place: where that is."""

    number: int
    spot: int
    place: Place


# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class RobotPlaced:
    """Where the robot is; None: not known on the floor."""

    sample: RobotSample | None


@dataclass(frozen=True)
class CubeSeen:
    """A participant's cube came or moved. place: None: in a map that the floor is not in. number: its own."""

    place: Place | None
    number: int = 0


@dataclass(frozen=True)
class CubeTaken:
    """A participant's cube was removed."""

    number: int


@dataclass(frozen=True)
class RobotGone:
    """The robot's bridge says nothing any more; `RobotPlaced` says that it is back."""


@dataclass(frozen=True)
class FloorMoved:
    """The floor's marker lies elsewhere in its map. moved_m: by so much; None: it is gone."""

    moved_m: float | None


@dataclass(frozen=True)
class CallPressed:
    """The researcher calls for the participant, whose cube lies at the planned spot."""


@dataclass(frozen=True)
class GoalReported:
    """What becomes of the robot's goal, as its bridge says."""

    text: str
    is_final: bool
    is_reached: bool


@dataclass(frozen=True)
class TrialBroken:
    """The trial cannot go on now. reason: for a person."""

    reason: str


@dataclass(frozen=True)
class TimePassed:
    pass


TrialEvent = (
    RobotPlaced
    | RobotGone
    | CubeSeen
    | CubeTaken
    | FloorMoved
    | CallPressed
    | GoalReported
    | TrialBroken
    | TimePassed
)

# ---------------------------------------------------------------- effects


@dataclass(frozen=True)
class WriteLine:
    """Append a line to events.jsonl."""

    fields: Mapping[str, Any]


@dataclass(frozen=True)
class ShowSpot:
    """Show the spot that is next, in the room."""

    called: CalledSpot


@dataclass(frozen=True)
class SendRobot:
    place: Place


@dataclass(frozen=True)
class StopRobot:
    pass


@dataclass(frozen=True)
class SayLine:
    """A line for the researcher."""

    text: str


TrialEffect = WriteLine | ShowSpot | SendRobot | StopRobot | SayLine
