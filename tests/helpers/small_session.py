"""Sessions that take seconds: the plain room, a D435i with few and small pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.sensor.effects import parse_effects
from share.sensors.profile import shipped_profiles
from share.types import I64

RATE_HZ, SIZE = 10, (160, 120)
_MODE = """  modes:
    - width: 160
      height: 120
      rates_hz: [10]
      cam0: {intrinsics: [96.25, 96.25, 79.7, 59.5]}
      cam1: {intrinsics: [96.25, 96.25, 79.7, 59.5]}
"""


def small_profile(folder: Path) -> Path:
    """A D435i of 160x120 at 10 Hz."""
    text = shipped_profiles()["d435i"].read_text()
    text = text.replace("default_mode: 640x480@30", "default_mode: 160x120@10").replace("  modes:\n", _MODE)
    path = folder / "small.yaml"
    path.write_text(text)
    return path


def small_recipe(
    profile: Path, *motions: str, effects: tuple[str, ...] = (), **more: object
) -> SessionRecipe:
    settings: dict[str, object] = {"scene": "plain", "seconds": 3.0} | more
    return SessionRecipe(
        motions=motions, profiles={"": str(profile)}, effects=parse_effects(effects), **settings
    )  # type: ignore[arg-type]


def files(folder: Path) -> dict[str, bytes]:
    """All that is in a folder, by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def write_poses(path: Path, stamps_ns: I64, reach: float = 0.6) -> Path:
    """A TUM file of somebody who swings about, looking ahead."""
    t = (stamps_ns - stamps_ns[0]) / 1e9
    x, y, z = reach * np.sin(0.9 * t), 0.5 * reach * np.sin(1.3 * t), 1.65 + 0.02 * np.sin(5 * t)
    rows = zip(stamps_ns / 1e9, x, y, z, strict=True)
    lines = [f"{s:.6f} {a:.6f} {b:.6f} {c:.6f} -0.5 0.5 -0.5 0.5\n" for s, a, b, c in rows]
    path.write_text("".join(lines))
    return path
