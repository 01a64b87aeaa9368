"""Has anything become worse? A small fixed set in virtual time, held against what it came to before.

    python tools/regression.py                 compare with the last line of the history; code 1 if worse
    python tools/regression.py --keep WHY      compare, and add this run to the history
    python tools/regression.py --chance 6      how far figures move by chance alone: what NOISE is from
    python tools/regression.py --picture FILE  draw the history, run nothing

The set: two rooms, in each two headsets and a robot for 30 s, over wifi5 by `share` and by `covins-g`, two
seeds. Sessions are made once and kept (--cache). In virtual time nothing depends on how busy this machine is;
how quick it is, `make bench` says. The history: docs/results/regression.jsonl.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from share import process

process.prepare()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share import __version__  # noqa: E402
from share.config import Config  # noqa: E402
from share.emulate.recipe import Recipe  # noqa: E402
from share.emulate.session import cached_session  # noqa: E402
from share.errors import DataError, ShareError  # noqa: E402
from share.io.files import atomic_write  # noqa: E402
from share.io.machine import describe_machine  # noqa: E402
from share.io.session import read_session  # noqa: E402
from share.metrics.comparison import MEASURES, policies  # noqa: E402
from share.metrics.figures import RunFigures  # noqa: E402
from share.run.ablation import plan  # noqa: E402
from share.run.as_text import number  # noqa: E402
from share.run.campaign import go_through, side_by_side  # noqa: E402
from share.run.figures import figures  # noqa: E402
from share.run.play import Terms  # noqa: E402

HISTORY = Path(__file__).resolve().parents[1] / "docs" / "results" / "regression.jsonl"
_WHO = ("ar1=walk:", "ar2=walk:speed=1.2", "robot=robot:")
_PROFILES = {"": "d435i:640x480@15"}
SET = tuple(
    Recipe(scene, _WHO, seconds=30.0, seed=seed, profiles=_PROFILES)
    for scene, seed in (("warehouse", 901), ("firestation", 902))
)
POLICIES, SEEDS = ("share", "covins-g"), (0, 1)
_ODOMETRY = "odometry ATE"
# By how much a figure has to move, as a part of itself, before it is called worse or better: three standard
# deviations of what chance alone does to it (--chance 6; rounded up, and of means, which are less steady).
NOISE = {
    _ODOMETRY: 0.3,
    "AR latency": 0.05,
    "AR corrections": 0.1,
    "merges a metre": 0.15,
    "joint ATE": 0.7,
    "AR RPE over 1 s": 0.9,
    "AR until in a shared map": 0.25,
    "agents in one map": 0.2,
}
MORE_IS_BETTER = ("agents in one map",)

Figures = dict[str, float]


class Verdict(NamedTuple):
    """One figure, as a part of what it was; NaN where it was not known or is not any more."""

    name: str
    before: float
    now: float
    noise: float

    @property
    def part(self) -> float:
        return self.now / self.before if self.before else math.nan

    @property
    def says(self) -> str:
        """`worse`, `better`, or nothing to speak of."""
        if math.isnan(self.now) and not math.isnan(self.before):
            return "worse"
        if math.isnan(self.part) or abs(self.part - 1) <= self.noise:
            return ""
        more = self.part > 1
        return "better" if more == (self.name.partition(": ")[2] in MORE_IS_BETTER) else "worse"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--keep", metavar="WHY", help="add this run to the history")
    parser.add_argument("--chance", type=int, metavar="N", help="play the set N times, by chance alone")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the history")
    parser.add_argument("--history", type=Path, default=HISTORY)
    parser.add_argument("--cache", type=Path, help="of sessions (default: the user's)")
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
    """Raises ShareError where something is worse, after all has been said and kept."""
    before = history(options.history)
    now = played(Config(), options)
    verdicts = judged(now, before[-1]["figures"] if before else {})
    print(table(verdicts))
    if options.keep is not None:
        kept = {
            "date": datetime.now(UTC).date().isoformat(),
            "why": options.keep,
            "version": __version__,
            "commit": commit(),
            "machine": describe_machine()["cpu"],
            "figures": now,
        }
        lines = [json.dumps(one) for one in (*before, kept)]
        atomic_write(options.history, "\n".join(lines) + "\n")
    if worse := [verdict.name for verdict in verdicts if verdict.says == "worse"]:
        raise ShareError(f"worse than {before[-1]['date']} ({before[-1]['why']}): {', '.join(worse)}")


def played(config: Config, options: argparse.Namespace) -> Figures:
    """Raises ShareError where a run fails."""
    sessions = [read_session(cached_session(recipe, options.cache, options.workers)) for recipe in SET]
    with tempfile.TemporaryDirectory() as folder:
        terms = Terms("", link="wifi5", true_error=True, virtual=True)
        runs = plan(sessions, POLICIES, SEEDS, terms, Path(folder), config)
        found = []
        for _, came in go_through(runs, lambda n, now: None, side_by_side(options.workers)):
            if isinstance(came, ShareError):
                raise came
            found.append(figures(came))
    return figures_of(found)


def figures_of(runs: Sequence[RunFigures]) -> Figures:
    """Medians by name, `POLICY: MEASURE`: one run that ends amid a join should not be all there is to see."""
    out = {f"{POLICIES[0]}: {_ODOMETRY}": _median(a.odom_ate_cm for run in runs for a in run.agents)}
    for policy in policies(runs):
        mine = [run for run in runs if run.conditions.policy == policy]
        for measure in (m for m in MEASURES if m.name in NOISE):
            out[f"{policy}: {measure.name}"] = _median(measure.of(run) for run in mine)
    return out


def _median(values: Any) -> float:
    known = [value for value in values if not math.isnan(value)]
    return round(float(np.median(known)), 6) if known else math.nan


def judged(now: Mapping[str, float], before: Mapping[str, float]) -> list[Verdict]:
    return [
        Verdict(name, before.get(name, math.nan), value, NOISE[name.partition(": ")[2]])
        for name, value in now.items()
    ]


def history(path: Path) -> list[dict[str, Any]]:
    """All runs that were kept, the oldest first. Raises DataError."""
    try:
        return [json.loads(text) for text in path.read_text().splitlines()] if path.exists() else []
    except ValueError as error:
        raise DataError(f"{path}: is damaged: {error}") from None


def by_chance(options: argparse.Namespace) -> None:
    """Prints the standard deviation of each figure, as a part of its mean, and three of them."""
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
        [v.name, *(number(x) for x in (v.before, v.now, v.part)), f"± {v.noise:g}", v.says] for v in verdicts
    ]
    return "\n".join(line(cells) for cells in (head, ["---"] * len(head), *rows))


def commit() -> str:
    """Of this tree, with a + where it has changes; empty where there is no git."""
    try:
        told = ["git", "describe", "--always", "--dirty=+"]
        return subprocess.run(
            told, cwd=HISTORY.parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def draw(path: Path, kept: Sequence[Mapping[str, Any]]) -> None:
    """Each figure over the runs that were kept, as a part of the first."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(kept[-1]["figures"])
    figure, axes = pyplot.subplots(
        len(names), 1, figsize=(8, 1.1 * len(names)), sharex=True, layout="constrained", squeeze=False
    )
    dates = [f"{one['date']} {one['commit']}" for one in kept]
    for axis, name in zip(axes[:, 0], names, strict=True):
        values = [one["figures"].get(name, math.nan) for one in kept]
        axis.plot(dates, values, marker="o", color="#00798c")
        noise = NOISE[name.partition(": ")[2]]
        axis.axhspan(values[-1] * (1 - noise), values[-1] * (1 + noise), color="#00798c", alpha=0.12)
        axis.set_title(name, fontsize=8, loc="left")
        axis.grid(alpha=0.3)
    axes[-1, 0].tick_params(axis="x", rotation=30)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
