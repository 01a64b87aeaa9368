"""Pages on output files and the status page name every key that the code writes, and no other."""

from __future__ import annotations

import ast
import json
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args
from urllib.request import urlopen

import numpy as np
import pytest
from helpers.edge_in_process import Link, Thread
from helpers.edge_sim import Person, Town, walls
from helpers.hellos import hello_of
from helpers.plain_walk import RIG
from helpers.reports import headset_report
from prometheus_client.parser import text_string_to_metric_families

from share.cameras.live import LiveSource
from share.config import Config, EdgeConfig
from share.event_kinds import EventKind
from share.protocol.streaming import StreamingAgent
from share.recordings.losses import DataLosses
from share.runtime import edge, mapper_process
from share.runtime.edge import EdgeRun
from share.runtime.edge_metrics import METRICS, render_metrics
from share.runtime.frame_consumers import RemoteTracking
from share.runtime.offline_tracking import track
from share.runtime.status_server import StatusServer
from share.types import TrackState
from share.wire.messages import Evaluation, PoseUpdate, Status

ROOT = Path(__file__).resolve().parents[1]
FILES, STATUS = ((ROOT / "docs" / "lookup" / name).read_text() for name in ("files.md", "status.md"))
KEY = r"[a-z][a-z0-9_]*"


def section(page: str, title: str) -> str:
    """The text below the heading with this title, up to the next heading of its level."""
    found = re.search(rf"^(#+) `{re.escape(title)}`[^\n]*\n(.*?)(?=^\1 |\Z)", page, re.MULTILINE | re.DOTALL)
    assert found, f"no heading `{title}`"
    return found[2]


def codes(text: str) -> list[str]:
    return re.findall(r"`([^`\n]+)`", text)


def first_cells(text: str) -> list[str]:
    """Return the first cell of each row of all tables."""
    return re.findall(r"^\| *([^|]*`[^|]*)\|", text, re.MULTILINE)


def keys_in_tables(text: str) -> set[str]:
    """Names in first columns."""
    return {name for cell in first_cells(text) for name in codes(cell) if re.fullmatch(KEY, name)}


def keys_of(tree: Any) -> set[str]:
    """Keys of a mapping and of all mappings in it."""
    if not isinstance(tree, dict):
        return set()
    return set(tree).union(*map(keys_of, tree.values()))


# ---------------------------------------------------------------- events


def text_constants(files: Iterable[Path]) -> set[str]:
    """Texts in the code of these files, without docstrings."""
    nodes = [node for path in files for node in ast.walk(ast.parse(path.read_text()))]
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
    }


def test_events_are_those_that_the_code_writes() -> None:
    """That it writes no other is a matter of types (`make type`)."""
    writers = [*(ROOT / "share/protocol").glob("*.py"), *(ROOT / "share/mapping").rglob("*.py")]
    written = text_constants(
        [*writers, ROOT / "share/runtime/edge.py", ROOT / "share/runtime/served_room.py"]
    )
    assert [kind for kind in get_args(EventKind) if kind not in written] == []
    table = {name for cell in first_cells(section(FILES, "events.jsonl")) for name in codes(cell)}
    assert table == set(get_args(EventKind))


# ---------------------------------------------------------------- the edge


