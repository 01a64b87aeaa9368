"""Responses of `share edge --http`, over real sockets."""

from __future__ import annotations

import http.client
import json
import os
import random
import re
import resource
import socket
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from helpers.hellos import hello_of
from helpers.reports import headset_report
from helpers.room_bench import RoomBench, at
from prometheus_client.parser import text_string_to_metric_families

from share.config import Config
from share.errors import TransportError, UsageError
from share.mapping.agents.agreement import AgentConsistency
from share.mapping.mapper import Mapper
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import AddRun, PeerMessageReceived
from share.runtime import edge_metrics, web
from share.runtime.status_server import CACHE_S, StatusServer
from share.wire.codec import encode
from share.wire.messages import peer_id
from share.wire.room_messages import RobotPlace

AGENT = {
    "kind": "ar",
    "run": "ann-1234",
    "state": "OK",
    "gone": False,
    "keyframes": 12,
    "bytes_up": 34567,
    "loops": {"tried": 9, "accepted": 4},
    "map_id": 0,
}
TIMES = {"n": 4, "mean": 20.0, "p50": 10.0, "p95": 30.0, "p99": 40.0, "max": 50.0}
REPORT = {
    "agents": {"ann": AGENT, "bob": {**AGENT, "kind": "robot", "gone": True, "map_id": None}},
    "maps": {0: 12, 3: 1},
    "failed_steps": 2,
    "solve_ms": TIMES,
}


@contextmanager
def serving(report=lambda: REPORT, address="127.0.0.1:0", tell=lambda text: None):
    server = StatusServer(address, report, tell)
    try:
        yield server
    finally:
        server.close()


def get(server, path, method="GET", headers=None):
    """Status, headers and body."""
    connection = http.client.HTTPConnection(server.endpoint, timeout=10)
    try:
        connection.request(method, path, headers=headers or {})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def said(server, request: bytes) -> bytes:
    """All that is answered to these bytes."""
    host, _, port = server.endpoint.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10) as client:
        client.sendall(request)
        return b"".join(iter(lambda: client.recv(65536), b""))


def metrics(body):
    """Every sample by its name and labels."""
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(body.decode())
        for sample in family.samples
    }


def real_report():
    """Return the report of an edge that knows one agent and nothing more."""
    edge, mapper = EdgeProtocol(Config(), session=5), Mapper(Config())
    hello = hello_of("ann", 1)
    for effect in edge.handle(PeerMessageReceived(peer_id(1), encode(hello)), 10**9):
        if isinstance(effect, AddRun):
            mapper.add_run(effect.key, effect.hello)
    return edge.report(mapper.report())


# ---------------------------------------------------------------- what is served


def test_health_lists_present_agents():
    with serving(lambda: {**REPORT, "waiting": 3, "last_solve_s": 0.5}) as server:
        status, headers, body = get(server, "/health")
    assert (status, headers["Content-Type"]) == (200, "application/json")
    health = json.loads(body)
    assert 0 <= health.pop("uptime_s") < 60
    expected = {
        "status": "ok",
        "trouble": [],
        "degraded": [],
        "agent_trouble": [],
        "refused": [],
        "agents": ["ann"],
        "waiting": 3,
        "last_solve_s": 0.5,
    }
    assert health == expected


def test_a_map_that_is_loaded_is_said_and_no_trouble():
    with serving(lambda: {**REPORT, "loading": "loading the map: 7 keyframes"}) as server:
        status, _, body = get(server, "/health")
        page = get(server, "/")[2].decode()
    health = json.loads(body)
    assert (status, health["status"], health["loading"]) == (200, "ok", "loading the map: 7 keyframes")
    assert "now.loading" in page


def test_a_peers_bad_messages_do_not_make_the_edge_unhealthy():
    """Whoever restarts an edge because of that would do the attacker's work."""
    edge = EdgeProtocol(Config(), session=5)
    for k in range(100):
        edge.handle(PeerMessageReceived(peer_id(1), [b"nonsense"]), 10**9)
        edge.handle(PeerMessageReceived(peer_id(2), encode(hello_of("ann", 2))), 10**9 + k)
        edge.handle(PeerMessageReceived(peer_id(2), [b"nonsense"]), 10**9 + k)
    with serving(lambda: edge.report({})) as server:
        status, _, body = get(server, "/health")
        samples = metrics(get(server, "/metrics")[2])
    health = json.loads(body)
    assert (status, health["status"], health["trouble"]) == (200, "ok", [])
    senders = [line.split(":")[0] for line in health["refused"]]
    assert senders == ["peers that have not joined", "agent 'ann'"]
    assert not any(value for (name, _), value in samples.items() if name == "share_edge_troubles")


