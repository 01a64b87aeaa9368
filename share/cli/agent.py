"""`share agent`: track one agent at sensor rate and connect it to an edge."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import camera_options, options, room_options
from share.cli.terminal import LiveLine
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.cameras.feed import CameraFeed
    from share.config import Config
    from share.net.keys import AgentKeys
    from share.net.transport import AgentLink
    from share.runtime.agent import AgentRun, LiveStatus
    from share.runtime.error_estimators import ErrorEstimator
    from share.runtime.source import Source
    from share.types import AgentKind


@click.command()
@click.argument("source")
@click.option("--name", metavar="NAME", required=True, help="Name of this agent, unique at its edge.")
@click.option(
    "--kind",
    type=click.Choice(["ar", "robot"]),
    help="Kind of agent, by which the edge rates its service: ar (headset) or robot.  "
    "[default: the role in --profile]",
)
@click.option("--edge", "address", metavar="tcp://H:P", required=True, help="Address of the edge.")
@options.keys
@room_options.server_key
@click.option(
    "--link",
    metavar="NAME|FILE",
    help="Emulate a network to the edge: wifi5 (an access point alone), wifi-busy (shared with many devices) "
    "or a YAML file (docs/do/network.md).",
)
@click.option("--link-seed", type=int, default=0, help="Seed of the emulated network's delays and losses.")
@click.option("--streamed", is_flag=True, help="Send raw frames and let the edge track (policy streamed).")
@click.option(
    "--true-error", is_flag=True, help="Report the error against ground truth to the edge, for experiments."
)
@options.calib
@options.frames
@camera_options.camera_options
@click.option(
    "--out",
    metavar="DIR",
    type=options.PATH,
    help="Folder for odom.tum, map.tum, latency.csv and report.json.",
)
@click.option(
    "--poses",
    metavar="udp://H:P|ws://H:P",
    multiple=True,
    help="Send every pose to a program at this address by UDP, or serve them there by WebSocket "
    "(docs/do/integrate.md). May be repeated.",
)
@click.option(
    "--poses-origin",
    "origins",
    metavar="URL",
    multiple=True,
    help="A web page that may read --poses ws://…, such as https://app.example. May be repeated.",
)
@options.config
@options.verbose
@options.as_json
def agent(
    source: str,
    name: str,
    kind: str | None,
    address: str,
    keys: Path | None,
    server_key: str | None,
    link: str | None,
    link_seed: int,
    streamed: bool,
    true_error: bool,
    calib: str | None,
    frames: slice | None,
    camera: camera_options.CameraOptions,
    out: Path | None,
    poses: tuple[str, ...],
    origins: tuple[str, ...],
    config_file: Path | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Track one agent at sensor rate, send keyframes to an edge, and apply its corrections.

    SOURCE is a recording, played at its own rate, or a camera (realsense[:SERIAL]), until Ctrl-C.

    The agent never waits for the edge: without it, odometry goes on unchanged, and the agent connects as
    soon as the edge answers. Exit code 1 if it never answers.

    \b
    Example:  share agent rec/kitchen --name ann --kind ar --edge tcp://127.0.0.1:5555 --out out/ann
    """
    settings = options.load_config(config_file)
    from share.runtime.agent import AgentRun
    from share.runtime.pose_feed import open_pose_sinks
    from share.runtime.signals import stop_on_signal
    from share.wire.messages import Hello

    if streamed and true_error:
        raise UsageError("--true-error does not go with --streamed, where the edge tracks; leave out one")
    agent_kind = _agent_kind(kind, camera.profile_name)
    run_id = secrets.randbits(63)
    connect_link = _connector(address, run_id, room_options.read_keys(keys, server_key))
    if link is not None:
        connect_link = _emulated_link(connect_link, link, link_seed)
    live_line = _AgentLine(streamed)
    opened = camera_options.open_source(source, calib, frames, camera, live_line.print_line)
    live_line.watch_source(opened)
    options.print_notes(opened)
    hello = Hello(options.agent_name(name), agent_kind, run_id, opened.rig, streamed)
    errors = None if streamed else _error_estimator(opened, settings, true_error, live_line.print_line)
    sinks = open_pose_sinks(poses, hello.name, origins, live_line.print_line)
    shown = live_line.print_line, live_line.show, verbose
    run = AgentRun(opened, hello, settings, connect_link, out, *shown, errors, sinks)
    with stop_on_signal(run.stop):
        run.run()
    live_line.end()
    options.print_losses(opened)
    click.echo(json.dumps(run.report) if as_json else _summary(run))
    if (warning := unacknowledged_text(run, hello.name, settings.agent.finish_s)) is not None:
        live_line.print_line(warning)
        live_line.end()
    _check_answered(run, hello.name, address)


