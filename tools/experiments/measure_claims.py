"""Cost to others of an agent with inconsistent claims about itself: sets of keyframes in virtual time.

    python tools/experiments/measure_claims.py --scene firestation --motion walk: --motion walk: \\
        --motion walk: \\
        --seeds 14:15 --spacing-m 0.3 --spacing-rad 0.35 [--lies "scale 0.99 sure 10,…"] [--honest]

Takes the options of `make_keyframe_sets.py`; sets that it has not made are left out. The last agent makes a
false claim, see `LIES`. ATE is that of the other agents: `final` of their keyframes in the edge's final map,
`causal` of each keyframe as its agent was localised at that time; one alignment (SE3) per map. In brackets:
relative to the same session with an honest last agent, and without it. A run is a room of
`share.lab.evaluate.simulation` with policy covins-g, so everything is sent and every verified loop is judged.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_set import AgentKeyframes, KeyframeSet, Spacing, keyframe_set, place  # noqa: E402
from make_keyframe_sets import parser as set_parser  # noqa: E402
from make_keyframe_sets import recipe_of  # noqa: E402
from measure_joins import configured  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.errors import ShareError, UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.geometry.se3 import umeyama  # noqa: E402
from share.lab.evaluate.emulated_network import NETWORK_PRESETS  # noqa: E402
from share.lab.evaluate.kept_steps import KeptSteps  # noqa: E402
from share.lab.evaluate.processing_delays import ProcessingDelays  # noqa: E402
from share.lab.evaluate.simulation import Simulation, TrackedFrame  # noqa: E402
from share.mapping.corrections import MapEvent  # noqa: E402
from share.mapping.mapper import Mapper  # noqa: E402
from share.mapping.steps import Step, VerifyStep  # noqa: E402
from share.types import F64, OdometryKeyframe, View  # noqa: E402
from share.wire.messages import Hello, peer_id  # noqa: E402


@dataclass(frozen=True)
class Lie:
    """A false claim. path, depth: factors on its path and depths. sure: its sigmas are divided by this.
    turn_deg: error of its camera's rotation on the body. after_s: the claim is true until then, except for
    the camera. every_s: it restarts as another run of its name at this interval; 0: never."""

    path: float = 1.0
    depth: float = 1.0
    sure: float = 1.0
    turn_deg: float = 0.0
    after_s: float = 0.0
    every_s: float = 0.0


def _scale(factor: float, sure: float) -> Lie:
    return Lie(path=factor, depth=factor, sure=sure)


LIES = {
    **{
        f"scale {factor} sure {sure:g}": _scale(factor, sure)
        for factor in (1.005, 0.99, 1.02, 0.97, 1.05)
        for sure in (10.0, 100.0)
    },
    **{f"way 1.05 sure {sure:g}": Lie(path=1.05, sure=sure) for sure in (1.0, 10.0)},
    **{f"camera 5 deg sure {sure:g}": Lie(turn_deg=5.0, sure=sure) for sure in (1.0, 10.0)},
    **{f"sure {sure:g}": Lie(sure=sure) for sure in (3.0, 10.0)},
    **{
        f"scale {factor} sure 10 after 12 s": replace(_scale(factor, 10.0), after_s=12.0)
        for factor in (1.02, 1.05)
    },
    "way 1.05 sure 10 after 12 s": Lie(path=1.05, sure=10.0, after_s=12.0),
    **{
        f"scale {factor} sure 10 every {every:g} s": replace(_scale(factor, 10.0), every_s=every)
        for factor in (1.02, 1.05)
        for every in (4.0, 8.0)
    },
}
_GAP_S = 3.5  # between two runs of a name: a little longer than the edge holds a name


@dataclass
class Outcome:
    """Outcome for the honest agents of one run, cm and s. together: since when they are in one map; doubt:
    largest contradiction of one of them, separated at 1; wronged: whether two of them were ever separated."""

    final: float
    causal: float
    together: float | None
    doubt: float
    wronged: bool
    liar: str = ""
    said: list[str] = field(default_factory=list)


def claimed_runs(agent: AgentKeyframes, lie: Lie) -> list[tuple[Hello, list[TrackedFrame]]]:
    """Return hello and frames of each of its runs, with the claim applied; its frames are its keyframes."""
    first_ns, runs = agent.keyframes[0].stamp_ns, list[list[TrackedFrame]]()
    began_ns, T_odom = first_ns, np.eye(4)
    for n, keyframe in enumerate(agent.keyframes):
        since_s = (keyframe.stamp_ns - first_ns) * 1e-9
        if lie.every_s and (keyframe.stamp_ns - began_ns) * 1e-9 >= lie.every_s + _GAP_S:
            began_ns = keyframe.stamp_ns
        elif lie.every_s and (keyframe.stamp_ns - began_ns) * 1e-9 > lie.every_s:
            continue
        begins = keyframe.stamp_ns == began_ns
        if begins:
            runs.append([])
        now = lie if since_s >= lie.after_s else Lie()
        T = _longer(keyframe.T_ref_body, 1.0 if begins else now.path)
        T_odom = agent.T_odom_body[n] if begins else se3.orthonormal(T_odom @ T)
        view, image = keyframe.view, keyframe.image
        if now.depth != 1:
            view = View(view.uv, view.points * np.float32(now.depth), view.descriptors)
            image = replace(image, plane=image.plane / np.float32(now.depth))
        cov = keyframe.cov / now.sure**2
        candidate = OdometryKeyframe(T_odom, T, cov, keyframe.up, keyframe.up_sigma, view, begins, image)
        runs[-1].append(TrackedFrame(keyframe.stamp_ns, T_odom, candidate=candidate))
    hello = _turned(agent.hello, lie.turn_deg)
    return [(replace(hello, run_id=(hello.run_id + n) % 2**64), seen) for n, seen in enumerate(runs)]


class _ClaimsMapper(Mapper):
    """Records contradictions between agents. runs: run ids by agents' names."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.runs: dict[str, str] = {}
        self._doubts: dict[frozenset[str], float] = {}  # largest so far
        self._were_apart: set[frozenset[str]] = set()  # separated at any time

    def add_run(self, agent: str, hello: Hello) -> None:
        self.runs[hello.name] = agent
        super().add_run(agent, hello)

    def finish_step(self, step: Step, result: Any, ms: float) -> list[MapEvent]:
        map_events = super().finish_step(step, result, ms)
        if isinstance(step, VerifyStep):
            agreement = self.atlas.quarantine.agreement
            for names, compared in agreement.pairs.items():
                pair = frozenset(names)
                self._doubts[pair] = max(compared.severity, self._doubts.get(pair, 0.0))
                if agreement.are_separated(*names):
                    self._were_apart.add(pair)
        return map_events

    def doubt(self, of: Collection[str]) -> float:
        """Return the largest contradiction ever between two of these."""
        return max((doubt for pair, doubt in self._doubts.items() if pair <= set(of)), default=0.0)

    def wronged(self, honest: Collection[str]) -> bool:
        """Return whether two of these were ever separated."""
        return any(pair <= set(honest) for pair in self._were_apart)


