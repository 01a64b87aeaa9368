"""Check the error model on recordings with ground truth: does its estimate rise with the tracker's error?

    python tools/experiments/check_error_model.py MODEL SOURCE [SOURCE ...] [--spoiled SEED] [--picture FILE]

MODEL: a file, or `shipped`. SOURCE as for `share track`. Prints a Markdown table: keyframes with a known
error, its median and 95 %; then of the model and of its rival, the filter's own sigma: RMSE, and rank
correlation (Spearman); share of errors within the model's intervals, and below their upper ends; share of
strange keyframes. Where there are several sources, rows of all keyframes together, and of the median over
sources. --spoiled: with drawn faults, as in training (`share train labels`). The picture has error, estimate
and interval over time, one panel a source.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from scipy.stats import spearmanr  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.lab.train.fault_injection import FAULT_KINDS, FaultInterval, draw_faults  # noqa: E402
from share.lab.train.labels import labelled_keyframes  # noqa: E402
from share.odometry.error_model.inputs import SCALAR_NAMES, sigma_of_score  # noqa: E402
from share.odometry.error_model.network import OnnxSession, estimate_error, open_error_model  # noqa: E402
from share.runtime.source import Source, open_source  # noqa: E402
from share.types import F64  # noqa: E402

HEAD = (
    "source",
    "keyframes",
    "error cm: p50, p95",
    "RMSE cm: model, sigma",
    "rank: model, sigma",
    "in the interval, below its end",
    "strange",
)


@dataclass(frozen=True, eq=False)
class Checked:
    """N keyframes: seconds; error_cm; estimate (N, 3): expected, low and high, cm; strange (N,); sigma_cm
    (N,): of the position after the motion of the last 5 s, by odometry's covariances."""

    name: str
    seconds: F64
    error_cm: F64
    estimate: F64
    strange: F64
    sigma_cm: F64


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--spoiled", type=int, metavar="SEED")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    return exit_code("check_error_model", lambda: check(options))


def check(options: argparse.Namespace) -> None:
    network = open_error_model(options.model)
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    found = []
    for name in options.sources:
        found.append(checked(name, network, options.spoiled))
        print(line(cells_of(found[-1])), flush=True)
    if len(found) > 1:
        print(line(cells_of(joined(found))))
        print(
            line(
                [
                    "median of sources",
                    *[""] * 3,
                    _ranks(np.median([ranks(one) for one in found], axis=0)),
                    "",
                    "",
                ]
            )
        )
    if options.picture:
        draw(options.picture, found)


def checked(name: str, network: OnnxSession, spoiled: int | None = None) -> Checked:
    """Track a source, spoiled by faults of a seed if given, and estimate the error at each keyframe."""
    source, rows = open_source(name), []
    faults = () if spoiled is None else drawn_faults(source, spoiled)
    for stamp_ns, error_cm, features in labelled_keyframes(source, Config(), faults, spoiled or 0):
        if not np.isnan(error_cm):
            estimate = estimate_error(network, features)
            interval = estimate.error_cm, estimate.low_cm, estimate.high_cm
            sigma_cm = sigma_of_score(float(features.scalars[SCALAR_NAMES.index("tracking score")]))
            rows.append((stamp_ns * 1e-9, error_cm, *interval, estimate.out_of_distribution, sigma_cm))
    if len(rows) < 2:
        raise UsageError(f"{name}: has {len(rows)} keyframes with a known error; too few")
    t = np.array(rows, float)
    return Checked(name, t[:, 0] - t[0, 0], t[:, 1], t[:, 2:5], t[:, 5], t[:, 6])


def drawn_faults(source: Source, seed: int) -> list[FaultInterval]:
    """Draw one to three kinds of faults over a recording, other ones for each name."""
    rng = np.random.default_rng((seed, zlib.crc32(source.name.encode())))
    kinds = rng.permutation(list(FAULT_KINDS))[: rng.integers(1, 4)].tolist()
    truth = source.truth()
    if truth is None:
        raise UsageError(f"{source.name}: has no ground truth")
    return draw_faults(rng, int(truth.stamps_ns[0]), int(truth.stamps_ns[-1]), kinds)


def joined(found: Sequence[Checked]) -> Checked:
    """Return all keyframes as of one source."""
    columns = ("seconds", "error_cm", "estimate", "strange", "sigma_cm")
    return Checked("all", *(np.concatenate([getattr(one, name) for one in found]) for name in columns))


def ranks(one: Checked) -> tuple[float, float]:
    """Return Spearman's correlation of the error with the model's estimate, and with the filter's sigma."""
    model, sigma = (spearmanr(x, one.error_cm).statistic for x in (one.estimate[:, 0], one.sigma_cm))
    return float(model), float(sigma)


def cells_of(one: Checked) -> list[str]:
    covered = (one.estimate[:, 1] <= one.error_cm) & (one.error_cm <= one.estimate[:, 2])
    below = one.error_cm <= one.estimate[:, 2]
    p50, p95 = np.percentile(one.error_cm, [50, 95])
    rmse = [float(np.sqrt(((x - one.error_cm) ** 2).mean())) for x in (one.estimate[:, 0], one.sigma_cm)]
    return [
        "/".join(Path(one.name).parts[-2:]),
        str(len(one.error_cm)),
        f"{p50:.2f}, {p95:.2f}",
        f"{rmse[0]:.2f}, {rmse[1]:.2f}",
        _ranks(ranks(one)),
        f"{100 * covered.mean():.0f}, {100 * below.mean():.0f} %",
        f"{100 * one.strange.mean():.0f} %",
    ]


def _ranks(pair: Sequence[float]) -> str:
    return f"{pair[0]:.2f}, {pair[1]:.2f}"


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
