"""The loops of a map against the truth: their errors over the claimed ones, and which share an error.

    python tools/experiments/measure_loops.py SESSION ... [--json FILE]

SESSION: by `share emulate`; played in virtual time. Prints two Markdown tables.

Protocol: all loops that the map holds at the end and whose keyframes have a truth; those off by more than
0.3 m are left out and counted. NEES: squared error in the loop's covariance (6 is exact on average).
Correlation: of the whitened errors, in the frame of a keyframe, of two of its loops whose other ends are a
keyframe of one agent each and so far apart; pairs with a NEES above 20 are left out.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from measure_next_day import play  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.geometry import se3  # noqa: E402
from share.geometry.interpolation import interpolate  # noqa: E402
from share.mapping.loops import KeyframeKey, Loop  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.recordings.trajectory import read_tum  # noqa: E402
from share.store.map_store import MapStore  # noqa: E402
from share.types import F64  # noqa: E402

_FALSE_M, _MAX_NEES = 0.3, 20.0
_RANGES_M = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, np.inf)
_APART_M = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, np.inf)


@dataclass(frozen=True, eq=False)
class TrueLoop:
    """A loop with its true pose T_a_b (4, 4) and the kinds of its agents, as "ar-robot own"."""

    session: str
    loop: Loop
    true: F64
    kinds: str

    @property
    def error(self) -> F64:
        """Error (6,), a right perturbation."""
        return np.asarray(se3.log(se3.inverse(self.true) @ self.loop.T_a_b))

    @property
    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.loop.cov, self.error))

    @property
    def range_m(self) -> float:
        return float(np.linalg.norm(self.true[:3, 3]))


@dataclass(frozen=True)
class LoopErrors:
    """Loops of one group. sigma_mm: claimed, of the position."""

    loops: str
    count: int
    error_mm_p50: float
    error_mm_p90: float
    sigma_mm: float
    nees_median: float
    nees_mean: float
    nees_p90: float


@dataclass(frozen=True)
class Correlation:
    """Of pairs of loops of one keyframe: of all six coordinates, of the rotation, of the position."""

    pairs: str
    count: int
    all: float
    rotation: float
    position: float


def true_loops(session: Session) -> tuple[list[TrueLoop], int]:
    """Play a session. Return the loops of its map that have a truth, and how many others were false."""
    with tempfile.TemporaryDirectory() as folder, MapStore.open(Path(folder) / "room.sqlite") as store:
        world = play(session, store, 1)
    loops = list(world.mapper.atlas.graph.edges.loops.values())
    names = {key.agent: world.mapper.agent_name(key.agent) for loop in loops for key in loop.keyframes}
    truths = {name: read_tum(session.folder / "truth" / f"{name}.tum") for name in names.values()}

    def pose(key: KeyframeKey) -> F64 | None:
        known, T = interpolate(*truths[names[key.agent]], np.array([world.stamps_ns[key]], np.int64))
        return T[0] if known[0] else None

    out, false_count = [], 0
    for loop in loops:
        a, b = pose(loop.a), pose(loop.b)
        if a is None or b is None:
            continue
        kinds = "-".join(sorted(session.agents[names[key.agent]].kind for key in (loop.a, loop.b)))
        own = "own" if loop.a.agent == loop.b.agent else "other"
        one = TrueLoop(str(session.folder), loop, se3.inverse(a) @ b, f"{kinds} {own}")
        is_false = np.linalg.norm(one.error[3:]) > _FALSE_M
        false_count += bool(is_false)
        out += [] if is_false else [one]
    return out, false_count


def errors(name: str, loops: Sequence[TrueLoop]) -> LoopErrors:
    """Return the figures of a group of loops."""
    error_mm = [1e3 * np.linalg.norm(one.error[3:]) for one in loops]
    sigma_mm = [1e3 * se3.position_sigma(one.loop.cov) for one in loops]
    nees = [one.nees for one in loops]
    figures = np.median(error_mm), np.quantile(error_mm, 0.9), np.median(sigma_mm), np.median(nees)
    return LoopErrors(name, len(loops), *map(float, (*figures, np.mean(nees), np.quantile(nees, 0.9))))


@dataclass(frozen=True, eq=False)
class _Seen:
    """A loop as seen from one of its keyframes: the other one, its pose there, and the whitened error."""

    other: KeyframeKey
    position: F64
    whitened: F64


def pairs_by_distance(loops: Sequence[TrueLoop]) -> list[tuple[float, F64, F64]]:
    """Return for each two loops of one keyframe with one agent how far apart (m) their other ends are, and
    their whitened errors (6,)."""
    seen: dict[tuple[str, KeyframeKey, str], list[_Seen]] = {}
    for one in (one for one in loops if one.nees < _MAX_NEES):
        a, b, cov = one.loop.a, one.loop.b, one.loop.cov
        Ad = se3.adjoint(one.true)
        from_a = _Seen(b, one.true[:3, 3], _whiten(Ad @ cov @ Ad.T, Ad @ one.error))
        from_b = _Seen(a, se3.inverse(one.true)[:3, 3], _whiten(cov, -one.error))
        seen.setdefault((one.session, a, b.agent), []).append(from_a)
        seen.setdefault((one.session, b, a.agent), []).append(from_b)
    return [
        (float(np.linalg.norm(x.position - y.position)), x.whitened, y.whitened)
        for group in seen.values()
        for x, y in itertools.combinations(group, 2)
    ]


def _whiten(cov: F64, error: F64) -> F64:
    variances, axes = np.linalg.eigh(cov)
    return np.asarray(axes @ ((axes.T @ error) / np.sqrt(variances)))


def correlation(name: str, pairs: Sequence[tuple[float, F64, F64]]) -> Correlation:
    """Return how the errors of these pairs correlate."""
    first, second = (np.array([pair[side] for pair in pairs]) for side in (1, 2))

    def of(part: slice) -> float:
        x, y = first[:, part], second[:, part]
        return float((x * y).sum() / np.sqrt((x * x).sum() * (y * y).sum()))

    return Correlation(name, len(pairs), of(slice(0, 6)), of(slice(0, 3)), of(slice(3, 6)))


def groups(loops: Sequence[TrueLoop]) -> list[LoopErrors]:
    """Return the figures of all loops, by range and by kind."""
    out = [errors("all", loops)] if loops else []
    for low, high in itertools.pairwise(_RANGES_M):
        if near := [one for one in loops if low <= one.range_m < high]:
            out.append(errors(f"{low} to {high} m", near))
    return out + [
        errors(k, [one for one in loops if one.kinds == k]) for k in sorted({one.kinds for one in loops})
    ]


def correlations(loops: Sequence[TrueLoop]) -> list[Correlation]:
    """Return the correlations by the distance of the other ends."""
    pairs, out = pairs_by_distance(loops), []
    for low, high in itertools.pairwise(_APART_M):
        if near := [pair for pair in pairs if low <= pair[0] < high]:
            out.append(correlation(f"other ends {low} to {high} m apart", near))
    return out


_ERROR_TITLES = "loops", "count", "mm p50", "mm p90", "sigma mm", "NEES p50", "NEES mean", "NEES p90"
_PAIR_TITLES = "two loops of one keyframe", "pairs", "correlation", "rotation", "position"


def _print_table(titles: Sequence[str], rows: Sequence[LoopErrors | Correlation]) -> None:
    print(line(titles), line(["---"] * len(titles)), sep="\n")
    for row in rows:
        print(line([f"{x:.2f}" if isinstance(x, float) else str(x) for x in asdict(row).values()]))
    print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sessions", nargs="+", type=Path, metavar="SESSION")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    loops, false_count = [], 0
    for folder in options.sessions:
        found, false = true_loops(read_session(folder))
        loops += found
        false_count += false
    tables = groups(loops), correlations(loops)
    _print_table(_ERROR_TITLES, tables[0])
    _print_table(_PAIR_TITLES, tables[1])
    print(f"{false_count} loops off by more than {_FALSE_M} m")
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for table in tables for row in table], indent=2))


if __name__ == "__main__":
    sys.exit(exit_code("measure_loops", main))
