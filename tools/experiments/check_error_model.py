"""Check the error model on recordings with ground truth: does its estimate rise with the tracker's error?

    python tools/experiments/check_error_model.py MODEL SOURCE [SOURCE ...] [--picture FILE]

SOURCE as for `share track`. Prints a Markdown table: keyframes with a known error, its median and 95 %, RMSE,
rank correlation (Spearman), share of errors within their intervals, number of strange keyframes. The picture
has error, estimate and interval over time, one panel a source.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from scipy.stats import spearmanr  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.lab.train.labels import labelled_keyframes  # noqa: E402
from share.odometry.error_model.network import OnnxSession, estimate_error, open_network, read_model  # noqa: E402  # noqa: E402
from share.runtime.source import open_source  # noqa: E402
from share.types import F64  # noqa: E402

HEAD = (
    "source",
    "keyframes",
    "error cm: p50, p95",
    "RMSE cm",
    "rank correlation",
    "in the interval",
    "strange",
)


@dataclass(frozen=True, eq=False)
class Checked:
    """N keyframes: seconds; error_cm; estimate (N, 3): expected, low and high, cm; strange (N,)."""

    name: str
    seconds: F64
    error_cm: F64
    estimate: F64
    strange: F64


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    return exit_code("check_error_model", lambda: check(options))


def check(options: argparse.Namespace) -> None:
    network = open_network(read_model(options.model))
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    found = []
    for name in options.sources:
        found.append(checked(name, network))
        print(line(cells_of(found[-1])), flush=True)
    if options.picture:
        draw(options.picture, found)


def checked(name: str, network: OnnxSession) -> Checked:
    rows = []
    for stamp_ns, error_cm, features in labelled_keyframes(open_source(name), Config()):
        if not np.isnan(error_cm):
            estimate = estimate_error(network, features)
            interval = estimate.error_cm, estimate.low_cm, estimate.high_cm
            rows.append((stamp_ns * 1e-9, error_cm, *interval, estimate.out_of_distribution))
    if len(rows) < 2:
        raise UsageError(f"{name}: has {len(rows)} keyframes with a known error; too few")
    table = np.array(rows, float)
    return Checked(name, table[:, 0] - table[0, 0], table[:, 1], table[:, 2:5], table[:, 5])


def cells_of(one: Checked) -> list[str]:
    off = one.estimate[:, 0] - one.error_cm
    covered = (one.estimate[:, 1] <= one.error_cm) & (one.error_cm <= one.estimate[:, 2])
    p50, p95 = np.percentile(one.error_cm, [50, 95])
    return [
        Path(one.name).name,
        str(len(one.error_cm)),
        f"{p50:.2f}, {p95:.2f}",
        f"{np.sqrt((off**2).mean()):.2f}",
        f"{spearmanr(one.estimate[:, 0], one.error_cm).statistic:.2f}",
        f"{100 * covered.mean():.0f} %",
        f"{100 * one.strange.mean():.0f} %",
    ]


def draw(path: Path, found: list[Checked]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        len(found), 1, figsize=(9, 2.6 * len(found)), layout="constrained", squeeze=False
    )
    for axis, one in zip(axes[:, 0], found, strict=True):
        expected, low, high = one.estimate.T
        axis.fill_between(one.seconds, low, high, color="#00798c", alpha=0.2, linewidth=0, label="interval")
        axis.plot(one.seconds, expected, color="#00798c", label="estimate")
        axis.plot(one.seconds, one.error_cm, color="#d1495b", label="error")
        axis.set(yscale="log", ylabel="cm", title=Path(one.name).name)
        axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("s")
    axes[0, 0].legend(ncols=3, fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    sys.exit(main())
