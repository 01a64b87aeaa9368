"""Statistics of random studies by pingouin, statsmodels and scikit-posthocs, and by SHARE.

With these libraries installed, `python tests/helpers/study_libraries.py FILE` writes what they say of 24 data
sets: tests/lab/study/library_vectors.json.
"""

from __future__ import annotations

import json
import sys
import warnings
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np

LIBRARIES = ("pingouin", "statsmodels", "scikit-posthocs", "scipy", "numpy")
VECTORS = 24


def data_set(seed: int) -> dict[str, Any]:
    """A random study: values (n, k), None where missing; orders; counts of choices. Two of three are answers
    on ten points or counts, with many ties."""
    rng = np.random.default_rng([43, seed])
    n, k = int(rng.integers(6, 31)), int(rng.integers(2, 7))
    effect = rng.normal(0, rng.choice([0.0, 0.5, 1.5]), k)
    values = 6 + rng.normal(0, 1.5, (n, 1)) + effect + rng.normal(0, rng.uniform(0.5, 2), (n, k))
    if seed % 3 == 0:
        values = np.rint(1024 * values) / 1024  # differences are exact, so ties are ties to all
    else:
        values = np.rint(values).clip(1, 10) if seed % 3 == 1 else np.rint(values / 2).clip(0, 4)
    missing = rng.random((n, k)) < rng.choice([0.0, 0.02, 0.05])
    orders = np.array([rng.permutation(k) for _ in range(n)])
    return {
        "seed": seed,
        "values": [
            [None if gone else value for gone, value in zip(row_gone, row, strict=True)]
            for row_gone, row in zip(missing.tolist(), values.tolist(), strict=True)
        ],
        "orders": orders.tolist(),
        "choices": rng.multinomial(n, np.full(k, 1 / k)).tolist(),
    }


def as_array(data: dict[str, Any]) -> np.ndarray:
    return np.array(data["values"], float)


def by_libraries(data: dict[str, Any]) -> dict[str, Any]:
    """The same keys as `by_share`."""
    import pandas as pd
    import pingouin as pg
    import scikit_posthocs as sp
    import scipy.stats as ss
    from statsmodels.stats.anova import AnovaRM
    from statsmodels.stats.multitest import multipletests

    warnings.simplefilter("ignore")
    values = as_array(data)
    wide = pd.DataFrame(values, columns=[f"c{k}" for k in range(values.shape[1])])
    whole = wide.dropna()
    out: dict[str, Any] = {}
    row = pg.friedman(wide).iloc[0]
    out["friedman"] = [row["Q"], row["p_unc"], row["W"]]
    table = pg.rm_anova(wide, correction=True, detailed=True, effsize="ng2")
    effect = table.iloc[0]
    out["anova"] = [effect["F"], effect["p_unc"], effect["ng2"], effect["eps"]]
    out["partial eta2"] = pg.rm_anova(wide, effsize="np2", detailed=True).iloc[0]["np2"]
    if values.shape[1] > 2:
        out["p gg"] = effect["p_GG_corr"]
        mauchly = pg.sphericity(wide)
        if mauchly.W > 0:  # of a singular covariance pingouin says p = 0, and SHARE that there is no test
            out["mauchly"] = [mauchly.W, mauchly.chi2, mauchly.pval]
        out["huynh-feldt"] = pg.epsilon(wide, correction="hf")
    long = whole.reset_index().melt(id_vars="index")
    fit = AnovaRM(long, "value", "index", within=["variable"]).fit().anova_table.iloc[0]
    out["statsmodels anova"] = [fit["F Value"], fit["Pr > F"]]
    pairs = list(combinations(whole.columns, 2))
    p_values = []
    out["wilcoxon"] = []
    for a, b in pairs:
        if (whole[a] == whole[b]).all():
            out["wilcoxon"].append([None] * 3)
            p_values.append(1.0)
            continue
        test = pg.wilcoxon(whole[a], whole[b], zero_method="pratt", method="approx", correction=False).iloc[0]
        out["wilcoxon"].append([test["W_val"], test["p_val"], test["RBC"]])
        p_values.append(test["p_val"])
    out["exact"] = [_exact(whole[a] - whole[b]) for a, b in pairs]
    out["holm"] = multipletests(p_values, method="holm")[1].tolist()
    nemenyi = sp.posthoc_nemenyi_friedman(whole.to_numpy())
    out["nemenyi"] = [nemenyi.iloc[i, j] for i, j in combinations(range(len(whole.columns)), 2)]
    chosen = ss.chisquare(data["choices"])
    out["choices"] = [chosen.statistic, chosen.pvalue]
    n, k = whole.shape
    out["power"] = pg.power_rm_anova(eta_squared=0.06, m=k, n=n, corr=0.4, epsilon=0.8)
    return json.loads(json.dumps(out | {"order": _order_by_statsmodels(data)}, default=float))


