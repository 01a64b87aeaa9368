"""Corrections of one edge with many agents, in virtual time: real agents, edge, mapper and solver.

    python tools/experiments/simulate_load.py SESSION [--agents 3 8 24] [--seconds 30] [--policy share] \\
        [--seed 0] [--link wifi5] [--json FILE]

The agents replay the keyframes of an emulated session (`replayed_agents`). The work of mapper and solver,
each in a process of its own, takes the CPU time that it takes on this machine; other delays are drawn. Busy
neighbours make CPU time up to half as long again: compare runs side by side. The first 10 s do not count.
Prints a Markdown table: from a keyframe's frame to the correction that answers it, ms; keyframes at the
edge a second, and of these the share looked up and answered; load of mapper and solver; the mapper's CPU
time a keyframe, ms, and by kind of work; maps at the end.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from replayed_agents import ReplayedAgent, Track, track_session  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import POLICY_NAMES, STREAMED, Config, with_policy  # noqa: E402
from share.lab.evaluate.emulated_network import LinkAssignment  # noqa: E402
from share.lab.evaluate.processing_delays import ProcessingDelays  # noqa: E402
from share.lab.evaluate.simulation import Simulation  # noqa: E402
from share.mapping.corrections import MapEvent  # noqa: E402
from share.metrics.frame_log import summary  # noqa: E402
from share.recordings.session import read_session  # noqa: E402

HEAD = ["agents", "corrections: p50, p95 ms", "keyframes a second", "looked up", "answered", "mapper"]
HEAD += ["solver", "mapper ms a keyframe", "by step", "maps"]
_COUNTED_FROM_S = 10.0

Row = dict[str, Any]


class ChargedSimulation(Simulation):
    """A simulation in which the work of mapper and solver takes the CPU time that it takes here. cpu_ms: by
    kind of work."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.cpu_ms: defaultdict[str, list[float]] = defaultdict(list)
        super().__init__(*arguments, **named)

    def _charge(self, kind: str, work: Callable[[], Any]) -> tuple[Any, int]:
        """Return the result of `work`, or its exception, and the CPU time that it took, ns."""
        began_ns = time.process_time_ns()
        try:
            result = work()
        except Exception as error:
            result = error
        took_ns = time.process_time_ns() - began_ns
        self.cpu_ms[kind].append(1e-6 * took_ns)
        return result, took_ns

    def _charge_mapper(self, kind: str, work: Callable[[], Any]) -> tuple[Any, int]:
        result, took_ns = self._charge(kind, work)
        self.mapper_busy_ns += took_ns
        return result, took_ns

    def _run_mapper_round(self) -> None:
        self._is_busy = True
        map_events, spent_ns = list[MapEvent](), 0
        while self._inbox:
            _, action = self._inbox.popleft()
            found, took_ns = self._charge_mapper("add, apply", action)
            map_events += found
            spent_ns += took_ns
        self._start_solving(spent_ns)
        self.schedule(spent_ns, lambda: self._send_map_events(map_events))
        step, took_ns = self._charge_mapper("next", self.mapper.next_lookup)
        spent_ns += took_ns
        if step is None:
            self.schedule(spent_ns, self._mapper_idle)
            return
        result, took_ns = self._charge_mapper(step.kind, step.run)
        self.schedule(spent_ns + took_ns, lambda: self._step_done(step, result))

    def _step_done(self, step: Any, result: object) -> None:
        found, took_ns = self._charge_mapper("judge", partial(self.mapper.finish_step, step, result, 0.0))

        def go_on() -> None:
            self._send_map_events(found)
            self._run_mapper_round()

        self.schedule(took_ns, go_on)

    def _start_solving(self, after_ns: int) -> None:
        if (step := self.mapper.next_solve()) is not None:
            result, took_ns = self._charge("solve", partial(step.run, self._solver))
            self.solver_busy_ns += took_ns
            apply_result = partial(self.mapper.finish_step, step, result, 0.0)
            delay = self._delays.apply_solution  # not used
            self.schedule(after_ns + took_ns, lambda: self._send_to_mapper(delay, apply_result))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("session", type=Path, metavar="SESSION")
    parser.add_argument("--agents", nargs="+", type=int, default=[3, 8, 24])
    parser.add_argument("--seconds", type=float, default=30.0)
    policies = [policy for policy in POLICY_NAMES if policy != STREAMED]
    parser.add_argument("--policy", choices=policies, default="share")
    parser.add_argument("--link", default="wifi5")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    return exit_code("simulate_load", lambda: simulate(options))


def simulate(options: argparse.Namespace) -> None:
    """Simulate every number of agents."""
    tracks = track_session(read_session(options.session))
    config = Config()
    config = with_policy(config, options.policy)
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))), flush=True)
    rows = []
    for count in options.agents:
        rows.append(play(tracks, count, options.seconds, config, options.link, options.seed))
        print(line(cells_of(rows[-1])), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def play(tracks: list[Track], count: int, seconds: float, config: Config, link: str, seed: int) -> Row:
    """Simulate `count` agents and return the figures."""
    agents = [ReplayedAgent(tracks, index) for index in range(count)]
    links = LinkAssignment.parse(link)
    members = [(agent.hello, agent.frames(seconds), links.network_for(agent.hello.name)) for agent in agents]
    world = ChargedSimulation(config, members, ProcessingDelays(), seed)
    world.run(seconds + 1.0)
    report = world.edge.report(world.mapper.report())
    own = report["agents"].values()
    keyframes, skipped = (sum(agent[key] for agent in own) for key in ("keyframes", "queries_skipped"))
    late_ms, answered = list[float](), 0
    for log in world.logs.values():
        frames = log.frames()
        corrected_ms = frames.corrected_ms
        answered += int((corrected_ms > 0).sum())
        counted = corrected_ms[round(len(frames) * _COUNTED_FROM_S / seconds) :]
        late_ms += counted[counted > 0].tolist()
    mapper_ms = sum(sum(ms) for kind, ms in world.cpu_ms.items() if kind != "solve")
    return {
        "agents": count,
        "corrected_ms": summary(late_ms).report(),
        "keyframes_per_s": keyframes / seconds,
        "looked_up": 1 - skipped / keyframes,
        "answered": answered / keyframes,
        "mapper": 1e-9 * world.mapper_busy_ns / seconds,
        "solver": 1e-9 * world.solver_busy_ns / seconds,
        "mapper_ms": mapper_ms / keyframes,
        "steps": {
            kind: {"n": len(ms), "p50": float(np.median(ms)), "ms_per_keyframe": sum(ms) / keyframes}
            for kind, ms in sorted(world.cpu_ms.items())
        },
        "maps": len(report["maps"]),
        "loops": report["loops"],
    }


def cells_of(row: Row) -> list[str]:
    """Return the cells of a row."""
    ms = row["corrected_ms"]
    return [
        str(row["agents"]),
        f"{ms['p50']:.0f}, {ms['p95']:.0f}",
        f"{row['keyframes_per_s']:.1f}",
        *(f"{100 * row[key]:.0f} %" for key in ("looked_up", "answered")),
        *(f"{row[key]:.2f}" for key in ("mapper", "solver")),
        f"{row['mapper_ms']:.1f}",
        ", ".join(f"{kind} {step['ms_per_keyframe']:.1f}" for kind, step in row["steps"].items()),
        str(row["maps"]),
    ]


if __name__ == "__main__":
    sys.exit(main())
