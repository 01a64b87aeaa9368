"""Views with known poses for measuring place recognition: real recordings and emulated rooms."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from keyframe_set import KeyframeSet, Spacing, keyframe_set

from share.geometry import se3
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.world.scenes.corridor import twin_corridors
from share.mapping.recognition.verification import CameraView
from share.types import F64

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from helpers.place_real import load

STEREO, KITCHEN = "euroc_v1_01_keyframes", "redkitchen_0000_0499"
_THREE = ("ar1=walk:", "ar2=walk:", "robot=robot:")
WAREHOUSE = SessionRecipe("warehouse", _THREE, 60.0, seed=301)
FIRESTATION = SessionRecipe("firestation", _THREE, 60.0, seed=301)
TWINS = SessionRecipe("corridor-twins", ("walk:", "walk:"), 40.0, seed=6)


@dataclass(frozen=True, eq=False)
class Views:
    """sights: N views. T_world_body, T_world_cam0 (N, 4, 4): true poses. T_twin (4, 4), if any: takes the
    room's places to those that look alike, and back."""

    name: str
    sights: list[CameraView]
    T_world_body: F64
    T_world_cam0: F64
    T_twin: F64 | None = None

    def apart(self, q: int, T: F64 | None = None) -> tuple[F64, F64]:
        """Return distance [m] and angle [deg] (N,) of camera q, moved by T in the world, from every other."""
        own = self.T_world_cam0[q] if T is None else T @ self.T_world_cam0[q]
        rel = se3.inverse(own) @ self.T_world_cam0
        return np.linalg.norm(rel[:, :3, 3], axis=1), np.degrees(se3.rotation_angle(rel))

    def true(self, q: int) -> np.ndarray:
        """Return which views (N,) are true matches of view q: nearer than 1 m and 30 degrees."""
        metres, degrees = self.apart(q)
        near = (metres < 1) & (degrees < 30)
        near[q] = False
        return near

    def error(self, q: int, c: int, T_c_q: F64, twin: bool = False) -> tuple[float, float]:
        """Return the error of T_c_q (4, 4) between the bodies, m and degrees; twin: relative to the wrong
        twin."""
        own = self.T_world_body[q]
        if twin and self.T_twin is not None:
            own = self.T_twin @ own
        wrong = se3.inverse(se3.inverse(self.T_world_body[c]) @ own) @ T_c_q
        return float(np.linalg.norm(wrong[:3, 3])), float(np.degrees(se3.rotation_angle(wrong)))


def real(folder: Path) -> list[Views]:
    """Return stereo keyframes of a room, and every fifth frame of an RGB-D camera in a kitchen."""
    stereo, kitchen = load(folder / STEREO), load(folder / KITCHEN, step=5, upright=False)
    return [Views("stereo", *stereo), Views("kitchen", *kitchen)]


def emulated(recipe: SessionRecipe, every: Spacing, step: int) -> Views:
    """Return every `step`-th keyframe of all agents of an emulated room. Raises as `keyframe_set`."""
    made = keyframe_set(recipe, every)
    agents = [(a, slice(None, None, step)) for a in made.agents.values()]
    sights = [
        CameraView(k.view, a.hello.rig.cam0.focal, a.hello.rig.T_body_cam0, k.up)
        for a, some in agents
        for k in a.keyframes[some]
    ]
    bodies = np.concatenate([a.T_world_body[some] for a, some in agents])
    cameras = bodies @ np.array([s.T_body_cam0 for s in sights])
    return Views(recipe.scene, sights, bodies, cameras, _twin(made))


def _twin(made: KeyframeSet) -> F64 | None:
    return twin_corridors(made.size)[2] if made.recipe.scene == "corridor-twins" else None