class _Room(Simulation):
    """A simulation in which members are connected for a part of the time; they leave without a message."""

    kept_steps = KeptSteps()  # of all runs

    def __init__(self, spans_ns: Mapping[bytes, tuple[int, int]], *args: Any, **kwargs: Any) -> None:
        """spans_ns: connected from .. to, by peer; members without a span always are."""
        self._spans_ns = spans_ns
        super().__init__(*args, **kwargs)

    def _run_step(self, step: Any) -> object:
        return self.kept_steps.run(step)

    def _to_agent(self, member: Any, event: Any) -> None:
        begins_ns, ends_ns = self._spans_ns.get(member.peer, (0, self.now_ns))
        if begins_ns <= self.now_ns <= ends_ns:
            super()._to_agent(member, event)


def _longer(T: F64, by: float) -> F64:
    return se3.from_rt(T[:3, :3], by * T[:3, 3])


def _turned(hello: Hello, degrees: float) -> Hello:
    rig, axis = hello.rig, np.array([1.0, 2.0, 2.0]) / 3
    turn = se3.from_rt(se3.so3_exp(np.radians(degrees) * axis), np.zeros(3))
    return replace(hello, rig=replace(rig, T_body_cam0=se3.orthonormal(rig.T_body_cam0 @ turn)))