def _check_answered(run: AgentRun, name: str, address: str) -> None:
    """Raise ShareError if no edge has served the run."""
    if run.report["protocol"]["edge_sessions"]:
        return
    if (refusal := run.report["protocol"]["refusal"]) is not None:
        raise ShareError(f"the edge at {address} refuses '{name}': {refusal}")
    raise ShareError(f"no edge answered at {address}; {run.trouble or 'is `share edge` running there?'}")


def _agent_kind(kind_given: str | None, profile_name: str | None) -> AgentKind:
    """Return the kind given, or else the role in the profile. Raises UsageError, ConfigError."""
    from share.sensors.profile import load_host_profile
    from share.types import AgentKind

    role = kind_given or ("" if profile_name is None else load_host_profile(profile_name).role)
    if role not in set(AgentKind):
        raise UsageError(
            "--kind is required: ar (headset) or robot; or give a --profile with a role: d435i-n100-headset"
        )
    return AgentKind(role)


def _connector(address: str, run_id: int, keys: AgentKeys | None) -> Callable[[], AgentLink]:
    """Return a function that connects to the edge.

    Raises UsageError for an invalid address, or for one that needs keys.
    """
    from share.net.transport import check_keys, connect, parse_address

    check_keys(parse_address(address), keys)
    return partial(connect, address, run_id, keys)


def _error_estimator(
    source: Source, settings: Config, true_error: bool, print_line: Callable[[str], None]
) -> ErrorEstimator | None:
    """Return the estimator of the tracking error, None if it is off. Raises UsageError, DataError."""
    if true_error:
        return _true_error(source)
    from share.runtime.error_estimators import model_estimator

    return model_estimator(settings.agent.error_model, print_line)


def _true_error(source: Source) -> ErrorEstimator:
    """Return the error against ground truth. Raises UsageError if the source has no ground truth."""
    from share.metrics.local_error import LocalError
    from share.runtime.error_estimators import GroundTruthError

    truth = source.truth()
    if truth is None:
        raise UsageError(
            "--true-error: this source has no ground truth; SESSION/NAME keeps its own in truth/NAME.tum"
        )
    return GroundTruthError(LocalError(truth))


def _emulated_link(connect_edge: Callable[[], AgentLink], name: str, seed: int) -> Callable[[], AgentLink]:
    """Return `connect_edge` with an emulated network around its link. Raises UsageError, ConfigError."""
    from share.lab.evaluate.emulated_network import EmulatedLink, check_air_is_own, load_network

    link_network = load_network(name)
    check_air_is_own(name, link_network)
    return lambda: EmulatedLink(connect_edge(), link_network, seed)