def test_trouble_makes_health_503():
    trouble = ["the map file cannot be written"]
    with serving(lambda: {**REPORT, "trouble": trouble}) as server:
        status, _, body = get(server, "/health")
    assert status == 503
    assert json.loads(body)["status"] == "trouble" and json.loads(body)["trouble"] == trouble


def test_a_map_that_was_set_aside_is_degraded_but_no_reason_to_restart_the_edge():
    line = "the map file is renamed to room.sqlite.damaged-1: ValueError: x; a new one is started"
    for trouble, expected in (([], (200, "degraded")), (["the disk is full"], (503, "trouble"))):
        with serving(lambda t=trouble: {**REPORT, "trouble": t, "degraded": [line]}) as server:
            status, _, body = get(server, "/health")
            samples = metrics(get(server, "/metrics")[2])
            assert get(server, "/health/agents")[0] == expected[0]
        health = json.loads(body)
        assert ((status, health["status"]), health["degraded"]) == (expected, [line])
        assert samples["share_edge_degraded", frozenset()] == 1


def test_an_agents_trouble_is_trouble_but_no_reason_to_restart_the_edge():
    report = {**REPORT, "agent_trouble": ["agent 'ann': LOST"]}
    with serving(lambda: report) as server:
        for path, expected in (("/health", 200), ("/health/agents", 503)):
            status, _, body = get(server, path)
            health = json.loads(body)
            assert (status, health["status"], health["agent_trouble"]) == (
                expected,
                "trouble",
                ["agent 'ann': LOST"],
            )
    with serving() as server:
        assert get(server, "/health/agents")[0] == 200


def test_the_quantiles_of_the_pose_delay_are_metrics():
    report = {"agents": {"ann": {**AGENT, "pose_ages_ms": TIMES, "qoe": 0.9, "delay_ms": 15.0}}}
    with serving(lambda: report) as server:
        samples = metrics(get(server, "/metrics")[2])
    who = {("agent", "ann"), ("kind", "ar")}
    assert samples["share_edge_pose_delay_seconds", frozenset(who | {("quantile", "0.95")})] == 0.03
    assert samples["share_edge_pose_delay_seconds_count", frozenset(who)] == 4
    assert samples["share_edge_qoe", frozenset(who)] == 0.9
    assert samples["share_edge_delay_seconds", frozenset(who)] == 0.015


def test_the_plan_is_served_beside_the_report():
    server = StatusServer("0", lambda: REPORT, plan=lambda: {"agents": {"ann": {"position": [1.0, 2.0]}}})
    try:
        status, _, body = get(server, "/plan.json")
        assert status == 200 and json.loads(body)["agents"]["ann"]["position"] == [1.0, 2.0]
    finally:
        server.close()


def test_snapshot_is_the_report_and_its_age():
    with serving() as server:
        status, headers, body = get(server, "/snapshot.json?now")
    snapshot = json.loads(body)
    assert status == 200 and snapshot.pop("uptime_s") >= 0
    assert snapshot == json.loads(json.dumps(REPORT))
    assert headers["Access-Control-Allow-Origin"] is None and headers["Set-Cookie"] is None


def test_metrics_are_read_back():
    with serving() as server:
        status, headers, body = get(server, "/metrics")
    assert status == 200
    assert headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    read = metrics(body)
    ann, bob = {("agent", "ann"), ("kind", "ar")}, {("agent", "bob"), ("kind", "robot")}
    for name, labels, value in [
        ("share_edge_keyframes_total", ann, 12),
        ("share_edge_received_bytes_total", bob, 34567),
        ("share_edge_loops_accepted_total", ann, 4),
        ("share_edge_agent_gone", ann, 0),
        ("share_edge_agent_gone", bob, 1),
        ("share_edge_agent_info", ann | {("state", "OK"), ("map", "0")}, 1),
        ("share_edge_agent_info", bob | {("state", "GONE"), ("map", "")}, 1),
        ("share_edge_maps", set(), 2),
        ("share_edge_map_keyframes", {("map", "3")}, 1),
        ("share_edge_failed_steps_total", set(), 2),
        ("share_edge_step_seconds", {("step", "solve"), ("quantile", "0.95")}, 0.03),
        ("share_edge_step_seconds_count", {("step", "solve")}, 4),
        ("share_edge_step_seconds_sum", {("step", "solve")}, 0.08),
    ]:
        assert read[name, frozenset(labels)] == pytest.approx(value), name


