"""All inputs of a session: the same recipe gives the same bytes."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from share.errors import UsageError
from share.files.reading import MAX_TABLE_BYTES, read_bytes
from share.lab.emulate.motion.spec import PAPER_S, RecordedSpec, parse_motion
from share.lab.emulate.sensor.effects import Effects

# increase it when any picture, motion or file changes, so that cached sessions are made again
GENERATOR_VERSION = 2
SENSORS = ("stereo", "rgbd", "mono")
IMAGES = ("jpeg", "png")
MAX_DAY = 10**6
# depths at which a recording's folder has text files, as FOLDER/mav0/imu0/data.csv
_FOLDER_DEPTHS, _TEXT_SUFFIXES = ("*", "*/*", "*/*/*"), (".csv", ".txt", ".yaml")


Progress = Callable[[str, int, int], None]  # task, done, total


def no_progress(what: str, done: int, total: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class SessionRecipe:
    """scene: a name, or a glTF file. motions: `[NAME=]SPEC` each. size: of the room, m; None: the scene's
    default. day: 0 for the room as it is furnished, else the same room on another day, with other paths and
    noise (`share.lab.emulate.world.another_day`). sensors, profiles: one for all (key "") or by an agent's
    name; profiles may name a mode, as `d435i:848x480@30`. images: jpeg has quality 95; png is lossless.
    Raises UsageError for an invalid recipe.
    """

    scene: str
    motions: tuple[str, ...]
    seconds: float = 30.0
    seed: int = 0
    size: tuple[float, float, float] | None = None
    sensors: dict[str, str] = field(default_factory=dict)
    profiles: dict[str, str] = field(default_factory=dict)
    effects: Effects = field(default_factory=Effects)
    images: str = "jpeg"
    day: int = 0

    def __post_init__(self) -> None:
        if not 3 <= self.seconds <= 3600:
            raise UsageError(f"{self.seconds:g} seconds: a session lasts 3 to 3600 seconds")
        if not 0 <= self.seed < 2**63:
            raise UsageError(f"seed {self.seed}: must be 0 .. 2^63 - 1")
        for sensors in self.sensors.values():
            if sensors not in SENSORS:
                raise UsageError(f"sensors '{sensors}' are not known; known: {', '.join(SENSORS)}")
        if not 0 <= self.day <= MAX_DAY:
            raise UsageError(f"day {self.day}: must be 0 .. {MAX_DAY}")
        if self.images not in IMAGES:
            raise UsageError(f"images '{self.images}' are not known; known: {', '.join(IMAGES)}")

    def to_mapping(self) -> dict[str, Any]:
        """Return plain data for session.yaml."""
        out = asdict(self) | {"motions": list(self.motions), "generator_version": GENERATOR_VERSION}
        out["size"] = None if self.size is None else list(self.size)
        if not self.day:
            del out["day"]  # sessions that were made before there were days keep their digest
        if self.seconds < PAPER_S and any(text.startswith("paper:") for text in self.motions):
            out["is_cut"] = True  # before, such a session had all of an experiment of the paper
        return out

    @property
    def motion_seed(self) -> int:
        """Return the seed of what differs from day to day: paths and noise."""
        return self.seed if not self.day else zlib.crc32(f"{self.seed} day {self.day}".encode())

    @property
    def digest(self) -> str:
        """Return twelve characters that identify the recipe and the content of the user's files. Raises
        UsageError for an invalid motion."""
        digest = hashlib.sha256(json.dumps(self.to_mapping(), sort_keys=True).encode())
        for path in self._user_files():
            try:
                digest.update(read_bytes(path, MAX_TABLE_BYTES))
            except OSError as error:
                raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
        return digest.hexdigest()[:12]

    def _user_files(self) -> Iterator[Path]:
        """Yield the user's scene and profile files, and all files of recorded motions but images."""
        for name in (self.scene, *self.profiles.values()):
            path = Path(name.partition(":")[0])
            if path.suffix and path.is_file():
                yield path
        for text in self.motions:
            _, spec = parse_motion(text)
            if isinstance(spec, RecordedSpec):
                yield from _text_files(Path(spec.path))


def _text_files(path: Path) -> list[Path]:
    """Return the file, or the text files of a recording's folder."""
    candidates = [path] if path.is_file() else [p for depth in _FOLDER_DEPTHS for p in path.glob(depth)]
    return sorted(p for p in candidates if p.is_file() and (p == path or p.suffix in _TEXT_SUFFIXES))


# `share demo`: two headsets and a robot in one room.

_DEMO_MOTIONS = ("ar1=walk:speed=0.65", "ar2=walk:speed=0.55", "robot=robot:speed=0.3")
DEMO_AGENTS = tuple(motion.partition("=")[0] for motion in _DEMO_MOTIONS)
_DEMO_PROFILE = "d435i:640x480@15"  # half of the device's frame rate: four processes share two cores
DEFAULT_SCENE, FALLBACK_SCENE = "warehouse", "plain"


def meeting_seed(scene: str) -> int:
    """Return a seed of the scene with which all three soon see the same things; with others 20 s may be too
    short."""
    return 3 if scene == FALLBACK_SCENE else 31


def demo_recipe(scene: str, seconds: float, seed: int) -> SessionRecipe:
    """Return the recipe with the same three agents for any scene."""
    return SessionRecipe(scene, _DEMO_MOTIONS, seconds, seed, profiles={"": _DEMO_PROFILE})
