"""Regression gate: a small fixed set in virtual time, compared with earlier runs.

    python tools/regression.py                 compare with the history; code 1 if worse
    python tools/regression.py --keep WHY      compare, and add this run to the history, unless it is worse
    ... --keep WHY --accept FIGURE             add it although FIGURE is worse; the new reference from now on
    python tools/regression.py --chance 6      variation of the figures by chance alone: source of NOISE
    python tools/regression.py --picture FILE  draw the history, run nothing

The set: two rooms, in each two headsets and a robot for 30 s, over wifi5 by `share` and by `covins-g`, two
seeds, default settings. Sessions are made once and kept (--cache). In virtual time nothing depends on the
load of this machine; `make bench` measures its speed. The history: docs/lab/results/regression.jsonl. A
figure is
compared with its median over all lines since it was accepted (by name, or `all`), so that many small losses
count as one large one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from share import startup

startup.prepare_process()

sys.path.insert(0, str(Path(__file__).resolve().parent / "experiments"))

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share import __version__  # noqa: E402
from share.config import Config  # noqa: E402
from share.errors import DataError, ShareError, UsageError  # noqa: E402
from share.files.writing import atomic_write  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.lab.evaluate.campaign import (  # noqa: E402
    plan_policies,
    run_all,
    worker_pool,
)
from share.lab.evaluate.provenance import describe_machine  # noqa: E402
from share.lab.evaluate.real_time import RunOptions  # noqa: E402
from share.lab.evaluate.run_metrics import RunMetrics  # noqa: E402
from share.lab.evaluate.scoring import run_metrics  # noqa: E402
from share.lab.evaluate.statistics import MEASURES, policy_names  # noqa: E402
from share.lab.tables import format_number  # noqa: E402
from share.recordings.session import read_session  # noqa: E402

HISTORY = Path(__file__).resolve().parents[1] / "docs" / "lab" / "results" / "regression.jsonl"
_WHO = ("ar1=walk:", "ar2=walk:speed=1.2", "robot=robot:")
_PROFILES = {"": "d435i:640x480@15"}
SET = tuple(
    SessionRecipe(scene, _WHO, seconds=30.0, seed=seed, profiles=_PROFILES)
    for scene, seed in (("warehouse", 901), ("firestation", 902))
)
POLICIES, SEEDS = ("share", "covins-g"), (0, 1)
_ODOMETRY = "odometry ATE"
# Relative change that counts as worse or better: three standard deviations of chance alone (--chance 6;
# rounded up, and for means, which vary more).
NOISE = {
    _ODOMETRY: 0.3,
    "AR latency": 0.05,
    "AR corrections": 0.1,
    "merges per metre": 0.1,
    "joint ATE": 0.3,
    "AR RPE over 1 s": 0.25,
    "AR time to shared map": 0.3,
    "agents in one map": 0.2,
    "AR estimated error": 0.1,
    "robot estimated error": 0.12,
}
_ALL = "all"
MORE_IS_BETTER = ("agents in one map",)

Figures = dict[str, float]


class Verdict(NamedTuple):
    """One figure relative to its reference; NaN where it is missing now or before."""

    name: str
    before: float
    now: float
    noise: float

    @property
    def part(self) -> float:
        return self.now / self.before if self.before else math.nan

    @property
    def says(self) -> str:
        """Return `worse`, `better`, or "" within the noise."""
        if math.isnan(self.now) and not math.isnan(self.before):
            return "worse"
        if math.isnan(self.part) or abs(self.part - 1) <= self.noise:
            return ""
        more = self.part > 1
        return "better" if more == (self.name.partition(": ")[2] in MORE_IS_BETTER) else "worse"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--keep", metavar="WHY", help="add this run to the history")
    parser.add_argument(
        "--accept",
        metavar="FIGURE",
        action="append",
        default=[],
        help=f"may be worse (or `{_ALL}`); repeated",
    )
    parser.add_argument(
        "--chance", type=int, metavar="N", help="run the set N times, to measure variation by chance"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the history")
    parser.add_argument("--history", type=Path, default=HISTORY)
    parser.add_argument("--cache", type=Path, help="cache of sessions (default: the user's)")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    return exit_code("regression", lambda: run(options))


def run(options: argparse.Namespace) -> None:
    if options.picture:
        draw(options.picture, history(options.history))
    elif options.chance:
        by_chance(options)
    else:
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Compare with the history. Raises ShareError where something is worse that is not accepted, and then
    keeps nothing."""
    before = history(options.history)
    now = played(Config(), options)
    known = [*now, _ALL]
    if strange := [name for name in options.accept if name not in known]:
        raise UsageError(f"--accept {strange[0]}: not known; known: {', '.join(known)}")
    accepted = list(now) if _ALL in options.accept else options.accept
    verdicts = judged(now, wanted(before))
    print(table(verdicts))
    if worse := [one.name for one in verdicts if one.says == "worse" and one.name not in accepted]:
        raise ShareError(f"worse than before: {', '.join(worse)}")
    if options.keep is not None:
        kept = {
            "date": datetime.now(UTC).date().isoformat(),
            "why": options.keep,
            "version": __version__,
            "commit": commit(),
            "machine": describe_machine()["cpu"],
            "accepted": accepted,
            "figures": now,
        }
        lines = [json.dumps(one) for one in (*before, kept)]
        atomic_write(options.history, "\n".join(lines) + "\n")