class _AgentLine(LiveLine):
    """The live line of `share agent`; messages go on lines of their own."""

    def __init__(self, streamed: bool) -> None:
        super().__init__()
        self._streamed, self._total = streamed, 0
        self._feed: CameraFeed | None = None  # None for a recording

    def watch_source(self, source: Source) -> None:
        """Set the source whose progress is shown."""
        self._feed, self._total = getattr(source, "feed", None), source.images_count

    def show(self, status: LiveStatus) -> None:
        if not self.is_terminal or (status.frames % 5 and status.frames != self._total and not status.idle):
            return
        r = status.report()
        rtt = "  –  " if r["rtt_ms"] is None else f"{r['rtt_ms']:.1f} ms"
        counts = (
            f"streamed {r['streamed']} answered {r['answered']} dropped {r['drop_frame']} rtt {rtt}"
            if self._streamed
            else f"sent {r['sent']} acknowledged {r['acknowledged']} corrections {r['corrections']} "
            f"rtt {rtt} map {r['map_id'] or '–'}"
        )
        of = f"/{self._total}" if self._feed is None else ""
        self.write(
            f"{status.frames}{of} {status.state:4} {camera_options.camera_status_text(self._feed)}{counts}"
        )

    def print_line(self, text: str) -> None:
        super().print_line(f"share agent: {text}")


def _summary(run: AgentRun) -> str:
    r = run.report
    p95 = r["track_ms"]["p95"]
    traffic = f"{r['bytes_up'] / 1e6:.2f} MB up, {r['bytes_down'] / 1e6:.3f} MB down"
    lines = [f"{r['tracked']} of {r['frames']} frames tracked, lost for {r['lost_s']:.1f} s"]
    if "untracked" in r:
        lines += [f"{r['untracked']} more frames without an answer of the edge, {traffic}"]
    else:
        lines += [keyframes_text(r, traffic)]
    if r["dropped_late"]:
        lines.append(f"{r['dropped_late']} frames came too late to be tracked{_late_text(r)}")
    if r["late_frames"]:
        lines.append(f"{r['late_frames']} poses were late, by up to {r['max_late_s']:.1f} s")
    if p95 is not None:
        lines.append(f"pose after {r['track_ms']['p50']:.1f} ms (p95 {p95:.1f} ms)")
    if r["clock"]["uncertainty_ms"] is not None:
        lines.append(f"clock of the edge: {clock_text(r['clock'])}")
    return "\n".join([*lines, *camera_options.camera_summary(r)])


def _late_text(r: dict[str, Any]) -> str:
    """Return what became of late frames."""
    return " and were left out" if "untracked" in r else ": their poses are the IMU's predictions"


def keyframes_text(r: dict[str, Any], traffic: str) -> str:
    """Return how many keyframes were made, sent and acknowledged."""
    protocol, count = r["protocol"], r["keyframes"]
    if not protocol["edge_sessions"]:
        return f"no edge answered: {_count_text(count)} not sent"
    acknowledged = protocol["keyframes"] - protocol["unacknowledged"]
    sent = f"{protocol['sent']} sent, {acknowledged} acknowledged"
    return f"{_count_text(count)}: {sent}, {r['corrections']} corrections, {traffic}"


def unacknowledged_text(run: AgentRun, name: str, finish_s: float) -> str | None:
    """Return how many keyframes the edge did not acknowledge and why, as far as known; None if none."""
    protocol = run.report["protocol"]
    count = protocol["unacknowledged"]
    if not count or not protocol["edge_sessions"]:
        return None
    if protocol["refusal"] is not None:
        why = f"the edge refuses '{name}': {protocol['refusal']}"
    elif not protocol["connected"]:
        why = run.trouble or "the edge is silent"
    elif protocol["buffered_at_edge"]:
        why = (
            f"it received {protocol['buffered_at_edge']} of them but could not store them in its map file; "
            "see the edge's log"
        )
    else:
        why = f"no answer within agent.finish_s ({finish_s:g} s)"
    return f"the edge did not acknowledge {_count_text(count)}: {why}"


def _count_text(keyframes: int) -> str:
    return "1 keyframe" if keyframes == 1 else f"{keyframes} keyframes"


def clock_text(c: dict[str, Any]) -> str:
    uncertainty = f"±{c['uncertainty_ms']:.3g} ms"
    if c["is_reliable"]:
        return f"{c['offset_ms']:+.3f} ms from this machine's, {uncertainty}"
    bound = f"more than clock.claim_ms ({c['claim_ms']:g})"
    return f"offset too uncertain ({uncertainty}, {bound}); latencies use this machine's clock alone"
