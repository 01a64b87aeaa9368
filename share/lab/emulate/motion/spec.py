"""Parse motion specs: `walk:`, `robot:speed=0.5`, `ann=euroc:V1_02,start=5`, `paper:3`.

[NAME=]KIND:[ARGUMENT][,key=value ...]
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass, fields
from typing import TypeAlias

from share.errors import UsageError
from share.plain_data import from_mapping
from share.types import AgentKind

BODY_KINDS = ("person", "robot", "drone")


@dataclass(frozen=True)
class RecordedSpec:
    """A recording's motion, from `start` (s after its beginning) for `seconds` (None: to its end, or the
    session's). kind: ar or robot. look: the body that others see, person, robot or drone."""

    path: str = ""
    start: float = 0.0
    seconds: float | None = None
    kind: str = "ar"
    look: str = "person"

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("names no folder or file")
        _check_one_of("kind", self.kind, tuple(AgentKind))
        _check_one_of("look", self.look, BODY_KINDS)
        _check_positive(self, "seconds")


@dataclass(frozen=True)
class EurocSpec(RecordedSpec):
    """`euroc:FOLDER`: ground truth and real IMU in EuRoC's files."""

    kind: str = "robot"
    look: str = "drone"


@dataclass(frozen=True)
class TumviSpec(RecordedSpec):
    """`tumvi:FOLDER`: the same for a hand-held device."""


@dataclass(frozen=True)
class TumSpec(RecordedSpec):
    """`tum:FILE`: poses alone; the IMU is simulated."""


@dataclass(frozen=True)
class WalkSpec:
    """`walk:` is a person with a headset. speed: m/s, cruising. pauses: a minute. height: m, of the eyes
    (None: 1.60 to 1.75 by the seed). turns: rad/s, of the head at most."""

    speed: float = 0.9
    seconds: float | None = None
    pauses: float = 3.0
    height: float | None = None
    turns: float = 2.6

    def __post_init__(self) -> None:
        _check_positive(self, "speed", "seconds", "height", "turns")
        _check_range("speed", self.speed, 0.2, 2.0, "m/s")
        _check_range("turns", self.turns, 0.5, 3.0, "rad/s")
        _check_range("pauses", self.pauses, 0.0, 12.0, "a minute")
        if self.height is not None:
            _check_range("height", self.height, 1.2, 2.0, "m")


@dataclass(frozen=True)
class RobotSpec:
    """`robot:` is a differential drive. speed: m/s, cruising. pauses: a minute. height: m, of the camera.
    vibration: m/s^2, rms of the vertical while driving at 0.3 m/s."""

    speed: float = 0.35
    seconds: float | None = None
    pauses: float = 3.0
    height: float = 0.35
    vibration: float = 0.4

    def __post_init__(self) -> None:
        _check_positive(self, "speed", "seconds", "height")
        _check_range("speed", self.speed, 0.05, 1.0, "m/s")
        _check_range("pauses", self.pauses, 0.0, 12.0, "a minute")
        _check_range("height", self.height, 0.1, 1.5, "m")
        _check_range("vibration", self.vibration, 0.0, 2.0, "m/s^2")


@dataclass(frozen=True)
class BoardSpec:
    """`board:` is a hand-held device before a calibration board. distance: m, on average; it varies from a
    little more than half to nearly twice that. vigour: 1 for camera and IMU together; below 0.5 it is slow
    and pauses, for a camera alone."""

    distance: float = 0.8
    vigour: float = 1.0
    seconds: float | None = None

    def __post_init__(self) -> None:
        _check_positive(self, "distance", "vigour", "seconds")
        _check_range("distance", self.distance, 0.3, 3.0, "m")
        _check_range("vigour", self.vigour, 0.1, 2.0, "times the usual speed")