def wanted(lines: Sequence[Mapping[str, Any]]) -> Figures:
    """Return the median of each figure over `lines`, since it was last accepted."""
    since: dict[str, list[float]] = {}
    for one in lines:
        for name, value in one["figures"].items():
            known = [] if name in one.get("accepted", ()) else since.get(name, [])
            since[name] = [*known, value]
    return {name: _median(values) for name, values in since.items()}


def played(config: Config, options: argparse.Namespace) -> Figures:
    """Run the set. Raises ShareError where a run fails."""
    sessions = [read_session(make_cached_session(recipe, options.cache, options.workers)) for recipe in SET]
    with tempfile.TemporaryDirectory() as folder:
        terms = RunOptions("", link="wifi5", virtual=True)
        runs = plan_policies(sessions, POLICIES, SEEDS, terms, Path(folder), config)
        found = []
        for _, came in run_all(runs, lambda n, now: None, worker_pool(options.workers)):
            if isinstance(came, ShareError):
                raise came
            found.append(run_metrics(came))
    return figures_of(found)


def figures_of(runs: Sequence[RunMetrics]) -> Figures:
    """Return medians by name, `POLICY: MEASURE`, so that one run that ends amid a merge does not decide; for
    agents in one map the mean, which shows a single agent that is missing."""
    out = {f"{POLICIES[0]}: {_ODOMETRY}": _median(a.odom_ate_cm for run in runs for a in run.agents)}
    for policy in policy_names(runs):
        mine = [run for run in runs if run.conditions.policy == policy]
        for measure in (m for m in MEASURES if m.name in NOISE):
            summed = _mean if measure.name in MORE_IS_BETTER else _median
            out[f"{policy}: {measure.name}"] = summed(measure.value_of(run) for run in mine)
    return out


def _median(values: Iterable[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return round(float(np.median(known)), 6) if known else math.nan


def _mean(values: Iterable[float]) -> float:
    return round(float(np.mean(list(values))), 6)


def judged(now: Mapping[str, float], before: Mapping[str, float]) -> list[Verdict]:
    return [
        Verdict(name, before.get(name, math.nan), value, NOISE[name.partition(": ")[2]])
        for name, value in now.items()
    ]


def history(path: Path) -> list[dict[str, Any]]:
    """Return all kept runs, the oldest first. Raises DataError."""
    try:
        return [json.loads(text) for text in path.read_text().splitlines()] if path.exists() else []
    except ValueError as error:
        raise DataError(f"{path}: is damaged: {error}") from None


def by_chance(options: argparse.Namespace) -> None:
    """Print the relative standard deviation of each figure, and three of them."""
    base = Config()
    found = []
    for k in range(options.chance):
        inertial = dataclasses.replace(base.inertial, sigma_px=base.inertial.sigma_px * (1 + 1e-3 * k))
        found.append(played(dataclasses.replace(base, inertial=inertial), options))
        print(f"{k + 1} of {options.chance}", file=sys.stderr, flush=True)
    print(line(["figure", "mean", "one sigma", "three"]))
    print(line(["---"] * 4))
    for name in found[0]:
        values = np.array([one[name] for one in found])
        part = values.std(ddof=1) / values.mean()
        print(line([name, f"{values.mean():.3g}", f"{part:.3f}", f"{3 * part:.2f}"]))


def table(verdicts: Sequence[Verdict]) -> str:
    head = ("figure", "before", "now", "part", "noise", "")
    rows = [
        [v.name, *(format_number(x) for x in (v.before, v.now, v.part)), f"± {v.noise:g}", v.says]
        for v in verdicts
    ]
    return "\n".join(line(cells) for cells in (head, ["---"] * len(head), *rows))


def commit() -> str:
    """Return this tree's commit, with a + for uncommitted changes; empty without git."""
    try:
        command = ["git", "describe", "--always", "--dirty=+"]
        return subprocess.run(
            command, cwd=HISTORY.parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def draw(path: Path, kept: Sequence[Mapping[str, Any]]) -> None:
    """Draw each figure over the kept runs; the band is its noise about its reference. Raises UsageError
    without any."""
    if not kept:
        raise UsageError("--picture: the history is empty; add a run by --keep WHY")
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names, held = list(kept[-1]["figures"]), wanted(kept)
    figure, axes = pyplot.subplots(
        len(names), 1, figsize=(8, 1.1 * len(names)), sharex=True, layout="constrained", squeeze=False
    )
    dates, at = [f"{one['date']} {one['commit']}" for one in kept], range(len(kept))
    for axis, name in zip(axes[:, 0], names, strict=True):
        values = [one["figures"].get(name, math.nan) for one in kept]
        axis.plot(at, values, marker="o", color="#00798c")
        noise = NOISE[name.partition(": ")[2]]
        axis.axhspan(held[name] * (1 - noise), held[name] * (1 + noise), color="#00798c", alpha=0.12)
        axis.set_title(name, fontsize=8, loc="left")
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xticks(at, dates, rotation=30, ha="right")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
