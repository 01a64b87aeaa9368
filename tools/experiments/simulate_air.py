"""Policies where all agents share the air of one access point, in virtual time with modelled mapping.

    python tools/experiments/simulate_air.py [--agents 12] [--air shared-5 shared-8] [--seeds 501:511] \\
        [--policies share covins-g fixed@1.5] [--halved 30:50] [--late 20] [--seconds 60] [--sigma] \\
        [--alone] [--set SECTION.NAME=VALUE] [--json FILE]

Two headsets per robot walk for a minute in a warehouse that grows with their number; frames at 30 Hz,
keyframes of 20 kB, 12 kB with small pictures. `fixed@HZ`: policy fixed at this rate, `fixed@HZqQ`: with
pictures of JPEG quality Q; `constant@A:R`: headsets send A, robots R keyframes a second with small pictures,
and as few poses as where `share` finds the air short; `random`: other gains by each seed. `--alone`: each
agent has an access point of its own, the most that any allocation of the air could reach. `--halved A:B`: the
air has half its rate from A to B s. `--late S`: the second half of the agents comes after S s. `--sigma`:
agents expect odometry's own sigma of their drift, in place of its true error of the last 5 s, the best that
an error model can tell. Prints two Markdown tables (`air_figures`): figures of each policy, means over seeds;
and in how many seeds the first policy is better than each other. How agents are served is sampled twice a
second from the agents themselves, from their first keyframe to the end, whether or not the edge hears of it:

* QoE of headsets and robots: mean, and the 5th percentile over a run's samples of all headsets; of the
  delay until corrections (a keyframe that is not acknowledged counts as late as it is) and the expected
  error. `by round trip`: of headsets, with round trip and processing as delay, or how long a keyframe has
  not been acknowledged, if longer: that of earlier figures.
* `factors`: of headsets' QoE, by the delay and by the error, means. `delay`: of headsets, mean, ms, until the
  acknowledgement, and from there to the correction.
* corrections of headsets, 95th percentile, ms; ages of a headset's newest correction, 95th percentile, and of
  its newest pose at the edge, 99th, s; when it is in a map with another agent, s after its start.
* Jain's index of headsets' QoE: 1 where all are served alike. Corrections a hundred frames of headsets: to
  send nothing would be best by the mean latency.
* error of poses in the shared map, cm rms (maps aligned to the truth once, for all agents in them); keyframes
  a second; all bytes of messages, both ways, kB/s; share of time in which the air is busy.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from air_figures import Row, print_tables  # noqa: E402
from keyframe_set import KeyframeSet  # noqa: E402
from measure_joins import configured  # noqa: E402
from modelled_mapper import ModelledMapper, RecognitionModel  # noqa: E402
from modelled_room import SIMULATED, frames_of_all, shared_errors, truth_of, which  # noqa: E402
from scarce_room import scarce_room  # noqa: E402
from tool_main import count, exit_code, positive, seed_range, time_range  # noqa: E402

from share.config import NEAR_M, Config, ControlConfig, with_policy  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.geometry.interpolation import Trajectory  # noqa: E402
from share.lab.evaluate.emulated_network import NetworkModel, load_network  # noqa: E402
from share.lab.evaluate.processing_delays import ProcessingDelays  # noqa: E402
from share.lab.evaluate.simulation import SimulatedRun, Simulation  # noqa: E402
from share.protocol import agent_events as ev  # noqa: E402
from share.protocol.agent import AgentProtocol  # noqa: E402
from share.scheduling.policies import AgentReport, Policy  # noqa: E402
from share.scheduling.qoe import QoeFactors, QoeParameters, qoe, qoe_factors  # noqa: E402
from share.scheduling.room_budget import RateGrant, scarce_grant  # noqa: E402
from share.types import AgentKind  # noqa: E402
from share.wire.messages import Evaluation  # noqa: E402

_SAMPLE_TICKS = 10  # of 50 ms


class SampledSimulation(Simulation):
    """A simulation that samples how agents are served. samples: by agent, (t_s, delay, round trip and
    processing, ms, error, cm, rate, Hz or NaN, age of its newest correction, and of its newest pose at the
    edge, s, part of the delay after the acknowledgement, ms). shared_s: when each was first seen in a map
    with another. bytes: of all messages so far."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.samples: dict[str, list[tuple[float, ...]]] = {}
        self.arrivals_s: dict[str, float] = {}  # of agents that are late
        self._corrected_s: dict[str, float] = {}
        self.shared_s: dict[str, float] = {}
        self.bytes = 0
        self._ticks = 0
        super().__init__(*arguments, **{**named, "on_effect": self._note})

    def _note(self, name: str, effect: ev.AgentEffect) -> None:
        if isinstance(effect, ev.CorrectionApplied) and effect.corrected_ms is not None:
            self._corrected_s[name] = 1e-9 * self.now_ns

    def _tick(self) -> None:
        self._ticks += 1
        if self._ticks % _SAMPLE_TICKS == 0:
            poses = self.edge.latest_poses()
            stamps_ns = {key.rpartition("-")[0]: pose.stamp_ns for key, pose in poses.items()}
            for member in self._members.values():
                if (found := member.machine.evaluation(-1, self.now_ns)) is not None:
                    self._sample(member, found, stamps_ns.get(member.name))
            self._note_shared_maps()
        super()._tick()

    def _sample(self, member: SimulatedRun, found: Evaluation, pose_ns: int | None) -> None:
        now_s, began_s = 1e-9 * self.now_ns, self.arrivals_s.get(member.name, 0.0)
        hz = member.machine.report()["rate_hz"]
        trip_ms = max(found.rtt_ms + found.track_ms, _waiting_ms(member.machine, self.now_ns))
        age_s = now_s - self._corrected_s.get(member.name, began_s)
        pose_s = now_s - (began_s if pose_ns is None else 1e-9 * pose_ns)
        answer_ms = member.machine._self_evaluation.delay._to_correction.ms or 0.0
        sampled = now_s, found.delay_ms, trip_ms, found.error_cm or math.nan, hz or math.nan, age_s, pose_s
        self.samples.setdefault(member.name, []).append((*sampled, answer_ms))

    def _note_shared_maps(self) -> None:
        maps = {member.name: member.machine.report()["map_id"] for member in self._members.values()}
        count = Counter(map_id for map_id in maps.values() if map_id is not None)
        for name, map_id in maps.items():
            if count[map_id] > 1:
                self.shared_s.setdefault(name, 1e-9 * self.now_ns)

    def _over_the_air(self, member: Any, station: str, size: int, done: Any) -> None:
        self.bytes += size
        super()._over_the_air(member, station, size, done)

    def _to_agent(self, member: Any, event: ev.AgentEvent) -> None:
        if 1e-9 * self.now_ns >= self.arrivals_s.get(member.name, 0.0):
            super()._to_agent(member, event)

    def call_at(self, t_s: float, action: Any) -> None:
        """Call `action` at a time of the simulation."""
        self.schedule(round(t_s * 1e9) - self.now_ns, action)


