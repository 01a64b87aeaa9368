"""Play a session in virtual time: each agent is tracked once, the rest runs in
`share.lab.evaluate.simulation`.

Tracker, agent and edge state machines and mapper are the real ones; odometry equals that of a real-time run
to the last digit. Processing delays are drawn (`ProcessingDelays`), so latencies do not depend on this
machine or its load, and a run is deterministic for a given seed.
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
from share.files.json_file import own_format_errors, read_json
from share.files.line_file import LineFile
from share.files.writing import atomic_write, writable_dir
from share.files.yaml_file import read_settings
from share.geometry.camera import Rig
from share.lab.evaluate.emulated_network import LinkAssignment, NetworkModel
from share.lab.evaluate.processing_delays import Delay, MeasuredDelay, ProcessingDelays
from share.lab.evaluate.real_time import MapMembership, Progress, RunOptions
from share.lab.evaluate.simulation import Simulation, TrackedFrame
from share.lab.evaluate.tracker_runs import strict_tracker
from share.metrics.local_error import LocalError
from share.odometry.error_model.network import open_error_model
from share.plain_data import to_mapping
from share.protocol import agent_events as ev
from share.recordings.session import Session, read_session
from share.runtime.error_estimators import (
    ErrorEstimator,
    GroundTruthError,
    NoErrorEstimate,
    SynchronousErrorModel,
)
from share.runtime.offline_tracking import OfflineFrame, track_frames
from share.runtime.pipeline import read_frames
from share.runtime.run_files import AgentFiles
from share.runtime.source import Source, open_source
from share.sensors.sequencer import SequencerCounters
from share.wire.messages import Hello

_DRAIN_S = 2.0  # after the last frame, for messages still under way
_SHOW_EVERY = 50  # frames of an agent
_TRUE_ERROR = "truth"


def play_in_virtual_time(
    session: Session, seconds: float, options: RunOptions, out: Path, show: Callable[[Progress], None]
) -> dict[str, Path]:
    """Play `session` as `share.lab.evaluate.real_time.played_in_real_time` does, with the same files but the
    processes' logs.

    Raises UsageError where a recording cannot be tracked or the policy is `streamed`.
    """
    settings = read_settings(Path(options.config)) if options.config else Config()
    settings = dataclasses.replace(settings, edge=dataclasses.replace(settings.edge, policy=options.policy))
    if options.policy == config.STREAMED:
        raise UsageError(
            "policy streamed cannot be played in virtual time: its agents do not track; leave out --virtual"
        )
    error_source = _TRUE_ERROR if options.true_error else settings.agent.error_model
    tracker_settings = settings.tracker, settings.inertial, settings.sequencer
    tracked = track_session(session.folder.resolve(), *tracker_settings, error_source)
    links = LinkAssignment.parse(options.link)
    links.check(session.agents, virtual=True)
    members = session_members(session, tracked, links)
    folders = {name: out / name for name in session.agents}
    observer = _RunWriter(folders, writable_dir(out / "edge"), show)
    costs = ProcessingDelays() if options.costs is None else read_delays(Path(options.costs))
    world = Simulation(
        settings,
        members,
        costs,
        options.seed,
        on_effect=observer.write_effect,
        on_record=observer.write_event,
    )
    world.run(seconds + _DRAIN_S)
    observer.finish(world, settings)
    return folders


def session_members(
    session: Session, tracked: Mapping[str, tuple[Rig, list[TrackedFrame]]], links: LinkAssignment
) -> list[tuple[Hello, Iterator[TrackedFrame], NetworkModel]]:
    """Return the agents of a simulation. tracked: as from `track_session`."""
    start_ns = min(frames[0].arrival_ns for _, frames in tracked.values() if frames)
    return [
        (
            Hello(name, agent.kind, number + 1, tracked[name][0]),
            _relative_frames(tracked[name][1], start_ns),
            links.network_for(name),
        )
        for number, (name, agent) in enumerate(session.agents.items())
    ]


@lru_cache(maxsize=1)  # policies follow each other on one session
def track_session(
    folder: Path,
    tracker: TrackerConfig,
    inertial: InertialConfig,
    sequencer: SequencerConfig,
    error_source: str,
    names: tuple[str, ...] | None = None,
) -> dict[str, tuple[Rig, list[TrackedFrame]]]:
    """Return rig and tracked frames of each agent, or of those named; `arrival_ns` is in the session's clock.

    `error_source`: where tracking errors come from: "truth", the file of an error model, or "" for none.
    """
    settings = Config(tracker=tracker, inertial=inertial, sequencer=sequencer)
    session = read_session(folder)
    return {
        name: track_agent(open_source(f"{folder}/{name}"), settings, agent.clock_offset_ns, error_source)
        for name, agent in session.agents.items()
        if names is None or name in names
    }


def track_agent(
    source: Source, settings: Config, clock_offset_ns: int, error_source: str
) -> tuple[Rig, list[TrackedFrame]]:
    """Return the rig and the tracked frames of a recording. error_source: as of `_track_all`."""
    tracker, errors = strict_tracker(source, settings), _error_estimator(source, error_source)
    frames = [
        tracked_frame(step, clock_offset_ns)
        for step in track_frames(read_frames(source, settings, SequencerCounters()), tracker, errors)
    ]
    return source.rig, frames


def tracked_frame(step: OfflineFrame, clock_offset_ns: int) -> TrackedFrame:
    """Return a frame with all that tracking made of it; it arrives when it is stamped."""
    return TrackedFrame(
        arrival_ns=step.frame.stamp_ns - clock_offset_ns,
        T_odom_body=step.result.T_odom_body,
        error_cm=step.error_cm,
        candidate=step.candidate,
        stamp_ns=step.frame.stamp_ns,
        state=step.result.state,
        new_segment=step.result.new_segment,
        cov=step.result.cov,
    )


def _error_estimator(source: Source, error_source: str) -> ErrorEstimator:
    truth = source.truth()
    if error_source == _TRUE_ERROR:
        return NoErrorEstimate() if truth is None else GroundTruthError(LocalError(truth))
    return SynchronousErrorModel(open_error_model(error_source)) if error_source else NoErrorEstimate()


def _relative_frames(frames: list[TrackedFrame], start_ns: int) -> Iterator[TrackedFrame]:
    """Yield the frames with `arrival_ns` relative to `start_ns`."""
    for frame in frames:
        yield dataclasses.replace(frame, arrival_ns=frame.arrival_ns - start_ns)


class _RunWriter:
    """Write the files that real agents and a real edge would write."""

    def __init__(self, folders: dict[str, Path], edge: Path, show: Callable[[Progress], None]) -> None:
        self._show, self._edge = show, edge
        self._files = {name: AgentFiles(folder, _ignore_full_disk) for name, folder in folders.items()}
        self._events = LineFile(edge / "events.jsonl", _ignore_full_disk)
        self._frames = dict.fromkeys(folders, 0)
        self._membership = MapMembership()
        self._corrections = 0

    def write_effect(self, name: str, effect: ev.AgentEffect) -> None:
        files = self._files[name]
        match effect:
            case ev.LocalisedPose():
                files.write_odom_pose(effect.stamp_ns, effect.T_odom_body)
                if effect.T_map_odom is not None and effect.map_id is not None:
                    files.write_map_pose(
                        effect.stamp_ns, effect.T_map_odom @ effect.T_odom_body, effect.map_id
                    )
            case ev.FrameDone():
                self._frames[name] += 1
                if self._frames[name] % _SHOW_EVERY == 0:
                    self._show_progress()

    def write_event(self, fields: dict[str, Any]) -> None:
        self._events.write(json.dumps(fields))
        if fields["event"] == "correction":
            self._membership.add_correction(fields["agent"], fields["map_id"])
            self._corrections += 1

    def finish(self, world: Simulation, settings: Config) -> None:
        """Write the reports. Raises ShareError if the disk was full."""
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

    def _show_progress(self) -> None:
        self._show(Progress(dict(self._frames), len(self._membership.sharing_agents), self._corrections))


def _ignore_full_disk(text: str) -> None:
    """Ignore a failed write: the file's `check` reports it at the end."""