def _exact(differences: Any) -> float | None:
    """By all signs, of few pairs that differ, ties and zeros included."""
    import scipy.stats as ss

    kept = int((differences != 0).sum())
    if kept < 1 or len(differences) > 12:  # scipy would draw, as it counts the signs of zeros too
        return None
    method = ss.PermutationMethod(n_resamples=2**13)
    return float(ss.wilcoxon(differences, zero_method="pratt", method=method).pvalue)


def _order_by_statsmodels(data: dict[str, Any]) -> list[float]:
    """F and p of place, then of carry-over."""
    import pandas as pd
    from statsmodels.formula.api import ols
    from statsmodels.stats.anova import anova_lm

    values, orders = as_array(data), np.array(data["orders"])
    k = values.shape[1]
    rows = []
    for person, order in enumerate(orders.tolist()):
        for at, condition in enumerate(order):
            before = order[at - 1] if at else -1
            codes = {f"b{j}": (before == j) - (before == k - 1) for j in range(k - 1)}
            rows.append({"y": values[person, condition], "s": person, "c": condition, "p": at, **codes})
    frame = pd.DataFrame(rows).dropna()
    carry = " + ".join(f"b{j}" for j in range(k - 1))
    fits = [
        ols(f"y ~ C(s) + C(c){rest}", frame).fit()
        for rest in (f" + C(p) + {carry}", f" + {carry}", " + C(p)")
    ]
    out = []
    for reduced in fits[1:]:
        if reduced.df_resid == fits[0].df_resid:
            return []  # the design tells them not apart
        row = anova_lm(reduced, fits[0]).iloc[1]
        out += [row["F"], row["Pr(>F)"]]
    return out


def by_share(data: dict[str, Any]) -> dict[str, Any]:
    """The same figures by this project, as `share study analyze` computes them."""
    from share.lab.study.power import anova_power
    from share.lab.study.rank_tests import choice_test, friedman, holm, nemenyi, wilcoxon
    from share.lab.study.repeated_anova import order_effects, repeated_anova

    values = as_array(data)
    whole = values[np.isfinite(values).all(axis=1)]
    n, k = whole.shape
    ranks, anova = friedman(whole), repeated_anova(whole)
    pairs = list(combinations(range(k), 2))
    approximate = [wilcoxon(whole[:, a], whole[:, b], max_exact=0) for a, b in pairs]
    sphericity = anova.sphericity
    choices = choice_test(data["choices"])
    order = order_effects(values, np.argsort(np.array(data["orders"]), axis=1) + 1)
    return {
        "friedman": [ranks.chi2, ranks.p, ranks.concordance.value],
        "anova": [anova.f, anova.p, anova.generalised_eta2.value, sphericity.greenhouse_geisser],
        "partial eta2": anova.partial_eta2.value,
        "p gg": anova.p_gg,
        "mauchly": [sphericity.w, sphericity.chi2, sphericity.p],
        "huynh-feldt": sphericity.huynh_feldt,
        "statsmodels anova": [anova.f, anova.p],
        "wilcoxon": [[one.w, one.p, one.rank_biserial.value] for one in approximate],
        "exact": [wilcoxon(whole[:, a], whole[:, b]).p for a, b in pairs],
        "holm": holm([one.p for one in approximate]),
        "nemenyi": nemenyi(ranks.mean_ranks, n),
        "choices": [choices.chi2, choices.p],
        # f² k / (1 - ρ), a participant's part
        "power": anova_power(0.06 / 0.94 * k / (1 - 0.4), k, n, 0.8),
        "order": [order.place.f, order.place.p, order.carry_over.f, order.carry_over.p],
    }


def largest_differences(mine: dict[str, Any], theirs: dict[str, Any]) -> dict[str, float]:
    """The largest difference of each figure that they have, absolute or relative, whichever is less."""
    out = {}
    for name, expected in theirs.items():
        pairs = list(zip(_flat(mine[name]), _flat(expected), strict=False))
        known = [(a, b) for a, b in pairs if b is not None and b == b]
        out[name] = max((abs(a - b) / max(1.0, abs(b)) if a == a else 9.0 for a, b in known), default=0.0)
    return out


def _flat(value: Any) -> list[Any]:
    if not isinstance(value, list):
        return [value]
    return [x for one in value for x in _flat(one)]


if __name__ == "__main__":
    made = [data_set(seed) for seed in range(VECTORS)]
    content = {
        "made by": {name: version(name) for name in LIBRARIES},
        "studies": [{"data": one, "says": by_libraries(one)} for one in made],
    }
    with open(sys.argv[1], "w") as file:
        json.dump(content, file, separators=(",", ":"))
        file.write("\n")