World = TypeVar("World", bound=SampledSimulation)


def _waiting_ms(agent: AgentProtocol, now_ns: int) -> float:
    """Return how long the oldest keyframe that is not acknowledged has been waiting."""
    return agent._self_evaluation.delay.waiting_ms(now_ns)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--agents", type=count, default=12)
    parser.add_argument("--air", nargs="+", default=["shared-5", "shared-8"])
    parser.add_argument("--seeds", type=seed_range, default="401:403", metavar="FIRST:END")
    parser.add_argument("--policies", nargs="+", default=["share", "covins-g", "fixed@1.5"])
    parser.add_argument("--halved", type=time_range, metavar="A:B")
    parser.add_argument("--late", type=positive, metavar="S")
    parser.add_argument("--seconds", type=positive, default=60.0)
    parser.add_argument("--sigma", action="store_true")
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return exit_code("simulate_air", lambda: simulate(options))


def simulate(options: argparse.Namespace) -> None:
    """Run every policy on every air, seed by seed."""
    configs = {policy: settings_of(policy, options.set) for policy in options.policies}
    terms = options.halved, options.late, options.sigma, options.alone
    for air in options.air:
        load_network(air)  # an unknown one is refused before rooms are made
    rows: list[Row] = []
    for seed in options.seeds:
        made = scarce_room(options.agents, seed, options.seconds)
        for air in options.air:
            for policy, config in configs.items():
                drawn = replace(config, control=replace(config.control, random_seed=seed))
                ran = play(made, drawn, air, seed, *terms, constant=constant_rates(policy))
                rows.append({"policy": policy, **ran})
                if options.json:
                    options.json.write_text(json.dumps(rows) + "\n")
    print_tables(rows)


def settings_of(text: str, settings: list[str]) -> Config:
    """Return the settings with a policy, such as `fixed@0.5`. Raises UsageError."""
    name, _, terms = text.partition("@")
    if constant_rates(text) is not None:
        return settings_of("share", settings)
    if name not in SIMULATED:
        raise UsageError(
            f"--policies {text}: expected one of {', '.join(SIMULATED)}, or fixed@HZ, constant@A:R"
        )
    hz, _, quality = terms.partition("q")
    given = {"fixed_rate_hz": hz, "fixed_jpeg_quality": quality}
    config = configured([*settings, *(f"control.{key}={value}" for key, value in given.items() if value)])
    return with_policy(config, name)


class ConstantRates(Policy):
    """Every agent of a kind has the same rate, small pictures, and few poses."""

    def __init__(self, config: ControlConfig, rates_hz: Mapping[AgentKind, float]) -> None:
        super().__init__(config)
        self._rates_hz = rates_hz

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant:
        return scarce_grant(kind, self._rates_hz[kind])

    def evaluate(self, agent: str, report: AgentReport) -> RateGrant:
        return scarce_grant(report.kind, self._rates_hz[report.kind])