def played(made: KeyframeSet, lie: Lie | None, config: Config, seed: int = 0) -> Outcome:
    """Simulate the whole session; lie None: without the last agent."""
    *honest, liar = made.agents
    agents = [run for name in honest for run in claimed_runs(made.agents[name], Lie())]
    lies = [] if lie is None else claimed_runs(made.agents[liar], lie)
    agents += lies
    began_ns = min(seen[0].arrival_ns for _, seen in agents)
    ends_ns = max(seen[-1].arrival_ns for _, seen in agents)
    records: list[dict[str, object]] = []
    mapper = _ClaimsMapper(config)
    members = [
        (
            hello,
            iter([replace(s, arrival_ns=s.arrival_ns - began_ns) for s in seen]),
            NETWORK_PRESETS["wifi5"],
        )
        for hello, seen in agents
    ]
    spans_ns = {
        peer_id(hello.run_id): (seen[0].arrival_ns - began_ns, seen[-1].arrival_ns - began_ns + 200_000_000)
        for hello, seen in lies
        if len(lies) > 1
    }
    room = _Room(spans_ns, config, members, ProcessingDelays(), seed, mapper=mapper, on_record=records.append)
    room.run((ends_ns - began_ns) * 1e-9 + 3.0)
    apart = [
        r for r in records if r["event"] in ("agent quarantined", "agents disputed", "quarantine lifted")
    ]
    runs = mapper.runs
    judged = [runs[name] for name in (made.agents if lie == Lie() else honest)]
    report = room.edge.report(room.mapper.report())
    if report["failed_steps"]:
        raise ShareError(f"{report['failed_steps']} steps of the mapper failed")
    return Outcome(
        _final(made, mapper, {runs[name]: name for name in honest}),
        _causal(made, room, honest, began_ns),
        _together(room, honest),
        mapper.doubt(judged),
        mapper.wronged(judged),
        report["agents"][liar]["consistency"]["state"] if lie is not None else "",
        [f"{r['agent']} {r['event']}: {r['reason']}" for r in apart],
    )


# ---------------------------------------------------------------- errors


def _rmse_cm(groups: list[tuple[F64, F64]]) -> float:
    """Return the RMSE over maps of estimated and true positions (N, 3), each map aligned on its own."""
    gaps = [se3.transform(umeyama(a, b), a) - b for a, b in groups if len(a) >= 3]
    return 100 * float(np.sqrt((np.concatenate(gaps) ** 2).sum(1).mean())) if gaps else float("nan")


def _final(made: KeyframeSet, mapper: Mapper, honest: dict[str, str]) -> float:
    found = mapper.current_poses()
    by_map: dict[str, list[tuple[F64, F64]]] = {}
    for key, T, map_id in zip(found.keys, found.T_map_body, found.map_ids, strict=True):
        if key.agent in honest:
            true = made.agents[honest[key.agent]].T_world_body[key.id]
            by_map.setdefault(map_id, []).append((T[:3, 3], true[:3, 3]))
    return _rmse_cm([_stacked(pairs) for pairs in by_map.values()])


