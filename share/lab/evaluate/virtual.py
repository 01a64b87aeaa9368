"""A session in virtual time: what agents saw is tracked once, all else goes through
`share.lab.evaluate.world`.

The tracker, the agents' and the edge's machines and the mapper are the real ones, and odometry is the same to
the last digit as in real time. How long things take is drawn (`Costs`), so that neither this machine nor what
else it does shows in a latency, and the same seed gives the same run.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from share import __version__, config
from share.config import Config, InertialConfig, SequencerConfig, TrackerConfig
from share.errors import DataError, UsageError
from share.files.json_file import as_we_write_it, read_json
from share.files.line_file import LineFile
from share.files.writing import atomic_write, writable_dir
from share.files.yaml_file import read_settings
from share.geometry.camera import Rig
from share.lab.evaluate.play import Progress, Terms
from share.lab.evaluate.together import Together
from share.lab.evaluate.world import Cost, Costs, Sampled, Seen, World
from share.metrics.local_error import LocalError
from share.net.emulated import Links
from share.odometry.error_model.network import error_model
from share.plain_data import to_mapping
from share.protocol import agent_events as ev
from share.recordings.session import Session, read_session
from share.runtime.agent_files import AgentFiles
from share.runtime.error_model import AtOnce, ByTruth, Errors, Unknown
from share.runtime.pipeline import frames_of, tracker_for
from share.runtime.source import Source, open_source
from share.sensors.sequencer import SequencerCounters
from share.wire.messages import Hello

_AFTER_S = 2.0  # for what is under way when the last frame has come
_SHOW_EVERY = 50  # frames of an agent
_BY_TRUTH = "truth"


def play_virtually(
    session: Session, seconds: float, terms: Terms, out: Path, show: Callable[[Progress], None]
) -> dict[str, Path]:
    """As `share.lab.evaluate.play.play`, with the same files; those of processes (logs) are not there.

    Raises UsageError where an agent's recording cannot be tracked or the policy is one that streams.
    """
    settings = read_settings(Path(terms.config)) if terms.config else Config()
    settings = dataclasses.replace(settings, edge=dataclasses.replace(settings.edge, policy=terms.policy))
    if terms.policy == config.STREAMED:
        raise UsageError("policy streamed is not played in virtual time: its agents do not track")
    told_by = _BY_TRUTH if terms.true_error else settings.agent.error_model
    parts = settings.tracker, settings.inertial, settings.sequencer
    tracked = _tracked(session.folder.resolve(), *parts, told_by)
    links = Links.parse(terms.link)
    links.check(session.agents)
    began_ns = min(looks[0].at_ns for _, looks in tracked.values() if looks)
    members = [
        (
            Hello(name, agent.kind, number + 1, tracked[name][0]),
            _coming(tracked[name][1], began_ns),
            links.network(name),
        )
        for number, (name, agent) in enumerate(session.agents.items())
    ]
    folders = {name: out / name for name in session.agents}
    observer = _Observer(folders, writable_dir(out / "edge"), show)
    costs = Costs() if terms.costs is None else costs_of(Path(terms.costs))
    world = World(settings, members, costs, terms.seed, watch=observer.watch, record=observer.record)
    world.run(seconds + _AFTER_S)
    observer.finish(world, settings)
    return folders


@lru_cache(maxsize=1)  # policies follow each other on one session
def _tracked(
    folder: Path, tracker: TrackerConfig, inertial: InertialConfig, sequencer: SequencerConfig, told_by: str
) -> dict[str, tuple[Rig, list[Seen]]]:
    """What each agent's frames came to, by name; they come in at the session's own times, ns. told_by: who
    says how wrong trackers are, the truth, a file with an error model, or nobody ("")."""
    settings = Config(tracker=tracker, inertial=inertial, sequencer=sequencer)
    session = read_session(folder)
    return {
        name: _track(open_source(f"{folder}/{name}"), settings, agent.clock_offset_ns, told_by)
        for name, agent in session.agents.items()
    }


def _track(source: Source, settings: Config, clock_offset_ns: int, told_by: str) -> tuple[Rig, list[Seen]]:
    tracker, errors = tracker_for(source, settings), _errors(source, told_by)
    seen = []
    for frame in frames_of(source, settings, SequencerCounters()):
        result = tracker.track(frame)
        error_cm = errors.after(frame, result)
        seen.append(
            Seen(
                at_ns=frame.stamp_ns - clock_offset_ns,
                T_odom_body=result.T_odom_body,
                error_cm=error_cm,
                candidate=errors.keyframe(frame, tracker) if result.keyframe else None,
                stamp_ns=frame.stamp_ns,
                state=result.state,
                breaks=result.new_stretch,
            )
        )
    return source.rig, seen


def _errors(source: Source, told_by: str) -> Errors:
    truth = source.truth()
    if told_by == _BY_TRUTH:
        return Unknown() if truth is None else ByTruth(LocalError(truth))
    return AtOnce(error_model(told_by)) if told_by else Unknown()


def _coming(looks: list[Seen], began_ns: int) -> Iterator[Seen]:
    """Counted from the first frame of all."""
    for look in looks:
        yield dataclasses.replace(look, at_ns=look.at_ns - began_ns)


class _Observer:
    """Writes what agents and edge would have written."""

    def __init__(self, folders: dict[str, Path], edge: Path, show: Callable[[Progress], None]) -> None:
        self._show, self._edge = show, edge
        self._files = {name: AgentFiles(folder, _full) for name, folder in folders.items()}
        self._events = LineFile(edge / "events.jsonl", _full)
        self._frames = dict.fromkeys(folders, 0)
        self._together = Together()
        self._corrections = 0

    def watch(self, name: str, effect: ev.AgentEffect) -> None:
        files = self._files[name]
        match effect:
            case ev.Localised():
                files.odom(effect.stamp_ns, effect.T_odom_body)
                if effect.T_map_odom is not None and effect.map_id is not None:
                    files.map(effect.stamp_ns, effect.T_map_odom @ effect.T_odom_body, effect.map_id)
            case ev.FrameDone():
                self._frames[name] += 1
                if self._frames[name] % _SHOW_EVERY == 0:
                    self._tell()

    def record(self, fields: dict[str, Any]) -> None:
        self._events.write(json.dumps(fields))
        if fields["event"] == "correction":
            self._together.corrected(fields["agent"], fields["map_id"])
            self._corrections += 1

    def finish(self, world: World, settings: Config) -> None:
        """The reports. Raises ShareError if the disk was full."""
        common = {"version": __version__, "config": to_mapping(settings)}
        for name, machine in world.reports().items():
            counted = {key: machine[key] for key in ("corrections", "bytes_up", "bytes_down")}
            unknown = dict.fromkeys(("cpu_ms_per_frame", "decode_ms_per_frame"))
            report = {**world.logs[name].report(), **unknown, **counted, "protocol": machine, **common}
            self._files[name].finish(world.logs[name], report)
            self._files[name].release()
        report = {**world.edge.report(world.mapper.report()), "series": world.edge.series()}
        self._events.close()
        atomic_write(self._edge / "edge.json", json.dumps(report, indent=2) + "\n")
        self._events.check()

    def _tell(self) -> None:
        self._show(Progress(dict(self._frames), len(self._together.agents), self._corrections))


def _full(text: str) -> None:
    """A file that could not be written is said by its `check`, at the end."""


# ---- How long things took in a run in real time, for runs in virtual time that are to be like it.

_USUAL = Costs()


def costs_of(run: Path) -> Costs:
    """By the reports in `run`, a folder by `share evaluate run`: frames, queries, verifications, solutions.

    What is not measured, keyframes' work at the agent and the edge's small steps, is as much slower or
    quicker than usual as frames and verifications are. Raises UsageError or DataError.
    """
    edge, agents = run / "edge" / "edge.json", sorted(run.glob("*/report.json"))
    if not edge.is_file() or not agents:
        raise UsageError(f"--costs {run}: is not a run by `share evaluate run`")
    with as_we_write_it(run):
        return _costs(edge, agents)


def _costs(edge: Path, agents: Sequence[Path]) -> Costs:
    told = read_json(edge)
    frame = _cost([read_json(path)["track_ms"] for path in agents], edge)
    query, verify, solve = (
        _cost([told.get(f"{kind}_ms", {})], edge) for kind in ("place", "verify", "solve")
    )
    here, there = frame.p50 / _USUAL.frame.p50, verify.p50 / _USUAL.accepted.p50
    return replace(
        Costs(**{name: _times(getattr(_USUAL, name), there) for name in ("front", "add", "judge", "apply")}),
        frame=frame,
        keyframe=_times(_USUAL.keyframe, here),
        settle=_slower(_USUAL.settle, here),
        query=query,
        accepted=verify,
        refused=verify,
        solve=solve,
    )


def _cost(summaries: Sequence[Mapping[str, Any]], where: Path) -> Cost:
    """Of several, the mean of their percentiles."""
    known = [one for one in summaries if one.get("n")]
    if not known:
        raise DataError(f"{where}: nothing was measured that costs could be taken from; play a longer run")
    p50, p95 = (sum(float(one[name]) for one in known) / len(known) for name in ("p50", "p95"))
    return Cost(p50, p95)


def _times(cost: Cost, factor: float) -> Cost:
    return Cost(factor * cost.p50, factor * cost.p95)


def _slower(cost: Cost | Sampled, factor: float) -> Cost | Sampled:
    return _times(cost, factor) if isinstance(cost, Cost) else Sampled(tuple(factor * ms for ms in cost.ms))
