"""Errors that agents estimate of themselves, against the true ones.

    python tools/experiments/measure_error_estimates.py RUN… [--by policy|SECTION.NAME] [--picture FILE]

A RUN is a folder by `share evaluate run`, or one by `sweep` or `ablation` with its runs. Prints a Markdown
table, a row for each kind of agent (and each value of the setting): of N evaluations while an agent is in the
largest map, the rms of the estimated and of the true error then (position, one alignment for all in that
map); the median of true / estimated, about 0.9 for calibrated estimates; the share with an error below twice
the estimate; rank correlation over all evaluations, and over agents' runs by their rms. Evaluations have the
edge's clock; the ground truth begins with the first agent that joined the edge.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.errors import UsageError  # noqa: E402
from share.files.json_file import read_json_lines  # noqa: E402
from share.geometry.interpolation import associate  # noqa: E402
from share.lab.evaluate.scoring import first_join_s, score_session, traces  # noqa: E402
from share.lab.evaluate.trial import RUN_FILE, SETTINGS_FILE, Trial, read_trial  # noqa: E402
from share.metrics.ate import error_statistics, position_errors  # noqa: E402
from share.types import F64  # noqa: E402

HEAD = (
    "agents",
    "runs",
    "N",
    "estimated, cm",
    "true, cm",
    "true / estimated",
    "within twice, %",
    "rank",
    "of runs",
)


@dataclass(frozen=True, eq=False)
class Pairs:
    """One agent in one run, at N evaluations. estimated_cm, true_cm: estimated and true errors (N,)."""

    kind: str
    estimated_cm: F64
    true_cm: F64


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--by", metavar="WHAT", help="separate rows for each value")
    parser.add_argument("--picture", type=Path, help="plot of true over estimated errors")
    options = parser.parse_args()
    return exit_code("measure_error_estimates", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    rows: dict[str, list[Pairs]] = defaultdict(list)
    for folder in (one for top in options.runs for one in _runs(top)):
        trial = read_trial(folder)
        value = _setting(trial, options.by) if options.by else ""
        for pairs in estimated_and_true(trial):
            rows[f"{pairs.kind} {value}".strip()].append(pairs)
    if not rows:
        raise UsageError("no run has error estimates in a map; run `share evaluate` with an error model")
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))))
    for name, of in sorted(rows.items()):
        print(line([name, *figures(of)]))
    if options.picture:
        _draw(options.picture, rows)


def estimated_and_true(trial: Trial) -> Iterator[Pairs]:
    """Yield the pairs of each agent in the largest map. Raises DataError on damaged files."""
    found = score_session(trial.session, trial.folders)
    if found.joint is None:
        return
    began = first_join_s(read_json_lines(trial.folder / "edge" / "events.jsonl"))
    first_ns = min(int(agent.truth.stamps_ns[0]) for agent in found.agents.values())
    for name, trace in traces(trial).items():
        estimate, truth = found.agents[name].map, found.agents[name].truth
        if estimate is None or name not in found.joint.agents:
            continue
        stamps_ns, T_est, T_truth = associate(estimate, truth)
        error_cm = 100 * position_errors(found.joint.joint.T_truth_est, T_est, T_truth)
        frames_s, at_s = (stamps_ns - first_ns) * 1e-9, trace.seconds - began
        then = (frames_s[0] <= at_s) & (at_s <= frames_s[-1]) & (trace.error_cm > 0)  # NaN: no estimate
        true_cm = np.interp(at_s[then], frames_s, error_cm)
        yield Pairs(str(trial.session.agents[name].kind), trace.error_cm[then], true_cm)


def _runs(top: Path) -> list[Path]:
    found = (
        [top]
        if (top / RUN_FILE).is_file()
        else sorted(path.parent for path in top.glob(f"runs/*/{RUN_FILE}"))
    )
    if not found:
        raise UsageError(f"{top}: has no {RUN_FILE}, and no runs with one; give a folder by `share evaluate`")
    return found


def _setting(trial: Trial, name: str) -> str:
    import yaml

    if name == "policy":
        return trial.options.policy
    value: Any = yaml.safe_load((trial.folder / SETTINGS_FILE).read_text())
    for part in name.split("."):
        if not isinstance(value, dict) or part not in value:
            raise UsageError(f"--by {name}: is not a setting in {trial.folder / SETTINGS_FILE}")
        value = value[part]
    return str(value)


def figures(of: list[Pairs]) -> list[str]:
    estimated, true = (
        np.concatenate([getattr(pairs, what) for pairs in of]) for what in ("estimated_cm", "true_cm")
    )
    runs = np.array(
        [
            [error_statistics(pairs.estimated_cm).rmse, error_statistics(pairs.true_cm).rmse]
            for pairs in of
            if len(pairs.estimated_cm)
        ]
    )
    cells = [
        f"{error_statistics(estimated).rmse:.2f}",
        f"{error_statistics(true).rmse:.2f}",
        f"{np.median(true / estimated):.2f}",
    ]
    cells += (
        f"{100 * np.mean(true <= 2 * estimated):.0f}",
        f"{_rank(estimated, true):.2f}",
        f"{_rank(*runs.T):.2f}",
    )
    return [str(len(runs)), str(len(estimated)), *cells]


def _rank(a: F64, b: F64) -> float:
    """Return Spearman's correlation."""
    from scipy.stats import spearmanr

    return float(spearmanr(a, b).statistic)


def _draw(path: Path, rows: dict[str, list[Pairs]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, len(rows), figsize=(4.4 * len(rows), 4.2), sharex=True, sharey=True, squeeze=False
    )
    for axis, (name, of) in zip(axes[0], sorted(rows.items()), strict=True):
        for pairs in of:
            axis.loglog(pairs.estimated_cm, pairs.true_cm, ".", markersize=2.5, alpha=0.5)
        axis.plot([0.05, 20], [0.05, 20], color="black", linewidth=0.8)
        axis.set(title=name, xlabel="estimated error, cm")
    axes[0, 0].set_ylabel("true error in the map, cm")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
