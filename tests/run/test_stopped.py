"""A process that is stopped for ten seconds (SIGSTOP), as by a machine that swaps, and then goes on; and an
agent that is killed again and again: nothing is lost, and what is said meanwhile is true."""

from __future__ import annotations

import json
import os
import random
import signal
import time
import urllib.error
import urllib.request

import pytest
from helpers.children import Child, start_agent, start_edge
from helpers.crowd import crowd
from test_edge_killed import FOUND_S, check_map, family, start, until

pytestmark = pytest.mark.slow
STOPPED_S = 10.0


@pytest.mark.parametrize("victim", ["front", "mapper", "solver"])
def test_a_process_of_the_edge_is_stopped(tmp_path, victim):
    edge, address = start(tmp_path, "tcp://127.0.0.1:0")
    walkers = crowd(("ann", "bob"), address, frames=400)
    for walker in walkers:
        walker.start()
    for walker in walkers:
        until(f"{walker.name} is welcomed", lambda w=walker: w.lives)
    time.sleep(3.0)
    pid = family(edge.process.pid)[victim]
    os.kill(pid, signal.SIGSTOP)
    time.sleep(STOPPED_S)
    acknowledged = [walker.machine.report()["acknowledged"] for walker in walkers]
    os.kill(pid, signal.SIGCONT)
    for walker, before in zip(walkers, acknowledged, strict=True):
        until("it is acknowledged again", lambda w=walker, b=before: w.machine.report()["acknowledged"] > b)
    if victim != "front":  # they were served all the while
        assert min(acknowledged) > 15
    for walker in walkers:
        walker.finish()
    for walker in walkers:
        walker.join(FOUND_S)
        assert walker.error is None
        assert walker.machine.report()["pending"] == 0
    assert "mapper died" not in edge.said
    assert edge.interrupt() == 0
    check_map(tmp_path / "room.sqlite", walkers)


def test_an_agent_is_stopped(tmp_path, plain_session):
    edge, address = start_edge(tmp_path)
    agent = start_agent(tmp_path, "ann", plain_session / "ar1", address)
    edge.wait_for("agent joined")
    time.sleep(0.5)
    agent.process.send_signal(signal.SIGSTOP)
    edge.wait_for("silent: ann: no message", 20)
    agent.process.send_signal(signal.SIGCONT)
    assert agent.wait(60) == 0
    assert edge.interrupt() == 0
    events = [json.loads(line) for line in (tmp_path / "edge" / "events.jsonl").read_text().splitlines()]
    names = [event["event"] for event in events]
    assert names.index("silent") < names.index("reconnected") < names.index("left")
    report = json.loads((tmp_path / "ann" / "report.json").read_text())
    reported = json.loads((tmp_path / "edge" / "edge.json").read_text())["agents"]["ann"]
    assert (report["protocol"]["pending"], report["frames"]) == (0, 45)
    assert reported["keyframes"] == report["protocol"]["acknowledged"]


def test_agents_are_killed_again_and_again(tmp_path, plain_session):
    """Each is a run of its own; the edge serves the next, and keeps what it has acknowledged."""
    draw = random.Random(7)
    edge, address = start_edge(tmp_path)
    for i in range(50):
        agent = start_agent(tmp_path, f"a{i}", plain_session / "ar1", address)
        time.sleep(draw.uniform(0.0, 3.0))
        agent.kill()
    last = start_agent(tmp_path, "last", plain_session / "ar1", address)
    assert last.wait(60) == 0
    report = json.loads((tmp_path / "last" / "report.json").read_text())
    assert report["protocol"]["pending"] == 0
    assert "Traceback" not in edge.said
    assert edge.process.poll() is None
    assert edge.interrupt() == 0


def test_a_stuck_mapper_is_reported(tmp_path):
    """It is alive, and nothing else would tell: no keyframe waits in the front."""
    edge = Child(tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--http", "0")
    address = edge.wait_for(r"status at (\S+)/")[1]

    def trouble() -> list[str]:
        try:
            with urllib.request.urlopen(f"{address}/health", timeout=5) as answer:
                return json.loads(answer.read())["trouble"]
        except urllib.error.HTTPError as error:  # 503: unwell
            return json.loads(error.read())["trouble"]

    time.sleep(3.0)
    assert trouble() == []
    pid = family(edge.process.pid)["mapper"]
    os.kill(pid, signal.SIGSTOP)
    until("it is said", lambda: any("the mapper has not answered for" in text for text in trouble()))
    os.kill(pid, signal.SIGCONT)
    until("it is over", lambda: trouble() == [])
    assert edge.interrupt() == 0
