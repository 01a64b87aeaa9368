"""Recall and precision of place recognition over its limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from places_data import Views

from share.config import PlaceConfig
from share.mapping.recognition import verification
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.verification import Verification, verify
from share.types import F64

FALSE_M, FALSE_DEG = 0.25, 5.0
LOOSE = PlaceConfig(min_inliers=8)
LOOSE_LIMITS = {"MIN_DIRECTION_INLIERS": 4, "MAX_SIGMA_DEG": 3.0}  # of the verification


class Tried(NamedTuple):
    """Of every pair, (M,): true match; accepted by loose limits; pose right, or right for the twin; inliers;
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
    found = verify(views.sights[q], views.sights[c], LOOSE)
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