def test_no_alert_goes_on_for_ever_once_an_agent_has_left():
    old = {"state": "SILENT", "pose_age_ms": 90e3, "last_received_s": 90.0, "gone": True}
    who = {("agent", "ann"), ("kind", "ar")}
    for trouble in ([], ["SILENT: silent for 90 s"]):
        body, _ = edge_metrics.render_metrics({"agents": {"ann": {**AGENT, **old, "trouble": trouble}}})
        read = metrics(body)
        state = "SILENT" if trouble else "GONE"
        assert read["share_edge_agent_info", frozenset(who | {("state", state), ("map", "0")})] == 1
        age_s = read.get(("share_edge_pose_age_seconds", frozenset(who)))
        assert age_s == (90.0 if trouble else None)


def test_metrics_that_the_report_lacks_are_omitted():
    odd = {"agents": {"ann": {"keyframes": "many"}, "bob": None}, "maps": 3, "loops": None, "x_ms": {"n": 0}}
    for report in ({}, odd):
        body, _ = edge_metrics.render_metrics(report)
        assert all(value == value for value in metrics(body).values())


def test_every_metric_has_a_value_in_a_real_report():
    more = {"uptime_s": 1.0, "trouble": [], "degraded": [], "headset": headset_report(), "room_changes": 0}
    more |= {"rooms": {"lab": {"agents": 1, "keyframes": 2, "waiting": 0}}}
    body, _ = edge_metrics.render_metrics({**real_report(), **more})
    names = {name for name, _ in metrics(body)}
    absent = {row.name for row in edge_metrics.METRICS} - names
    by_others = {"share_edge_last_solve_age_seconds", "share_edge_refused_handshakes_total"}
    not_yet = {
        "share_edge_map_keyframes",
        "share_edge_clock_error_seconds",
        "share_edge_delay_seconds",
        "share_edge_keyframe_rate_hertz",
        "share_edge_pose_age_seconds",
        "share_edge_qoe",
        "share_edge_unidentified_bad_messages_total",
    }
    assert absent <= by_others | not_yet


def test_names_and_units_are_as_prometheus_wants_them():
    for row in edge_metrics.METRICS:
        assert re.fullmatch(r"share_edge(_[a-z]+)+", row.name)
        assert row.help.endswith(".") and len({r.name for r in edge_metrics.METRICS}) == len(
            edge_metrics.METRICS
        )


def test_every_metric_is_in_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "lookup" / "status.md").read_text()
    assert [
        r.name for r in edge_metrics.METRICS if f"`{r.name.removeprefix('share_edge_')}`" not in page
    ] == []


@pytest.mark.parametrize("name", ['a"b', "a\nb", "a\\b", "änn 漢字", "<img src=x>", "{}"])
def test_any_name_comes_through(name):
    with serving(lambda: {"agents": {name: AGENT}}) as server:
        samples = metrics(get(server, "/metrics")[2])
        assert samples["share_edge_keyframes_total", frozenset({("agent", name), ("kind", "ar")})] == 12
        assert json.loads(get(server, "/health")[2])["agents"] == [name]


def test_the_page_needs_nothing_from_elsewhere():
    with serving() as server:
        status, headers, body = get(server, "/")
    page = body.decode()
    assert status == 200 and headers["Content-Type"].startswith("text/html") and len(body) < 24 * 1024
    assert not re.search(r"https?://|(src|href)=|innerHTML|@import|url\(", page)
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert 'fetch("snapshot.json"' in page


