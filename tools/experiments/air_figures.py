"""Figures of runs by `simulate_air`: a row of each policy on each air, and paired comparisons over seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from tool_main import line

from share.lab.evaluate.statistics import bootstrap_mean

HEAD = ("air", "policy", "AR QoE: mean, p5", "by round trip", "robot QoE", "factors", "delay")
HEAD += ("AR corrections p95, ms",)
HEAD += ("Jain", "a 100 frames", "AR ages: correction p95, pose p99, s", "AR in a shared map, s")
HEAD += ("cm: AR, robots", "sent Hz: AR, robots", "kB/s", "air", "maps", "took s")
PAIRED_HEAD = ("air", "against", "seeds", "AR QoE: better in", "difference", "p5: better in", "difference")
PAIRED_HEAD += ("AR error no larger in", "ratio")

Row = dict[str, Any]
Values = np.ndarray[Any, Any]


def print_tables(rows: Sequence[Row]) -> None:
    """Print the figures of each policy on each air, and how the first policy compares with each other."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["air"], row["policy"]), []).append(row)
    ordered = sorted(groups, key=lambda key: list(dict.fromkeys(air for air, _ in groups)).index(key[0]))
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))))
    for key in ordered:
        print(line(cells_of(groups[key])))
    first = rows[0]["policy"]
    if len({policy for _, policy in ordered}) > 1:
        print("\n".join(["", *(line(cells) for cells in (PAIRED_HEAD, ["---"] * len(PAIRED_HEAD)))]))
    for air, policy in ordered:
        if policy != first and (air, first) in groups:
            print(line(paired_cells(groups[air, first], groups[air, policy])))


def pooled(row: Row, kind: str, figure: str) -> Values:
    """Return a figure of all agents of a kind in one run, joined."""
    found = [np.atleast_1d(a[figure]) for name, a in row["agents"].items() if name.startswith(kind)]
    return np.concatenate(found) if found else np.array([math.nan])


def mean_qoe(row: Row, kind: str) -> Values:
    """Return the mean QoE of each agent of a kind that was there."""
    found = [agent["qoe"] for name, agent in row["agents"].items() if name.startswith(kind) and agent["qoe"]]
    return np.array([np.mean(qoe) for qoe in found])


def jain(values: Values) -> float:
    """Return Jain's fairness index (R. Jain, D. Chiu, W. Hawe, DEC-TR-301, 1984): 1 where all are equal, 1/n
    where one has everything; NaN of none."""
    square = len(values) * float((values**2).sum())
    return float(values.sum()) ** 2 / square if square else math.nan


def corrections_a_100_frames(row: Row) -> float:
    """Return how many of a hundred frames of headsets led to a correction."""
    return float(100 * len(pooled(row, "ar", "corrected_ms")) / max(1, pooled(row, "ar", "frames").sum()))


def ar_qoe(row: Row) -> float:
    """Return the mean QoE of all samples of headsets."""
    return float(pooled(row, "ar", "qoe").mean())


def ar_qoe_p5(row: Row) -> float:
    """Return the 5th percentile of all samples of headsets."""
    return float(np.percentile(pooled(row, "ar", "qoe"), 5))


def until_acknowledged_ms(row: Row) -> float:
    """Return the mean delay of headsets until a keyframe is acknowledged, ms."""
    return float((pooled(row, "ar", "delay_ms") - pooled(row, "ar", "answer_ms")).mean())


def error_cm(row: Row, kind: str) -> float:
    """Return the mean over agents of a kind of their error in a shared map, cm; NaN where none was in one."""
    found = [cm for name, cm in row["error_cm"].items() if name.startswith(kind)]
    return float(np.mean(found)) if found else math.nan


def percentile(values: Values, q: float) -> float:
    """Return a percentile; NaN of none."""
    return float(np.percentile(values, q)) if len(values) else math.nan


