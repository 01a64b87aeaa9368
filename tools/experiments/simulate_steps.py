"""Step tests of scheduling: the air halves for 20 s, half of the agents arrive at once, the edge pauses.

    python tools/experiments/simulate_steps.py [--agents 12] [--air shared-8 shared-15] [--seeds 601:604] \\
        [--steps halved arrivals paused] [--policy share] [--out FOLDER]

Rooms and agents as in simulate_air.py, a minute each. halved: from 20 to 40 s; its response, and that when
the air is back. arrivals: the second half of the agents starts at 20 s. paused: the edge handles nothing from
20 to 25 s; the response is to its end. Prints a Markdown table: median and largest over agents of a kind, of
the rate (tolerance one step of the budget, 0.25 Hz) and of the delay until corrections (tolerance 20 ms or a
quarter). --out: a picture for each step and air, and all samples as JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from scarce_room import scarce_room  # noqa: E402
from simulate_air import SampledSimulation, begin, settings_of  # noqa: E402
from step_response import StepResponse, step_response  # noqa: E402
from tool_main import count, exit_code, line, seed_range  # noqa: E402

from share.config import Config  # noqa: E402
from share.lab.evaluate.charts import draw_lines  # noqa: E402
from share.protocol import edge_events as ed  # noqa: E402
from share.types import F64  # noqa: E402

HEAD = ("air", "step", "of", "agents", "before", "final", "settles, s", "overshoot", "reversals")
STEP_S, BACK_S, PAUSE_S = 20.0, 40.0, 5.0
STEPS = ("halved", "arrivals", "paused")
_RATE_TOLERANCE_HZ = 0.25
_DELAY_TOLERANCE_MS, _DELAY_TOLERANCE = 20.0, 0.25

Row = dict[str, Any]


class SteppedSimulation(SampledSimulation):
    """A simulation in which the edge pauses."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self._paused_until_s = 0.0
        self._waiting: list[ed.EdgeEvent] = []
        super().__init__(*arguments, **named)

    def pause_edge(self, begin_s: float, end_s: float) -> None:
        """Let the edge handle nothing for a while; what comes waits."""
        self.call_at(begin_s, lambda: setattr(self, "_paused_until_s", end_s))
        self.call_at(end_s, self._go_on)

    def _go_on(self) -> None:
        waiting, self._waiting = self._waiting, []
        for event in waiting:
            self._to_edge(event)

    def _to_edge(self, event: ed.EdgeEvent) -> None:
        if 1e-9 * self.now_ns < self._paused_until_s:
            self._waiting.append(event)
        else:
            super()._to_edge(event)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--agents", type=count, default=12)
    parser.add_argument("--air", nargs="+", default=["shared-8", "shared-15"])
    parser.add_argument("--seeds", type=seed_range, default="601:602", metavar="FIRST:END")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS)
    parser.add_argument("--policy", default="share")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    return exit_code("simulate_steps", lambda: simulate(options))


def simulate(options: argparse.Namespace) -> None:
    """Run every step on every air, and print how rates and delays answer."""
    config, seeds = settings_of(options.policy, options.set), options.seeds
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    for air in options.air:
        for step in options.steps:
            runs = [play(step, air, config, options.agents, seed) for seed in seeds]
            for cells in rows_of(air, step, runs):
                print(line(cells), flush=True)
            if options.out:
                options.out.mkdir(parents=True, exist_ok=True)
                (options.out / f"{step}-{air}.json").write_text(json.dumps(runs) + "\n")
                draw(options.out / f"{step}-{air}.png", runs[0])


