"""The error model and what else could be in its place, on rooms that none of them has learnt from."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from share.config import ControlConfig
from share.lab.train.rivals import RIVALS, Rows, Say, Tell
from share.lab.train.score import Score
from share.lab.train.table import Collection
from share.odometry.error_model.model import Network, estimate
from share.scheduling.qoe import DELAY_MS, Needs, qoe
from share.types import F32, F64, AgentKind

_TIMED = 200  # keyframes


def of_network(name: str, network: Network, rows: Rows) -> Score:
    """One by one, as on an agent."""
    table, told, began = rows.table, [], time.thread_time()
    for features in table.features():
        told.append(estimate(network, features))
    ms = 1e3 * (time.thread_time() - began) / max(len(told), 1)
    low, high = (np.array([getattr(one, side) for one in told]) for side in ("low_cm", "high_cm"))
    covered = float(((low <= table.error_cm) & (table.error_cm <= high)).mean())
    return scored(name, np.array([one.error_cm for one in told]), table.error_cm, covered, ms)


def of_rivals(collection: Collection, deep: F32, seed: int, say: Say) -> Iterator[Score]:
    """Each taught on the rooms that ours is taught on, and tried where it is tried; as they are done."""
    rows = Rows(collection.table, deep)
    parts = {part: rows.take(collection.of(part)) for part in collection.parts}
    learn, stop, test = parts["learn"], parts["stop"], parts["test"]
    yield _mean(learn, test)
    for name, rival in RIVALS.items():
        say(f"{name}: learns")
        tell = rival(learn, stop, seed, _of(name, say))
        yield scored(name, tell(test), test.table.error_cm, ms=_timed(tell, test))


def scored(
    name: str, told_cm: F64, error_cm: F32, covered: float = float("nan"), ms: float = float("nan")
) -> Score:
    from scipy.stats import spearmanr

    off = told_cm - error_cm
    rank = float(spearmanr(told_cm, error_cm).statistic) if np.ptp(told_cm) else 0.0
    rmse, mae = float(np.sqrt((off**2).mean())), float(np.abs(off).mean())
    return Score(name, rmse, mae, rank, float(np.abs(_qoe(told_cm) - _qoe(error_cm)).mean()), covered, ms)


def _of(name: str, say: Say) -> Say:
    return lambda how_far: say(f"{name}: {how_far}")


def _qoe(error_cm: F64 | F32) -> F64:
    """Of a headset that waits for nothing: a delay would only make differences smaller."""
    needs = Needs.of(ControlConfig(), AgentKind.AR)
    return np.array([qoe(DELAY_MS, cm, needs) for cm in error_cm.tolist()])


def _mean(learn: Rows, test: Rows) -> Score:
    """Of who knows nothing of a keyframe."""
    always = np.full(len(test.deep), float(learn.table.error_cm.mean()))
    return scored("always the mean", always, test.table.error_cm)


def _timed(tell: Tell, rows: Rows) -> float:
    """ms of CPU, one keyframe at a time."""
    some = [rows.take(np.array([k])) for k in range(min(_TIMED, len(rows.deep)))]
    began = time.process_time()
    for one in some:
        tell(one)
    return 1e3 * (time.process_time() - began) / max(len(some), 1)
