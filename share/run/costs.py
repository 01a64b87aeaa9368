"""How long things took in a run in real time, for runs in virtual time that are to be like it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from share.core.world import Cost, Costs
from share.errors import DataError, UsageError
from share.io.json_file import as_we_write_it, read_json

_USUAL = Costs()


def costs_of(run: Path) -> Costs:
    """By the reports in `run`, a folder by `share evaluate run`: frames, queries, verifications, solutions.

    What is not measured, a keyframe at the agent and the edge's small steps, is as much slower or quicker
    than usual as frames and verifications are. Raises UsageError or DataError.
    """
    edge, agents = run / "edge" / "edge.json", sorted(run.glob("*/report.json"))
    if not edge.is_file() or not agents:
        raise UsageError(f"--costs {run}: is not a run by `share evaluate run`")
    with as_we_write_it(run):
        return _costs(edge, agents)


def _costs(edge: Path, agents: Sequence[Path]) -> Costs:
    told = read_json(edge)
    frame = _cost([read_json(path)["track_ms"] for path in agents], edge)
    query, verify, solve = (
        _cost([told.get(f"{kind}_ms", {})], edge) for kind in ("place", "verify", "solve")
    )
    here, there = frame.p50 / _USUAL.frame.p50, verify.p50 / _USUAL.accepted.p50
    return replace(
        Costs(**{name: _times(getattr(_USUAL, name), there) for name in ("front", "add", "judge", "apply")}),
        frame=frame,
        keyframe=_times(_USUAL.keyframe, here),
        settle=_times(_USUAL.settle, here),
        query=query,
        accepted=verify,
        refused=verify,
        solve=solve,
    )


def _cost(summaries: Sequence[Mapping[str, Any]], where: Path) -> Cost:
    """Of several, the mean of their percentiles."""
    known = [one for one in summaries if one.get("n")]
    if not known:
        raise DataError(f"{where}: nothing was measured that costs could be taken from; play a longer run")
    p50, p95 = (sum(float(one[name]) for one in known) / len(known) for name in ("p50", "p95"))
    return Cost(p50, p95)


def _times(cost: Cost, factor: float) -> Cost:
    return Cost(factor * cost.p50, factor * cost.p95)