# Delays measured in a real-time run, for runs in virtual time.

_DEFAULT_DELAYS = ProcessingDelays()
_SMALL_STEPS = "receive", "add", "check_loop", "apply_solution"
_ALIGN = "align_accepted", "align_refused"
_VERIFY_IMAGES = "verify_images_accepted", "verify_images_refused"
_IMAGE_STEPS = "describe", "index", *_ALIGN, *_VERIFY_IMAGES


def read_delays(run: Path) -> ProcessingDelays:
    """Read the delays of frames, solutions and the steps of look-ups from the reports in `run`, a folder of
    `share evaluate run`.

    Delays that are not measured are the defaults times a factor: the agent's keyframe work by that of frames,
    the edge's small steps by that of describing images, or of verifications in a run without images. Raises
    UsageError or DataError.
    """
    edge, agents = run / "edge" / "edge.json", sorted(run.glob("*/report.json"))
    if not edge.is_file() or not agents:
        raise UsageError(f"--costs {run}: not a folder of `share evaluate run`")
    with own_format_errors(run):
        return _read_delays(edge, agents)


def _read_delays(edge: Path, agents: Sequence[Path]) -> ProcessingDelays:
    edge_report = read_json(edge)
    frame = _mean_delay([read_json(path)["track_ms"] for path in agents], edge)
    query, verify, solve = (
        _mean_delay([edge_report.get(f"{kind}_ms", {})], edge) for kind in ("place", "verify", "solve")
    )
    agent_factor = frame.p50 / _DEFAULT_DELAYS.frame.p50
    describe, align = (edge_report.get(f"{kind}_ms", {}) for kind in ("describe", "align"))
    has_images = bool(describe.get("n"))
    edge_factor = verify.p50 / _DEFAULT_DELAYS.verify_accepted.p50
    if has_images:
        edge_factor = _mean_delay([describe], edge).p50 / _DEFAULT_DELAYS.describe.p50
    return replace(
        ProcessingDelays(
            **{
                name: _scaled(getattr(_DEFAULT_DELAYS, name), edge_factor)
                for name in (*_SMALL_STEPS, *_IMAGE_STEPS)
            }
        ),
        frame=frame,
        keyframe=_scaled(_DEFAULT_DELAYS.keyframe, agent_factor),
        finish_keyframe=_slower(_DEFAULT_DELAYS.finish_keyframe, agent_factor),
        query=query,
        verify_accepted=verify,
        verify_refused=verify,
        solve=solve,
        **(dict.fromkeys(_VERIFY_IMAGES, verify) if has_images else {}),
        **({"describe": _mean_delay([describe], edge)} if has_images else {}),
        **(dict.fromkeys(_ALIGN, _mean_delay([align], edge)) if align.get("n") else {}),
    )


def _mean_delay(summaries: Sequence[Mapping[str, Any]], where: Path) -> Delay:
    """Return the means of several summaries' percentiles."""
    known = [one for one in summaries if one.get("n")]
    if not known:
        raise DataError(f"{where}: has no measured delays; play a longer run")
    p50, p95 = (sum(float(one[name]) for one in known) / len(known) for name in ("p50", "p95"))
    return Delay(p50, p95)


def _scaled(cost: Delay, factor: float) -> Delay:
    return Delay(factor * cost.p50, factor * cost.p95)


def _slower(cost: Delay | MeasuredDelay, factor: float) -> Delay | MeasuredDelay:
    return (
        _scaled(cost, factor)
        if isinstance(cost, Delay)
        else MeasuredDelay(tuple(factor * ms for ms in cost.ms))
    )