def constant_rates(text: str) -> dict[AgentKind, float] | None:
    """Return the rates of `constant@A:R`, Hz; None for another policy. Raises UsageError."""
    name, _, terms = text.partition("@")
    if name != "constant":
        return None
    try:
        of_headsets, of_robots = map(float, terms.split(":"))
    except ValueError:
        raise UsageError(f"--policies {text}: expected constant@A:R, two rates in Hz") from None
    return {AgentKind.AR: of_headsets, AgentKind.ROBOT: of_robots}


def begin(
    kind: type[World],
    made: KeyframeSet,
    config: Config,
    air: str,
    seed: int,
    by_sigma: bool = False,
    is_alone: bool = False,
) -> tuple[World, dict[str, Trajectory], float]:
    """Return a simulation before its first event, the truth of its keyframes, and its duration, s. by_sigma:
    agents do not know odometry's error. is_alone: each has an access point of its own."""
    seen, truth, seconds = frames_of_all(made, seed)
    if by_sigma:
        seen = [(replace(frame, error_cm=None) for frame in frames) for frames in seen]
    known = truth_of(made, NEAR_M, config.control.far_m)
    mapper = ModelledMapper(config, known, which(truth), RecognitionModel(), seed)
    networks = [_own(load_network(air), k if is_alone else 0) for k in range(len(seen))]
    hellos = [agent.hello for agent in made.agents.values()]
    members = list(zip(hellos, seen, networks, strict=True))
    return kind(config, members, ProcessingDelays(), seed, mapper), truth, seconds


def _own(network: NetworkModel, number: int) -> NetworkModel:
    """Return the network of a further access point: one with equal parameters would be the same."""
    if network.air is None or not number:
        return network
    return replace(network, air=replace(network.air, loss=network.air.loss + 1e-9 * number))


def play(
    made: KeyframeSet,
    config: Config,
    air: str,
    seed: int,
    halved: tuple[float, float] | None = None,
    late_s: float | None = None,
    by_sigma: bool = False,
    is_alone: bool = False,
    constant: Mapping[AgentKind, float] | None = None,
) -> Row:
    """Simulate one run. constant: rates, in place of the policy's."""
    began = time.monotonic()
    who = list(made.agents.values())
    world, truth, seconds = begin(SampledSimulation, made, config, air, seed, by_sigma, is_alone)
    if constant is not None:
        world.edge._rate_scheduler.policy = ConstantRates(config.control, constant)
    if halved is not None:
        _halve(world, *halved)
    if late_s is not None:
        world.arrivals_s = dict.fromkeys(list(made.agents)[len(who) // 2 :], late_s)
    world.run(seconds)
    return {
        "air": air,
        "seed": seed,
        "seconds": seconds,
        "agents": {a.hello.name: _agent_row(world, a.hello.name, config) for a in who},
        "error_cm": shared_errors(world.localised, truth),
        "busy": sum(one.busy_ns for one in world.airs.values()) / world.now_ns / len(world.airs),
        "bytes": world.bytes,
        "maps": len({own["map_id"] for own in world.mapper.report()["agents"].values()}),
        "mapper": world.mapper_busy_ns / world.now_ns,
        "took_s": time.monotonic() - began,
    }


def _halve(world: SampledSimulation, begin_s: float, end_s: float) -> None:
    for air in world.airs.values():
        world.call_at(begin_s, lambda air=air: setattr(air, "mbps", air.mbps / 2))
        world.call_at(end_s, lambda air=air: setattr(air, "mbps", air.mbps * 2))


def _agent_row(world: SampledSimulation, name: str, config: Config) -> Row:
    kind = AgentKind.AR if name.startswith("ar") else AgentKind.ROBOT
    terms = QoeParameters.from_config(config.control, kind)
    samples = np.array(world.samples.get(name, [])).reshape(-1, 8)
    corrected_ms = world.logs[name].frames().corrected_ms
    columns = zip(*samples.T.tolist(), strict=True)
    factors, by_trip = list[QoeFactors](), list[float]()
    for _, delay_ms, trip_ms, error_cm, *_ in columns:
        factors.append(qoe_factors(delay_ms, _known(error_cm), terms))
        by_trip.append(qoe(trip_ms, _known(error_cm), terms))
    return {
        "qoe": [math.prod(each) for each in factors],
        "qoe_by_round_trip": by_trip,
        "qoe_of_delay": [each.delay for each in factors],
        "qoe_of_error": [each.error for each in factors],
        "t_s": samples[:, 0].tolist(),
        "delay_ms": samples[:, 1].tolist(),
        "answer_ms": samples[:, 7].tolist(),
        "expected_cm": samples[:, 3].tolist(),
        "rate_hz": samples[:, 4].tolist(),
        "age_s": samples[:, 5].tolist(),
        "pose_s": samples[:, 6].tolist(),
        "shared_s": world.shared_s.get(name, math.inf) - world.arrivals_s.get(name, 0.0),
        "corrected_ms": corrected_ms[corrected_ms > 0].tolist(),
        "sent": world.reports()[name]["sent"],
        "frames": len(world.logs[name].frames().corrected_ms),
    }


def _known(error_cm: float) -> float | None:
    return None if math.isnan(error_cm) else error_cm


if __name__ == "__main__":
    sys.exit(main())