@dataclass(frozen=True)
class VisitSpec:
    """`visit:X Y [UNTIL];X Y [UNTIL];…` is a person with a headset who walks to places, m, and stands at each
    until a time, s. Without any time it walks from place to place, round and round, and keeps off those who
    have times. speed, height, turns: as of a walk."""

    places: str = ""
    speed: float = 0.9
    height: float | None = None
    turns: float = 2.6

    def __post_init__(self) -> None:
        WalkSpec(self.speed, height=self.height, turns=self.turns)  # checks them
        times = [until_s for _, _, until_s in self.stops if until_s is not None]
        if times and (len(times) < len(self.stops) or times != sorted(times)):
            raise ValueError("give a time for each place, rising, or for none")

    @property
    def stops(self) -> list[tuple[float, float, float | None]]:
        """x, y, m, and until when it stands there, s after the session's begin. Raises ValueError."""
        found: list[tuple[float, float, float | None]] = []
        for text in self.places.split(";"):
            try:
                x, y, *until = map(float, text.split())
                [until_s] = until or [math.nan]
            except ValueError:
                raise ValueError(f"place '{text:.40}' is not X Y or X Y UNTIL, m and s") from None
            if not all(map(math.isfinite, (x, y, *until))):
                raise ValueError(f"place '{text:.40}' is not finite")
            found.append((x, y, until_s if until else None))
        if len(found) < 2:
            raise ValueError("names fewer than two places")
        return found


PAPER_S = 60.0  # of an experiment of the paper


@dataclass(frozen=True)
class PaperSpec:
    """`paper:1` .. `paper:5`: the three agents of one of the paper's experiments, its first 60 s at most."""

    number: int = 1


Spec: TypeAlias = EurocSpec | TumviSpec | TumSpec | WalkSpec | VisitSpec | RobotSpec | BoardSpec | PaperSpec

SPEC_KINDS: dict[str, type[Spec]] = {
    "euroc": EurocSpec,
    "tumvi": TumviSpec,
    "tum": TumSpec,
    "walk": WalkSpec,
    "visit": VisitSpec,
    "robot": RobotSpec,
    "board": BoardSpec,
    "paper": PaperSpec,
}
_NAME = re.compile(r"([^:=]*)=(.*)", re.DOTALL)
_VALID_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
_OPTION = re.compile(r"\s*([a-z_]+)=(.*)", re.DOTALL)


def parse_motion(text: str) -> tuple[str | None, Spec]:
    """Return (name or None, spec) of `NAME=SPEC` or `SPEC`. Raises UsageError."""
    named = _NAME.fullmatch(text)
    name, spec = (named[1], named[2]) if named else (None, text)
    if name is not None and not _VALID_NAME.fullmatch(name):
        raise UsageError(
            f"'{text}': '{name}' is not a valid name; use letters, digits, '-' and '_', at most 32"
        )
    kind, colon, rest = spec.partition(":")
    if kind not in SPEC_KINDS or not colon:
        near = difflib.get_close_matches(kind, SPEC_KINDS, n=1)
        hint = f"did you mean '{near[0]}:'?" if near else "known: " + ", ".join(f"{k}:" for k in SPEC_KINDS)
        raise UsageError(f"'{text}': '{kind}' is not a kind of motion; {hint}")
    argument, options = _split_options(rest)
    return name, _make_spec(kind, argument, options, text)


def _split_options(rest: str) -> tuple[str, dict[str, str]]:
    """Split `FOLDER,start=5,seconds=20` into the folder, which may hold commas, and the options."""
    parts, options = rest.split(","), {}
    while parts and (match := _OPTION.fullmatch(parts[-1])):
        options[match[1]] = match[2].strip()
        parts.pop()
    return ",".join(parts), options


def _make_spec(kind: str, argument: str, options: dict[str, str], text: str) -> Spec:
    cls = SPEC_KINDS[kind]
    if cls is PaperSpec:
        if argument not in ("1", "2", "3", "4", "5") or options:
            raise UsageError(
                f"'{text}': the paper has five experiments; say paper:1 to paper:5, nothing more"
            )
        return PaperSpec(int(argument))
    takes = "path" if issubclass(cls, RecordedSpec) else "places" if cls is VisitSpec else None
    if argument and takes is None:
        known = ", ".join(f.name for f in fields(cls))
        raise UsageError(f"'{text}': '{argument}' is not key=value; known keys: {known}")
    return from_mapping(cls, options | ({takes: argument} if takes else {}), f"'{text}'")


def _check_one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} '{value}' is not known; known: {', '.join(known)}")


def _check_positive(spec: object, *names: str) -> None:
    for name in names:
        value = getattr(spec, name)
        if value is not None and not value > 0:
            raise ValueError(f"{name}={value:g} must be positive")


def _check_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name}={value:g}: expected {low:g} to {high:g} {unit}")
