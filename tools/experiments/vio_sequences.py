"""The sequences for measuring the inertial tracker: one agent, 60 s, all sensor effects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from share.lab.emulate.recipe import SessionRecipe

SECONDS = 60.0
_D435I = "d435i:640x480@30"


@dataclass(frozen=True)
class Sequence:
    """motion: `walk:`, `robot:`, or `euroc:NAME`, `tumvi:NAME` of a recording in the folder of recordings.
    size: of the room, m; None: the scene's default. sensors: "" for the motion's usual ones."""

    name: str
    motion: str
    scene: str
    profile: str
    sensors: str = ""
    size: tuple[float, float, float] | None = None

    def recording(self, data: Path) -> Path | None:
        """Return its recording's folder in `data`, None for a simulated motion."""
        kind, _, name = self.motion.partition(":")
        return data / kind / name if name else None

    def recipe(self, seed: int, data: Path) -> SessionRecipe:
        folder = self.recording(data)
        motion = self.motion if folder is None else f"{self.motion.partition(':')[0]}:{folder}"
        sensors = {"": self.sensors} if self.sensors else {}
        return SessionRecipe(
            self.scene, (f"agent={motion}",), SECONDS, seed, self.size, sensors, {"": self.profile}
        )


SEQUENCES = (
    Sequence("walk-warehouse", "walk:", "warehouse", _D435I),
    Sequence("walk-firestation", "walk:", "firestation", "d435i:848x480@30"),
    Sequence("robot-warehouse", "robot:", "warehouse", _D435I, sensors="stereo"),
    Sequence("euroc-V1_01", "euroc:V1_01_easy", "warehouse", "euroc"),
    Sequence("euroc-V1_02", "euroc:V1_02_medium", "firestation", "euroc"),
    Sequence("euroc-MH_03", "euroc:MH_03_medium", "warehouse", "euroc", size=(10.0, 9.5, 4.5)),
    Sequence("tumvi-room1", "tumvi:room1", "warehouse", _D435I),
    Sequence("tumvi-room2", "tumvi:room2", "firestation", _D435I),
    Sequence("tumvi-room3", "tumvi:room3", "warehouse", _D435I),
)
