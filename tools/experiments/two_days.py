"""Two days of one emulated room against one map file: what the experiments on the next day share."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tool_main import line

from share.config import Config
from share.errors import UsageError
from share.lab.evaluate.emulated_network import LinkAssignment
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import Simulation
from share.lab.evaluate.virtual_time import track_session
from share.mapping.map_changes import StoredMap
from share.recordings.session import Session
from share.store.map_store import MapStore
from share.wire.messages import Hello

_DRAIN_S = 2.0


def play_days(first: Session, second: Session) -> tuple[StoredMap, StoredMap, Simulation]:
    """Play both against one map file, each with an edge of its own; return what the file holds after each,
    and the second day."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.sqlite"
        with MapStore.open(path) as store:
            _play(first, store, 1)
            kept = store.load()
        with MapStore.open(path) as store:
            world = _play(second, store, 101)
            return kept, store.load(), world


def _play(session: Session, store: MapStore, first_run: int) -> Simulation:
    """Play a session to its end against an edge that continues the map. first_run: number of a run."""
    settings = Config()
    tracked = track_session(
        session.folder.resolve(), settings.tracker, settings.inertial, settings.sequencer, ""
    )
    network = LinkAssignment.parse(None)
    start_ns = min(frames[0].arrival_ns for _, frames in tracked.values())
    end_ns = max(frames[-1].arrival_ns for _, frames in tracked.values())
    members = [
        (
            Hello(name, agent.kind, first_run + number, tracked[name][0]),
            (replace(frame, arrival_ns=frame.arrival_ns - start_ns) for frame in tracked[name][1]),
            network.network_for(name),
        )
        for number, (name, agent) in enumerate(session.agents.items())
    ]
    world = Simulation(settings, members, ProcessingDelays(), 1, store=store)
    world.run((end_ns - start_ns) * 1e-9 + _DRAIN_S)
    store.write([world.mapper.current_poses()])
    return world


def run_pairs(
    description: str, titles: Sequence[str], measure: Callable[[Path, Path], Iterable[Any]]
) -> None:
    """Measure the pairs of sessions of the command line, and print each result, a dataclass, as a row of a
    Markdown table."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sessions", nargs="+", type=Path, metavar="FIRST SECOND")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    if len(options.sessions) % 2:
        raise UsageError("give pairs of sessions: FIRST SECOND")
    print(line(titles), line(["---"] * len(titles)), sep="\n", flush=True)
    results = []
    for first, second in zip(options.sessions[::2], options.sessions[1::2], strict=True):
        for one in measure(first, second):
            results.append(asdict(one))
            print(line(map(_text, results[-1].values())), flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=2))


def _text(value: object) -> str:
    return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)