def test_the_page_shows_the_consistency_of_agents():
    """Each field that the page reads is one of the report's."""
    reported = asdict(AgentConsistency("quarantined", "against ann its depths are larger", 0.03, 0.002))
    with serving(lambda: {"agents": {"eve": {**AGENT, "consistency": reported}}}) as server:
        assert json.loads(get(server, "/snapshot.json")[2])["agents"]["eve"]["consistency"] == reported
        page = get(server, "/")[2].decode()
    assert 'id="consistency"' in page and '["quarantined", "disputed"].includes' in page
    assert set(re.findall(r"\bc\.(\w+)", page)) - {"consistency"} <= reported.keys()
    assert {"reason", "log_scale", "sigma", "corrected_log_scale"} <= set(re.findall(r"\bc\.(\w+)", page))


def test_the_page_shows_objects_robots_and_clients():
    """Each field that the page reads is one of the edge's report."""
    bench = RoomBench()
    bench.correct(bench.agent("ann", 1), "ann-1/0", np.eye(4))
    bot = bench.client("bot", 11, drives_robot=True)
    bench.run(0.1)
    bench.put(bot, 1, 7, at(1, 2), "ann-1/0")
    bench.said(bot, RobotPlace(None, "ann-1/0", 1.0, 2.0, 0.5, "reached"))
    bench.run(0.1)
    report = bench.edge.report({})
    fields = {"it": report["objects"]["7"], "robot": report["robots"]["bot"], "one": report["clients"][0]}
    fields["wearer"] = headset_report()["wearers"]["ann"]
    with serving(lambda: report) as server:
        assert json.loads(get(server, "/snapshot.json")[2])["objects"] == report["objects"]
        page = get(server, "/")[2].decode()
    for name, reported in fields.items():
        read = set(re.findall(rf"\b{name}\.(\w+)", page))
        assert read and read <= reported.keys()


# ---------------------------------------------------------------- what goes wrong


def test_a_failed_report_is_500_and_reported_once():
    reported = []

    def report():
        raise RuntimeError("the map\nis gone")

    with serving(report, tell=reported.append) as server:
        answers = [get(server, path) for path in ("/health", "/metrics", "/snapshot.json", "/health")]
        assert get(server, "/")[0] == 200
    assert {(status, body) for status, _, body in answers} == {
        (500, b"no report: RuntimeError: the map is gone\n")
    }
    assert reported == ["status: no report: RuntimeError: the map is gone"]


def test_a_report_that_is_no_json_is_500():
    with serving(lambda: {"x": float("nan")}) as server:
        assert get(server, "/snapshot.json")[0] == 500


def test_it_recovers():
    fail = [True]

    def report():
        if fail:
            raise RuntimeError("not yet")
        return REPORT

    with serving(report) as server:
        assert get(server, "/health")[0] == 500
        fail.clear()
        time.sleep(1.5 * CACHE_S)
        assert get(server, "/health")[0] == 200


def test_responses_are_cached():
    asked = []
    with serving(lambda: asked.append(1) or REPORT) as server:
        began = time.monotonic()
        for _ in range(50):
            assert get(server, "/metrics")[0] == 200
        most = 2 + (time.monotonic() - began) / CACHE_S
    assert 1 <= len(asked) <= most


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE"])
def test_nothing_but_get_and_head(method):
    with serving() as server:
        status, headers, _ = get(server, "/health", method)
    assert status == 405 and headers["Allow"] == "GET, HEAD"


def test_head_has_no_body():
    with serving() as server:
        status, headers, body = get(server, "/snapshot.json", "HEAD")
        assert (status, body) == (200, b"") and int(headers["Content-Length"]) > 100


@pytest.mark.parametrize("path", ["/nothing", "/../etc/passwd", "/health/", "//", "*", "/%2e%2e/"])
def test_other_paths_are_404(path):
    with serving() as server:
        assert get(server, path)[0] == 404


def test_a_large_request_is_refused():
    with serving() as server:
        status, _, body = get(server, "/health", headers={"X": "y" * 9000})
        assert status == 431 and b"8192" in body
        assert said(server, b"A" * 60000).startswith(b"HTTP/1.1 431 ")
        assert get(server, "/health")[0] == 200


@pytest.mark.parametrize(
    "request_",
    [b"hello\r\n\r\n", b"GET /\r\n\r\n", b"\r\n\r\n", b"GET / HTTP/3\n\n", b"\x16\x03\x01\n\n\xff"],
)
def test_malformed_requests_are_refused(request_):
    with serving() as server:
        assert said(server, request_).startswith(b"HTTP/1.1 400 ")