class Run:
    """A short run of an edge."""

    def __init__(self, out: Path, config: Config, messages: Iterable[tuple[int, Any]], is_over: Any) -> None:
        link: Any = Link(messages)
        run = EdgeRun(config, link, out, lambda fields: None)
        thread = threading.Thread(target=run.run)
        thread.start()
        try:
            deadline = time.monotonic() + 20
            while not is_over(run.report()):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            self.report = run.report()
            with closing(StatusServer("127.0.0.1:0", run.report, print)) as server:
                self.health = json.loads(urlopen(f"http://{server.endpoint}/health").read())
        finally:
            run.stop()
            thread.join(20)
        self.edge_json = json.loads((out / "edge.json").read_text())
        self.events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Ann and Bob in one map."""
    room = walls(1)
    town = Town([Person("ann", room, 0.0, 11), Person("bob", room, 0.1, 22)])
    town.walk(4)
    messages: list[tuple[int, Any]] = [(11, hello_of("ann", 11)), (22, hello_of("bob", 22))]
    messages += [(11, Evaluation(0, 20.0, 0.1)), (11, Status(TrackState.OK, 3.0, "", 0.0, 0.5))]
    messages.append((11, PoseUpdate(1, TrackState.OK, -1, np.eye(4), 5.0)))
    messages += [(run, k) for run, name in ((11, "ann"), (22, "bob")) for k in town.keyframes(name)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapper_process, "WorkerProcess", Thread)
        for module in (edge, mapper_process):
            patch.setattr(module, "_REPORT_S", 0.02)
        yield Run(tmp_path_factory.mktemp("run"), Config(), messages, lambda report: "last_solve_s" in report)


@pytest.fixture(scope="module")
def streamed_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    hello = replace(hello_of("ann", 11), streams_frames=True)
    config = Config(edge=EdgeConfig(policy="streamed"))
    return Run(
        tmp_path_factory.mktemp("streamed"), config, [(11, hello)], lambda report: report.get("agents")
    )


@pytest.mark.long
def test_keys_of_edge_json_are_those_that_the_code_writes(run: Run, streamed_run: Run) -> None:
    text = section(FILES, "edge.json")
    written = set(run.edge_json).union(streamed_run.edge_json, *run.edge_json["agents"].values())
    written |= set(streamed_run.edge_json["agents"]["ann"]) | set(run.edge_json["series"]["ann"])
    written |= set(run.edge_json["loops"]) | set(run.edge_json["merges"])
    assert len(run.edge_json["agents"]) == 2 and run.edge_json["merges"]["done"] > 0
    assert sorted(written - set(codes(text))) == []
    assert sorted(keys_in_tables(text) - written) == []


@pytest.mark.long
def test_fields_of_an_event_are_those_that_the_code_writes(run: Run) -> None:
    head = section(FILES, "events.jsonl").partition("\n|")[0]
    written = {"client"}.union(*run.events)  # of what clients do, of which this run has none
    assert {"correction", "maps merged"} <= {event["event"] for event in run.events}
    assert {name for name in codes(head) if re.fullmatch(KEY, name)} == written


@pytest.mark.long
def test_figures_of_an_agents_consistency_are_those_that_the_code_writes(run: Run) -> None:
    written = set(run.report["agents"]["ann"]["consistency"])
    text = STATUS.partition("## Consistency of agents\n")[2].partition("\n## ")[0]
    assert sorted(written - set(codes(text))) == []


# ---------------------------------------------------------------- status


@pytest.mark.long
def test_keys_of_health_are_those_that_the_code_writes(run: Run) -> None:
    assert keys_in_tables(section(STATUS, "/health")) == {*run.health, "loading"}  # it has loaded


@pytest.mark.long
def test_metrics_and_their_labels_are_those_that_the_code_writes(run: Run) -> None:
    site = {"rooms": {"lab": {"agents": 1, "keyframes": 2, "waiting": 0}}, "room_changes": 1}
    text = render_metrics(run.report | {"headset": headset_report()} | site)[0].decode()
    written: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(text):
        name = family.name + ("_total" if family.type == "counter" else "")
        written[name.removeprefix("share_edge_")] = {k for sample in family.samples for k in sample.labels}
    assert {spec.name.removeprefix("share_edge_") for spec in METRICS} <= set(written)
    page = section(STATUS, "/metrics")
    rows = [(codes(row.split("|")[1]), codes(row)) for row in re.findall(r"^\| *`.*$", page, re.MULTILINE)]
    assert {name for names, _ in rows for name in names} == set(written)
    assert {"agent", "kind"} <= set(codes(page))
    for names, words in rows:
        labels = set().union(*(written[name] for name in names)) - {"agent", "kind"}
        assert labels <= set(words), names


# ---------------------------------------------------------------- an agent


class Camera(LiveSource):
    """A live camera that gives nothing."""

    def __init__(self) -> None:
        self.serial, self.rig, self.name, self.losses = "0123", RIG, "camera", DataLosses()
        self.feed: Any = SimpleNamespace(report=dict)


def report_of_a_live_camera(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr("share.runtime.offline_tracking.read_frames", lambda *_, **__: iter(()))
    return track(Camera(), Config(), print).report


def report_of_a_streaming_agent() -> dict[str, Any]:
    protocol = StreamingAgent(hello_of("ann", 1), Config()).report()
    source: Any = SimpleNamespace()
    consumer = RemoteTracking(source, Config(), *(None,) * 3)  # type: ignore[arg-type]
    return consumer.report(protocol) | {"protocol": protocol}


@pytest.mark.long
def test_keys_of_report_json_are_those_that_the_code_writes(
    share: Callable[..., Any], plain_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, out = tmp_path / "quick.yaml", tmp_path / "out"
    config.write_text("link: {silent_s: 0.2}\nagent: {finish_s: 0.1, error_model: shipped}")
    source = ("--frames", "0:6", plain_session / "ar1")
    nobody = ("--edge", "tcp://127.0.0.1:9", "--name", "ann", "--kind", "ar")
    assert share("agent", *source, *nobody, "--config", config, "--out", out).code == 1
    assert share("track", *source, "--report", tmp_path / "r.json").code == 0
    reports = [json.loads(path.read_text()) for path in (out / "report.json", tmp_path / "r.json")]
    reports += [report_of_a_live_camera(monkeypatch), report_of_a_streaming_agent()]
    inner = [report[key] for report in reports for key in ("protocol", "imu_bias") if key in report]
    written = set().union(*reports, *inner, reports[0]["track_ms"], reports[0]["waiting_frames"])

    text = section(FILES, "report.json")
    assert sorted(written - set(codes(text))) == []
    named = keys_in_tables(text)
    for paragraph in re.findall(r"^`protocol`.*?(?=\n\n|\Z)", text, re.MULTILINE | re.DOTALL):
        named |= {name for name in codes(paragraph) if re.fullmatch(KEY, name)}
    others = {"session", "agent", "track"}  # a key of edge.json, commands
    assert sorted(named - written - others) == []

    header = (out / "latency.csv").read_text().splitlines()[0]
    assert keys_in_tables(section(FILES, "latency.csv")) == set(header.split(","))
