"""A session in virtual time: what agents saw is tracked once, all else goes through `share.core.world`.

The tracker, the agents' and the edge's machines and the mapper are the real ones, and odometry is the same to
the last digit as in real time. How long things take is drawn (`Costs`), so that neither this machine nor what
else it does shows in a latency, and the same seed gives the same run.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from share import __version__, config
from share.config import Config, InertialConfig, SequencerConfig, TrackerConfig
from share.core import events as ev
from share.core.sequencer import SequencerCounters
from share.core.world import Costs, Seen, World
from share.errors import UsageError
from share.geometry.camera import Rig
from share.io.files import atomic_write, writable_dir
from share.io.line_file import LineFile
from share.io.network import error_model
from share.io.session import Session, read_session
from share.io.settings_file import read_settings
from share.io.source import Source, open_source
from share.io.transport.links import Links
from share.metrics.local_error import LocalError
from share.metrics.together import Together
from share.run.agent_files import AgentFiles
from share.run.costs import costs_of
from share.run.errors import AtOnce, ByTruth, Errors, Unknown
from share.run.pipeline import frames_of, tracker_for
from share.run.play import Progress, Terms
from share.strict import to_mapping
from share.wire.messages import Hello

_AFTER_S = 2.0  # for what is under way when the last frame has come
_SHOW_EVERY = 50  # frames of an agent
_BY_TRUTH = "truth"


def play_virtually(
    session: Session, seconds: float, terms: Terms, out: Path, show: Callable[[Progress], None]
) -> dict[str, Path]:
    """As `share.run.play.play`, with the same files; those of processes (logs) are not there.

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
