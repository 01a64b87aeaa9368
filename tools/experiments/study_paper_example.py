"""Draw studies that agree with the figures that the paper gives of its own, and analyse them.

The paper's data are not public. It reports reachability of 71, 57, 55 and 43 % (20 participants, ten calls
each: 142, 114, 110 and 86 of 200) and a Friedman chi-squared of 13.24, taken here to be of reachability. Each
drawn study has these sums and this chi-squared, to two decimals; what differs between them is what the
figures leave open. The first is written as CSV.

    python tools/experiments/study_paper_example.py --studies 12 --out reached.csv
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.files.writing import atomic_write  # noqa: E402
from share.lab.study.orders import draw_orders  # noqa: E402
from share.lab.study.plan import PAPER_POLICIES  # noqa: E402
from share.lab.study.rank_tests import friedman, holm, wilcoxon  # noqa: E402
from share.lab.study.repeated_anova import repeated_anova  # noqa: E402
from share.lab.tables import csv_text  # noqa: E402
from share.types import F64  # noqa: E402

SUMS, CALLS, PARTICIPANTS, CHI2 = (142, 114, 110, 86), 10, 20, 13.24
_STEPS = 4000  # of a search


def friedman_chi2(values: F64) -> float:
    """Return the statistic alone, without intervals."""
    n, k = values.shape
    less, same = (
        (compare(values[:, None, :], values[:, :, None])).sum(axis=2) for compare in (np.less, np.equal)
    )
    ranks = less + (same + 1) / 2
    spread = ((ranks - (k + 1) / 2) ** 2).sum()
    return float((k - 1) * ((ranks.sum(axis=0) - n * (k + 1) / 2) ** 2).sum() / spread)


def draw_study(rng: np.random.Generator) -> F64:
    """Return reached calls (20, 4) with the paper's sums and chi-squared: drawn, then moved call by call."""
    while True:
        values = np.zeros((PARTICIPANTS, len(SUMS)))
        skill = rng.normal(0, rng.uniform(0, 1), PARTICIPANTS)  # participants differ, by as much as may be
        for k, total in enumerate(SUMS):
            chances = 1 / (1 + np.exp(-(skill + np.log(total / (200 - total)))))
            values[:, k] = rng.binomial(CALLS, chances)
            while (excess := int(values[:, k].sum()) - total) != 0:
                one = int(rng.integers(PARTICIPANTS))
                values[one, k] = np.clip(values[one, k] - np.sign(excess), 0, CALLS)
        distance = abs(friedman_chi2(values) - CHI2)
        for _ in range(_STEPS):
            if distance < 0.005:
                return values
            moved, k = values.copy(), int(rng.integers(len(SUMS)))
            a, b = rng.integers(PARTICIPANTS, size=2)
            moved[a, k] += 1
            moved[b, k] -= 1
            if moved.min() < 0 or moved.max() > CALLS:
                continue
            changed = abs(friedman_chi2(moved) - CHI2)
            if changed <= distance:
                values, distance = moved, changed


def _draw_all() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=12)
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    studies = [draw_study(rng) for _ in range(arguments.studies)]
    orders = draw_orders(len(SUMS), PARTICIPANTS, rng)
    rows = [
        [f"p{person + 1:02d}", PAPER_POLICIES[k], list(order).index(k) + 1, int(studies[0][person, k])]
        for person, order in enumerate(orders.tolist())
        for k in range(len(SUMS))
    ]
    atomic_write(arguments.out, csv_text(["participant", "condition", "place", "reached of 10"], rows))
    test = friedman(studies[0])
    print(f"chi2({test.df}) = {test.chi2:.2f}, p = {test.p:.4f}, W = {test.concordance.value:.3f}")
    f = np.array([repeated_anova(one).f for one in studies])
    print(f"ANOVA F over {len(studies)} studies: {f.min():.1f} to {f.max():.1f}, median {np.median(f):.1f}")
    pairs = [(a, b) for a in range(4) for b in range(a + 1, 4)]
    p_values = np.array([holm([wilcoxon(one[:, a], one[:, b]).p for a, b in pairs]) for one in studies])
    for (a, b), column in zip(pairs, p_values.T, strict=True):
        found = int((column < 0.05).sum())
        print(f"{PAPER_POLICIES[a]} - {PAPER_POLICIES[b]}: Holm's p < 0.05 in {found} of {len(studies)}")


if __name__ == "__main__":
    sys.exit(exit_code("study_paper_example.py", _draw_all))
