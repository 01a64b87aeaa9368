"""The runs of `share evaluate paper`: sessions, policies, gains; a quick form and the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from share.config import BASE_POLICY, STREAMED, Config
from share.lab.emulate.recipe import SessionRecipe
from share.lab.evaluate.campaign import PlannedRun, plan_policies
from share.lab.evaluate.real_time import RunOptions
from share.lab.evaluate.sweep import SweepAxis, grid, plan_sweep
from share.recordings.session import Session

BASE, OURS, THEIRS = BASE_POLICY, "share", "share-paper"
POLICIES = (BASE, OURS, THEIRS, "linear", "equal", "random")
LINK = "wifi5"
GAINS = (("kp", "ki"), ("kp", "kd"), ("ki", "kd"))  # of the heat maps: rows, columns
_FIRST_SEED = 50  # of the rooms, as in tools/experiments/make_sessions.py


@dataclass(frozen=True)
class PaperPlan:
    """sessions: recipes by name. gains: values of each. seeds: of link and scheduler. streamed: number of
    sessions that are streamed, in real time."""

    sessions: Mapping[str, SessionRecipe]
    gains: Mapping[str, Sequence[float]]
    seeds: int
    streamed: int


def _recipe(scene: str, number: int, seconds: float, fps: int) -> SessionRecipe:
    profile = {"": f"d435i:640x480@{fps}"}
    return SessionRecipe(scene, (f"paper:{number}",), seconds, _FIRST_SEED + number, profiles=profile)


_SCENES = ("warehouse", "firestation")
QUICK = PaperPlan(
    {"warehouse-2": _recipe("warehouse", 2, 20.0, 15)},
    {"kp": (0.2, 3.2), "ki": (0.0, 0.6), "kd": (0.0, 0.8)},
    seeds=1,
    streamed=1,
)
FULL = PaperPlan(
    {f"{scene}-{k}": _recipe(scene, k, 60.0, 30) for k in range(1, 6) for scene in _SCENES},
    {"kp": (0.2, 0.8, 3.2), "ki": (0.0, 0.15, 0.6), "kd": (0.0, 0.2, 0.8)},
    seeds=2,
    streamed=10,
)


@dataclass(frozen=True)
class PaperRuns:
    """All runs. compared: by the policies; streamed: raw frames, in real time; swept: by pair of gains, with
    the point of each."""

    compared: list[PlannedRun]
    streamed: list[PlannedRun]
    swept: dict[tuple[str, str], list[tuple[PlannedRun, tuple[str, ...]]]]

    @property
    def all(self) -> list[PlannedRun]:
        return [*self.compared, *self.streamed, *(run for runs in self.swept.values() for run, _ in runs)]


def axes_of(plan: PaperPlan, pair: tuple[str, str]) -> list[SweepAxis]:
    """Return the axes of a heat map."""
    return [
        SweepAxis((f"control.{name}",), tuple(f"{value:g}" for value in plan.gains[name])) for name in pair
    ]


def plan_runs(plan: PaperPlan, sessions: Sequence[Session], config: Config, out: Path) -> PaperRuns:
    """Return all runs on sessions. Gains are swept on the first, by the paper's own algorithm."""
    virtual = RunOptions("", link=LINK, virtual=True)
    compared = plan_policies(sessions, POLICIES, range(plan.seeds), virtual, out / "runs", config)
    live = RunOptions("", link=LINK)
    streamed = plan_policies(sessions[: plan.streamed], [STREAMED], [0], live, out / "runs", config)
    swept = {}
    for pair in GAINS:
        axes, terms = axes_of(plan, pair), RunOptions(THEIRS, link=LINK, virtual=True)
        folder = out / "gains" / "-".join(pair)
        swept[pair] = plan_sweep(sessions[:1], axes, grid(axes), range(1), terms, folder, config)
    return PaperRuns(compared, streamed, swept)