def _causal(made: KeyframeSet, room: Simulation, honest: Sequence[str], began_ns: int) -> float:
    by_map: dict[str, list[tuple[F64, F64]]] = {}
    for name in honest:
        agent = made.agents[name]
        at = {k.stamp_ns - began_ns: n for n, k in enumerate(agent.keyframes)}
        for frame in room.localised[name]:
            assert frame.T_map_odom is not None
            p = (frame.T_map_odom @ frame.T_odom_body)[:3, 3]
            true = agent.T_world_body[at[frame.stamp_ns], :3, 3]
            by_map.setdefault(str(frame.map_id), []).append((p, true))
    return _rmse_cm([_stacked(pairs) for pairs in by_map.values()])


def _stacked(pairs: list[tuple[F64, F64]]) -> tuple[F64, F64]:
    return np.array([p for p, _ in pairs]), np.array([q for _, q in pairs])


def _together(room: Simulation, honest: Sequence[str]) -> float | None:
    """Return since when all of them are in one map, s; None: they are not."""
    frames = sorted((f.stamp_ns, name, f.map_id) for name in honest for f in room.localised[name])
    now: dict[str, str | None] = {}
    since: float | None = None
    for stamp_ns, name, map_id in frames:
        now[name] = map_id
        if len(now) < len(honest) or len(set(now.values())) > 1:
            since = None
        elif since is None:
            since = stamp_ns * 1e-9
    return since


# ---------------------------------------------------------------- the table


def main(arguments: Sequence[str] | None = None) -> int:
    made = set_parser()
    made.description = __doc__
    made.add_argument("--lies", default=",".join(LIES), help="names in LIES, separated by commas")
    made.add_argument("--honest", action="store_true", help="no false claims; all agents count")
    made.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="of Config")
    made.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, a line a run")
    options = made.parse_args(arguments)
    return exit_code("measure_claims", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Raises UsageError where there is no set, or a claim is not known."""
    lies = [] if options.honest else options.lies.split(",")
    if unknown := [lie for lie in lies if lie not in LIES]:
        raise UsageError(f"'{unknown[0]}' is not known; known: {', '.join(LIES)}")
    config = configured([*options.set, 'edge.policy="covins-g"'])
    head = ["session", "the last agent", "final, cm", "causal, cm", "together, s", "it is", "doubt of others"]
    print("\n".join(line(cells) for cells in (head, ["---"] * len(head))), flush=True)
    some = False
    for name, made in _sets(options):
        some = True
        for row, outcome in _rows(name, made, lies, config):
            print(line(row), flush=True)
            if options.json:
                with options.json.open("a") as out:
                    out.write(json.dumps({"row": row, **asdict(outcome)}) + "\n")
    if not some:
        raise UsageError("there are no sets; make them with make_keyframe_sets.py first")


def _sets(options: argparse.Namespace) -> Iterator[tuple[str, KeyframeSet]]:
    every = Spacing(options.spacing_m, options.spacing_rad)
    for seed in options.seeds:
        recipe = recipe_of(options, seed)
        if place(recipe, every, options.cache).exists():
            yield f"{recipe.scene} {seed}", keyframe_set(recipe, every, options.cache)


def _rows(
    session: str, made: KeyframeSet, lies: Sequence[str], config: Config
) -> Iterator[tuple[list[str], Outcome]]:
    without, right = played(made, None, config), played(made, Lie(), config)
    yield _row(session, "is not there", without, []), without
    yield _row(session, "is honest", right, [without]), right
    for lie in lies:
        outcome = played(made, LIES[lie], config)
        yield _row(session, lie, outcome, [right, without]), outcome


def _row(session: str, what: str, o: Outcome, against: list[Outcome]) -> list[str]:
    final = f"{o.final:.2f}" + _ratios([o.final / other.final for other in against])
    causal = f"{o.causal:.2f}" + _ratios([o.causal / other.causal for other in against])
    together = "never" if o.together is None else f"{o.together:.1f}"
    return [session, what, final, causal, together, o.liar, f"{o.doubt:.2f}" + " WRONGED" * o.wronged]


def _ratios(ratios: list[float]) -> str:
    return f" ({', '.join(f'{ratio:.2f}' for ratio in ratios)})" if ratios else ""


if __name__ == "__main__":
    sys.exit(main())