def play(step: str, air: str, config: Config, agents: int, seed: int) -> Row:
    """Return samples of one run: {agent: {"t_s", "rate_hz", "delay_ms"}}."""
    made = scarce_room(agents, seed)
    world, _, seconds = begin(SteppedSimulation, made, config, air, seed)
    if step == "halved":
        for one in world.airs.values():
            world.call_at(STEP_S, lambda one=one: setattr(one, "mbps", one.mbps / 2))
            world.call_at(BACK_S, lambda one=one: setattr(one, "mbps", one.mbps * 2))
    elif step == "arrivals":
        world.arrivals_s = dict.fromkeys(list(made.agents)[agents // 2 :], STEP_S)
    else:
        world.pause_edge(STEP_S, STEP_S + PAUSE_S)
    world.run(seconds)
    sampled = {name: np.array(rows).T.tolist() for name, rows in world.samples.items()}
    named = {name: {"t_s": c[0], "delay_ms": c[1], "rate_hz": c[4]} for name, c in sampled.items()}
    return {"step": step, "air": air, "seed": seed, "seconds": seconds, "agents": named}


def parts_of(step: str, seconds: float) -> dict[str, tuple[float, float]]:
    """Return the steps of a run: when each begins and when its response ends, s."""
    match step:
        case "halved":
            return {"halved": (STEP_S, BACK_S), "back": (BACK_S, seconds)}
        case "arrivals":
            return {"arrivals": (STEP_S, seconds)}
        case _:
            return {"after the pause": (STEP_S + PAUSE_S, seconds)}


def responses(run: Row, kind: str, quantity: str, step_s: float, end_s: float) -> list[StepResponse]:
    """Return the responses of a run's agents of a kind that were there before the step."""
    found = []
    for name, samples in run["agents"].items():
        t_s, values = np.array(samples["t_s"]), np.array(samples[quantity])
        known = np.isfinite(values)
        t_s, values = t_s[known], values[known]
        if name.startswith(kind) and (t_s < step_s).any():
            final = float(values[t_s > (step_s + 2 * end_s) / 3].mean())
            delay_tolerance = max(_DELAY_TOLERANCE_MS, _DELAY_TOLERANCE * final)
            tolerance = _RATE_TOLERANCE_HZ if quantity == "rate_hz" else delay_tolerance
            found.append(step_response(t_s, values, step_s, end_s, tolerance))
    return found


def rows_of(air: str, step: str, runs: list[Row]) -> list[list[str]]:
    """Return the rows of a table of all runs of a step."""
    rows = []
    for part, (step_s, end_s) in parts_of(step, runs[0]["seconds"]).items():
        for quantity, unit in (("rate_hz", "Hz"), ("delay_ms", "ms")):
            for kind in ("ar", "robot"):
                found = [one for run in runs for one in responses(run, kind, quantity, step_s, end_s)]
                rows.append([air, part, f"{quantity[:-3]}, {unit}", kind, *_cells(found)])
    return rows


def _cells(found: list[StepResponse]) -> list[str]:
    table = [asdict(one) for one in found]
    columns = {name: np.array([row[name] for row in table]) for name in table[0]} if table else {}

    def text(name: str, digits: int, most: bool = True) -> str:
        if name not in columns:
            return "–"
        median, largest = float(np.median(columns[name])), float(columns[name].max())
        return f"{median:.{digits}f}, {largest:.{digits}f}" if most else f"{median:.{digits}f}"

    return [
        text("before", 2, most=False),
        text("final", 2, most=False),
        text("settle_s", 1),
        text("overshoot", 2),
        text("reversals", 0),
    ]


def draw(path: Path, run: Row) -> None:
    """Draw rates and delays of all agents of a run over time."""

    def lines(kind: str, quantity: str) -> dict[str, tuple[F64, F64]]:
        of_kind = {n: a for n, a in run["agents"].items() if n.startswith(kind)}
        return {n: (np.array(a["t_s"]), np.array(a[quantity])) for n, a in of_kind.items()}

    panels = {
        f"{run['air']}, {run['step']}: rates of headsets": lines("ar", "rate_hz"),
        "rates of robots": lines("robot", "rate_hz"),
        "delay of headsets": lines("ar", "delay_ms"),
    }
    draw_lines(path, panels, "s", ["Hz", "Hz", "ms"])


if __name__ == "__main__":
    sys.exit(main())