def test_a_request_may_come_in_pieces():
    with serving() as server:
        host, _, port = server.endpoint.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=10) as client:
            for piece in (b"GET /hea", b"lth HTTP/1.0\r\n", b"\r", b"\n"):
                client.sendall(piece)
                time.sleep(0.02)
            assert client.recv(15) == b"HTTP/1.1 200 OK"


@pytest.mark.long
def test_slow_clients_delay_no_other(monkeypatch):
    monkeypatch.setattr(web, "CLIENT_TIMEOUT_S", 0.5)
    with serving() as server:
        host, _, port = server.endpoint.rpartition(":")
        threads = threading.active_count()
        slow = [
            socket.create_connection((host, int(port)), timeout=10) for _ in range(3 * web.MAX_CONNECTIONS)
        ]
        for _ in range(8):
            for client in slow:
                with suppress(ConnectionError):
                    client.send(b"G")
            began = time.monotonic()
            assert get(server, "/health")[0] == 200
            assert time.monotonic() - began < 0.4
            assert threading.active_count() == threads
            time.sleep(0.1)
        for client in slow:  # 0.8 s have passed
            with suppress(ConnectionError):
                assert client.recv(1) == b""
            client.close()


@pytest.mark.long
def test_a_client_that_does_not_read_is_dropped(monkeypatch):
    monkeypatch.setattr(web, "CLIENT_TIMEOUT_S", 0.5)
    with serving(lambda: {"x": "y" * 20_000_000, "agents": {}}) as server:
        host, _, port = server.endpoint.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=10) as lazy:
            lazy.sendall(b"GET /snapshot.json HTTP/1.1\r\n\r\n")
            time.sleep(0.2)
            assert get(server, "/health")[0] == 200
            assert len(get(server, "/snapshot.json")[2]) > 20_000_000
            time.sleep(0.8)
            got = 0
            with suppress(ConnectionError):
                while more := lazy.recv(1 << 20):
                    got += len(more)
            assert got < 20_000_000


# ---------------------------------------------------------------- where it listens


def test_a_port_alone_is_served_on_loopback():
    with serving(address="0") as server:
        assert server.endpoint.startswith("127.0.0.1:") and get(server, "/health")[0] == 200


def test_ipv6_and_localhost():
    for address in ("[::1]:0", "localhost:0"):
        with serving(address=address) as server:
            assert get(server, "/health")[0] == 200


@pytest.mark.parametrize("address", ["", "host", ":8080", "127.0.0.1:70000", "http://127.0.0.1:80", "a b:1"])
def test_malformed_addresses_are_refused(address):
    with pytest.raises(UsageError, match="expected HOST:PORT"):
        StatusServer(address, lambda: REPORT)


def test_a_port_in_use_is_reported():
    with serving() as server, pytest.raises(TransportError, match="port is in use"):
        StatusServer(server.endpoint, lambda: REPORT)


def test_an_address_of_another_machine_is_reported():
    with pytest.raises(TransportError, match="this machine has no such address"):
        StatusServer("192.0.2.1:0", lambda: REPORT, token="x" * 20)


def test_other_machines_need_a_token():
    with pytest.raises(UsageError, match="others could read it; add --http-token FILE"):
        StatusServer("0.0.0.0:0", lambda: REPORT)
    server = StatusServer("0.0.0.0:0", lambda: REPORT, token="a-token-of-some-length")
    try:
        assert get(server, "/health")[0] == 401
        assert get(server, "/health", headers={"Authorization": "Bearer a-token-of-some-length"})[0] == 200
        status, headers, _ = get(server, "/?token=a-token-of-some-length")
        assert (status, headers["Location"]) == (303, "/")
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert get(server, "/", headers={"Cookie": cookie})[0] == 200
        foreign = {"Cookie": cookie, "Origin": "http://evil.example"}
        assert get(server, "/", headers=foreign)[0] == 403
    finally:
        server.close()


def test_dns_rebinding_is_refused():
    with serving() as server:
        assert get(server, "/health", headers={"Host": "evil.example:80"})[0] == 403
        for host in ("localhost", "LocalHost:80", "127.0.0.1:1", "[::1]:80"):
            assert get(server, "/health", headers={"Host": host})[0] == 200


# ---------------------------------------------------------------- what an attacker sends