def cells_of(rows: Sequence[Row]) -> list[str]:
    """Return the cells of the runs of one policy on one air."""

    def over_runs(of_run: Callable[[Row], float]) -> float:
        return float(np.nanmean([of_run(row) for row in rows]))

    def sent_hz(row: Row, kind: str) -> float:
        return float(pooled(row, kind, "sent").mean()) / row["seconds"]

    def trip(row: Row) -> Values:
        return pooled(row, "ar", "qoe_by_round_trip")

    shared_s = np.concatenate([pooled(row, "ar", "shared_s") for row in rows])
    return [
        rows[0]["air"],
        rows[0]["policy"],
        f"{over_runs(ar_qoe):.3f}, {over_runs(ar_qoe_p5):.3f}",
        f"{over_runs(lambda r: trip(r).mean()):.3f}, {over_runs(lambda r: percentile(trip(r), 5)):.3f}",
        f"{over_runs(lambda r: pooled(r, 'robot', 'qoe').mean()):.3f}",
        f"{over_runs(lambda r: pooled(r, 'ar', 'qoe_of_delay').mean()):.3f}, "
        f"{over_runs(lambda r: pooled(r, 'ar', 'qoe_of_error').mean()):.3f}",
        f"{over_runs(until_acknowledged_ms):.0f}, "
        f"{over_runs(lambda r: pooled(r, 'ar', 'answer_ms').mean()):.0f}",
        f"{over_runs(lambda r: percentile(pooled(r, 'ar', 'corrected_ms'), 95)):.0f}",
        f"{over_runs(lambda r: jain(mean_qoe(r, 'ar'))):.3f}",
        f"{over_runs(corrections_a_100_frames):.2f}",
        f"{over_runs(lambda r: percentile(pooled(r, 'ar', 'age_s'), 95)):.1f}, "
        f"{over_runs(lambda r: percentile(pooled(r, 'ar', 'pose_s'), 99)):.2f}",
        f"{np.median(shared_s):.1f}, {100 * np.isfinite(shared_s).mean():.0f} %",
        f"{over_runs(lambda r: error_cm(r, 'ar')):.2f}, {over_runs(lambda r: error_cm(r, 'robot')):.2f}",
        f"{over_runs(lambda r: sent_hz(r, 'ar')):.2f}, {over_runs(lambda r: sent_hz(r, 'robot')):.2f}",
        f"{over_runs(lambda r: r['bytes'] / r['seconds'] / 1e3):.0f}",
        f"{over_runs(lambda r: r['busy']):.2f}",
        f"{over_runs(lambda r: r['maps']):.1f}",
        f"{over_runs(lambda r: r['took_s']):.0f}",
    ]


def paired_cells(mine: Sequence[Row], theirs: Sequence[Row]) -> list[str]:
    """Return the cells that compare two policies on the seeds of both: wins, and the mean difference with
    its 95 % interval (bootstrap over seeds)."""
    others = {row["seed"]: row for row in theirs}
    pairs = [(row, others[row["seed"]]) for row in mine if row["seed"] in others]
    seeds = [str(row["seed"]) for row, _ in pairs]

    def difference(of_run: Callable[[Row], float]) -> tuple[str, str]:
        off = np.array([of_run(a) - of_run(b) for a, b in pairs])
        found = bootstrap_mean(off, seeds, np.random.default_rng(1))
        return f"{(off > 0).sum()} of {len(off)}", f"{found.value:+.3f} [{found.low:+.3f}, {found.high:+.3f}]"

    cm = np.array([[error_cm(row, "ar") for row in pair] for pair in pairs])
    ratio = float(np.nanmean(cm[:, 0]) / np.nanmean(cm[:, 1]))
    no_larger = f"{(cm[:, 0] <= cm[:, 1]).sum()} of {len(cm)}"
    head = [mine[0]["air"], theirs[0]["policy"], str(len(pairs))]
    return [*head, *difference(ar_qoe), *difference(ar_qoe_p5), no_larger, f"{ratio:.2f}"]
