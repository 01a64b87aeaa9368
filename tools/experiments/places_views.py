"""Place recognition by its limits: views with known poses, pairs tried, recall and precision."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from keyframe_set import KeyframeSet, Spacing, keyframe_set

from share.geometry import se3
from share.geometry.camera import Rig
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.world.scenes.hard_rooms import twin_corridors
from share.mapping.recognition import verification
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView, Verification, verify
from share.types import F64, Keyframe, View

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
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
    from helpers.place_real import load

    stereo, kitchen = load(folder / STEREO), load(folder / KITCHEN, step=5, upright=False)
    return [
        Views(name, seen.sights, seen.T_world_body, seen.T_world_cam0)
        for name, seen in (("stereo", stereo), ("kitchen", kitchen))
    ]


def emulated(recipe: SessionRecipe, every: Spacing, step: int) -> Views:
    """Return every `step`-th keyframe of all agents of an emulated room. Raises as `keyframe_set`."""
    made = keyframe_set(recipe, every)
    agents = [(a, slice(None, None, step)) for a in made.agents.values()]
    sights = [
        CameraView(_described(k, a.hello.rig), a.hello.rig.cam0.focal, a.hello.rig.T_body_cam0, k.up)
        for a, some in agents
        for k in a.keyframes[some]
    ]
    bodies = np.concatenate([a.T_world_body[some] for a, some in agents])
    cameras = bodies @ np.array([s.T_body_cam0 for s in sights])
    return Views(recipe.scene, sights, bodies, cameras, _twin(made))


def _described(keyframe: Keyframe, rig: Rig) -> View:
    """Return the ORB features that the edge finds in the keyframe's image."""
    return ImageView(keyframe.image, rig.cam0, rig.T_body_cam0).describe()


def _twin(made: KeyframeSet) -> F64 | None:
    return twin_corridors(made.size)[2] if made.recipe.scene == "corridor-twins" else None


FALSE_M, FALSE_DEG = 0.25, 5.0
LOOSE_LIMITS = {"MIN_INLIERS": 8, "MIN_DIRECTION_INLIERS": 4, "MAX_SIGMA_DEG": 3.0}  # of the verification


class Tried(NamedTuple):
    """Every pair, (M,): true match; accepted by loose limits; pose right, or right for the twin; inliers;
    sigma [deg]; number of pairs that it stands for."""

    true: F64
    right: F64
    twin: F64
    inliers: F64
    sigma: F64
    stands_for: F64


def tried(views: Views, far: int, seed: int = 0) -> Tried:
    """Verify all true pairs and twins, and `far` of the others, with loose limits."""
    n = len(views.sights)
    kinds = {(q, c): _kind(views, q)[c] for q in range(n) for c in range(q)}
    others = [pair for pair, near in kinds.items() if not near]
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(others))[:far]
    limits = {name: getattr(verification, name) for name in LOOSE_LIMITS}
    try:
        for name, value in LOOSE_LIMITS.items():
            setattr(verification, name, value)
        rows = [_try(views, *pair, 1.0) for pair, near in kinds.items() if near]
        rows += [_try(views, *others[i], len(others) / max(1, len(chosen))) for i in chosen]
    finally:
        for name, value in limits.items():
            setattr(verification, name, value)
    return Tried(*np.array(rows).T)


def _kind(views: Views, q: int) -> np.ndarray:
    near = views.true(q)
    if views.T_twin is None:
        return near
    metres, degrees = views.apart(q, views.T_twin)
    return np.asarray(near | ((metres < 1) & (degrees < 30)))


def _try(views: Views, q: int, c: int, stands_for: float) -> tuple[float, ...]:
    true = bool(views.true(q)[c])
    found = verify(views.sights[q], views.sights[c])
    if not isinstance(found, Verification):
        return true, False, False, 0, 0.0, stands_for
    right = _right(views.error(q, c, found.T_c_q))
    twin = not right and views.T_twin is not None and _right(views.error(q, c, found.T_c_q, twin=True))
    floor = np.radians(verification._FLOOR_DEG) ** 2 * 3
    sigma = float(np.degrees(np.sqrt(max(0.0, np.trace(found.cov[:3, :3]) - floor))))
    return true, right, twin, found.inliers, sigma, stands_for


def _right(error: tuple[float, float]) -> bool:
    return error[0] <= FALSE_M and error[1] <= FALSE_DEG


class Point(NamedTuple):
    """At limits `inliers` and `sigma`: recall of the true pairs, precision, and how many of the accepted are
    wrong, of these by a twin's transform."""

    inliers: float
    sigma: float
    recall: float
    precision: float
    accepted: int
    wrong: int
    twins: int


def point(pairs: Tried, inliers: float, sigma: float) -> Point:
    taken = (pairs.inliers >= max(1.0, inliers)) & (pairs.sigma <= sigma)
    right = taken & (pairs.right > 0)
    weight = pairs.stands_for
    all_taken = float(weight[taken].sum())
    recall = (right & (pairs.true > 0)).sum() / max(1, (pairs.true > 0).sum())
    precision = float(weight[right].sum()) / all_taken if all_taken else 1.0
    wrong = taken & ~right
    twins = int((wrong & (pairs.twin > 0)).sum())
    return Point(inliers, sigma, float(recall), precision, int(taken.sum()), int(wrong.sum()), twins)


def recall_at(views: Views, others: list[Views], most: int = 50) -> tuple[F64, float]:
    """Return the share of the true pairs among the first k = 1 … `most` results, with the other rooms' views
    in the index too; and the share of the views with a true match that have one among their first eight."""
    index = PlaceIndex()
    everything = [*views.sights, *(s for o in others for s in o.sights)]
    for number, sight in enumerate(everything):
        index.add(number, sight.view.descriptors)
    found, pairs, served = np.zeros(most), 0, []
    for q, sight in enumerate(views.sights):
        true = views.true(q)
        answers = [c.id for c in index.query(sight.view.descriptors, most, [q])]
        hits = np.array([a < len(true) and bool(true[a]) for a in answers] + [False] * (most - len(answers)))
        found, pairs = found + np.cumsum(hits), pairs + int(true.sum())
        served += [bool(hits[:8].any())] * bool(true.any())
    return found / max(1, pairs), float(np.mean(served))