@pytest.mark.parametrize(
    "header", [b"host:" + b" " * 8000 + b"x y", b"host:" + b" \t" * 4000 + b"\x0b", b"Host:" + b":1" * 4000]
)
def test_no_header_takes_long_to_read(header):
    """A pattern that backtracks took 2 s, in which nothing else of the process could run."""
    with serving() as server:
        began = time.thread_time(), time.process_time()
        assert said(server, b"GET /health HTTP/1.1\r\n" + header + b"\r\n\r\n").startswith(b"HTTP/1.1 ")
        assert time.process_time() - began[1] < 0.3


@contextmanager
def attackers(server, attack, count=3):
    """So many threads that do `attack(address)` again and again."""
    host, _, port = server.endpoint.rpartition(":")
    over = threading.Event()

    def go():
        while not over.is_set():
            with suppress(OSError):
                attack((host, int(port)))

    threads = [threading.Thread(target=go) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join(10)


def connect_and_go(address):
    socket.create_connection(address, timeout=1).close()


def connect_and_stay(address):
    with ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(socket.create_connection(address, timeout=1))
        time.sleep(0.05)


def byte_by_byte(address):
    with socket.create_connection(address, timeout=1) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for _ in range(9000):
            client.send(b"G")


def endless_body(address):
    with socket.create_connection(address, timeout=1) as client:
        client.sendall(b"POST /health HTTP/1.1\r\nContent-Length: 999999999\r\n\r\n")
        while client.send(bytes(65536)):
            pass


def pipelined(address):
    with socket.create_connection(address, timeout=1) as client:
        client.sendall(b"GET /snapshot.json HTTP/1.1\r\nConnection: keep-alive\r\n\r\n" * 100)
        while client.recv(65536):
            pass


def noise(address):
    with socket.create_connection(address, timeout=1) as client:
        client.sendall(random.randbytes(random.randrange(1, 20_000)) + b"\r\n\r\n")
        client.recv(65536)


@pytest.mark.long
@pytest.mark.parametrize(
    "attack", [connect_and_go, connect_and_stay, byte_by_byte, endless_body, pipelined, noise]
)
def test_attacks_take_little_and_end_nothing(attack):
    with serving() as server:
        (web_thread,) = [thread for thread in threading.enumerate() if thread.name == "web"]
        clock = time.pthread_getcpuclockid(web_thread.ident)
        threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
        memory = resident_bytes()
        with attackers(server, attack):
            began, worked = time.monotonic(), time.clock_gettime(clock)
            time.sleep(1.0)
            share = (time.clock_gettime(clock) - worked) / (time.monotonic() - began)
        assert share < 0.35
        assert get(server, "/health")[0] == 200
        assert threading.active_count() == threads
        assert len(os.listdir("/proc/self/fd")) <= files + 2 * web.MAX_CONNECTIONS
        assert resident_bytes() - memory < 20e6


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_a_failed_handler_costs_one_connection():
    def fails(path):
        raise RuntimeError(path)

    server = web.WebServer("0", fails)
    try:
        for _ in range(3):
            assert said(server, b"GET / HTTP/1.1\r\n\r\n") == b""
    finally:
        server.close()


def test_close_ends_the_thread_and_frees_the_port():
    with serving() as server:
        endpoint = server.endpoint
        get(server, "/health")
    server.close()
    with pytest.raises(ConnectionError):
        get(server, "/health")
    assert "web" not in {thread.name for thread in threading.enumerate()}
    with serving(address=endpoint) as again:
        assert again.endpoint == endpoint


def test_metrics_count_what_the_report_does_not_list():
    def samples(report):
        body, _ = edge_metrics.render_metrics(report)
        families = text_string_to_metric_families(body.decode())
        return {(one.name, *one.labels.values()): one.value for family in families for one in family.samples}

    unlisted = {"unlisted_runs": 40, "unlisted_maps": 7, "unlisted_keyframes": 90}
    found = samples({"maps": {"a/0": 12, "b/0": 1}, **unlisted})
    assert (found["share_edge_maps",], found["share_edge_unlisted_runs",]) == (9, 40)
    assert found["share_edge_map_keyframes", "a/0"] == 12
    assert samples(REPORT)["share_edge_maps",] == 2
    assert ("share_edge_maps",) not in samples({"unlisted_runs": 0})
