"""`share sync` over real sockets."""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.shell import Done
from helpers.time_servers import shifted, udp

from share.cli.agent import clock_text
from share.devices import time_client
from share.net.ntp import NtpMode, NtpPacket
from share.protocol.edge_clock import ClockEstimate

SHARE = [sys.executable, "-m", "share"]
Share = Callable[..., Done]


@pytest.fixture(autouse=True)
def _brief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_client, "QUESTION_PERIOD_S", 0.02)


def asked(done: Done) -> dict[str, object]:
    """The one clock of `check --json`."""
    reported = json.loads(done.out)
    (clock,) = reported["clocks"]
    assert reported["ok"] == (clock["wrong"] is None) == (done.code == 0)
    return dict(clock)


# ------------------------------------------------------------------ check


def test_clock_within_the_limit_is_a_row_and_exit_code_0(share: Share) -> None:
    with udp(shifted(0.0)) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--count", 4, "--limit-ms", 90)
    head, row = done.out.splitlines()
    assert head.split() == [
        *("clock", "offset", "ms", "±", "ms", "delay", "ms"),
        *("jitter", "ms", "stratum", "answers", "took", "s"),
    ]
    assert re.fullmatch(
        rf" *127\.0\.0\.1:{port}  +[+-]\d\.\d{{3}}(  +\d+\.\d{{3}}){{3}}  +10 +4/4 +0\.\d", row
    )
    assert (done.code, done.err) == (0, "within 90 ms\n")


@pytest.mark.parametrize("offset_ms", [-70.0, 5.0, 3600e3])
def test_offset_of_a_clock_is_measured_within_its_uncertainty(offset_ms: float, share: Share) -> None:
    with udp(shifted(offset_ms)) as port:
        clock = asked(share("sync", "check", f"127.0.0.1:{port}", "--json"))
    assert abs(clock["offset_ms"] - offset_ms) <= clock["uncertainty_ms"]  # type: ignore[operator]
    assert f"off by {clock['offset_ms']:+.3f} ±" in str(clock["wrong"])


def test_wrong_clock_gets_lines_for_chrony_conf(share: Share) -> None:
    with udp(shifted(50.0)) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--limit-ms", 20)
    *advice, last = done.err.splitlines()
    assert advice == [
        "to follow it: install chrony, append this to /etc/chrony/chrony.conf, restart chrony:",
        f"    server 127.0.0.1 port {port} iburst minpoll 0 maxpoll 4 prefer trust",
        "    makestep 0.01 3",
        "    rtcsync",
    ]
    off = r"off by \+\d\d\.\d+ ± \d+\.\d+ ms, the limit is 20 ms; let chrony follow it"
    assert re.fullmatch(rf"share: 127\.0\.0\.1:{port}: {off}", last)
    assert done.code == 1


def test_too_slow_network_is_reported_without_chrony_advice(share: Share) -> None:
    with udp(shifted(0.0, slow_ms=30.0)) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--count", 2, "--limit-ms", 10)
    assert done.code == 1
    assert done.err.count("\n") == 1
    assert re.search(
        r": uncertain by ±(1[5-9]|[2-9]\d)\.\d+ ms, the limit is 10 ms; use a cable, a quieter",
        done.err,
    )


def test_certainly_wrong_clock_is_reported_on_a_slow_network(share: Share) -> None:
    with udp(shifted(900.0, slow_ms=30.0)) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--count", 2, "--limit-ms", 10)
    assert re.search(r"\nshare: 127\.0\.0\.1:\d+: off by \+9\d\d\.\d+ ± ", done.err)


def test_uncertainty_stated_by_a_server_is_added(share: Share) -> None:
    with udp(shifted(0.0, root_dispersion=3 << 16, root_delay=2 << 16)) as port:  # 3 s, and half of 2
        clock = asked(share("sync", "check", f"127.0.0.1:{port}", "--json"))
    assert clock["uncertainty_ms"] == pytest.approx(4000, abs=50)


def test_closed_port_is_reported_at_once(share: Share) -> None:
    with udp(shifted(0.0)) as port:
        pass
    done = share("sync", "check", f"localhost:{port}")
    assert done.code == 1
    assert done.out.splitlines()[1].split() == [f"127.0.0.1:{port}", *"–––––", "0/1", "0.0"]
    assert done.err == (
        f"share: 127.0.0.1:{port}: nothing listens at UDP port {port}; start `share sync server` there "
        "(ntpd and chronyd use port 123)\n"
    )


@pytest.mark.long
def test_silent_server_is_given_up_after_three_requests(
    share: Share, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time_client, "REPLY_TIMEOUT_S", 0.05)
    questions = []
    with udp(lambda data: questions.append(data) or []) as port:  # type: ignore[func-returns-value]
        done = share("sync", "check", f"127.0.0.1:{port}", "--count", 50)
    assert (done.code, len(questions)) == (1, 3)
    assert (
        f"share: 127.0.0.1:{port}: no answer; check that `share sync server` runs there and that UDP port"
        in done.err
    )


def test_one_wrong_server_of_several_is_named_and_all_are_shown(share: Share) -> None:
    with udp(shifted(0.0)) as good, udp(shifted(900.0)) as bad:
        done = share("sync", "check", f"127.0.0.1:{good}", f"127.0.0.1:{bad}", "--limit-ms", 90)
    assert done.code == 1
    assert len(done.out.splitlines()) == 3
    assert re.search(rf"^127\.0\.0\.1:{bad}: off by \+\d+\.\d+ ±", done.err, re.MULTILINE)
    assert f"127.0.0.1:{good}:" not in done.err
    assert done.err.endswith("share: 1 of 2 clocks are not proven to be within 90 ms; see above\n")


def test_kiss_of_death_ends_the_requests(share: Share) -> None:
    questions = []

    def kiss(data: bytes) -> list[bytes]:
        questions.append(data)
        return [NtpPacket(NtpMode.SERVER, refid=b"DENY", origin=NtpPacket.decode(data).transmit).encode()]

    with udp(kiss) as port:
        done = share("sync", "check", f"127.0.0.1:{port}")
    assert (done.code, len(questions)) == (1, 1)
    assert (
        done.err
        == f"share: 127.0.0.1:{port}: the server refuses to answer (DENY): its configuration denies it\n"
    )


def test_replies_before_a_kiss_of_death_count(share: Share) -> None:
    good, questions = shifted(0.0), []

    def soon_tired(data: bytes) -> list[bytes]:
        questions.append(data)
        if len(questions) <= 2:
            return good(data)
        return [NtpPacket(NtpMode.SERVER, refid=b"RATE", origin=NtpPacket.decode(data).transmit).encode()]

    with udp(soon_tired) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--limit-ms", 50)
    assert (done.code, len(questions)) == (0, 3)
    assert " 2/3 " in done.out
    refused = f"127.0.0.1:{port}: the server refuses to answer (RATE): asked too often; wait a minute"
    assert done.err == f"{refused}\nwithin 50 ms\n"


def test_forged_replies_are_skipped(share: Share) -> None:
    good = shifted(0.0)

    def besieged(data: bytes) -> list[bytes]:
        forged = NtpPacket(NtpMode.SERVER, stratum=1, origin=7, receive=1 << 60, transmit=1 << 60)
        return [b"", b"junk", secrets.token_bytes(48), data, forged.encode(), *good(data)]

    with udp(besieged) as port:
        done = share("sync", "check", f"127.0.0.1:{port}", "--limit-ms", 50, "--count", 5)
    assert done.code == 0, done.err
    assert " 5/5 " in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "",
            "no HOST given and no chronyd runs on this machine; give the host that",
        ),
        ("a..b", "a..b: no such host ("),
        ("host.invalid", "host.invalid: no such host ("),
        ("11123", "'11123' is not an address; give HOST or HOST:PORT, such as 192.168.1.10:11123"),
        ("127.0.0.1:0", "'127.0.0.1:0' is not an address"),
        ("127.0.0.1 --count 0", "0 is not in the range 1<=x<=1000"),
        ("127.0.0.1 --limit-ms 0", "0.0 is not in the range x>0"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(
    arguments: str, said: str, share: Share, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # no chronyc
    done = share("sync", "check", *arguments.split())
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("share: ")
    assert said in done.err
    assert done.err.count("\n") == 1


# ------------------------------------------------------------------ server


@contextmanager
def serving(stratum: int = 10) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A server as a process, and its port."""
    with subprocess.Popen(
        [*SHARE, "sync", "server", "--bind", "127.0.0.1:0", "--stratum", str(stratum)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        try:
            said = [process.stderr.readline() for _ in range(3)]  # all: what is read ahead would be lost
            found = re.match(r"serving this machine's time at 127\.0\.0\.1:(\d+) \(UDP\); ", said[0])
            assert found, said
            port = int(found[1])
            assert said[1:] == [
                f"stratum {stratum}, reference 127.127.1.1 (this machine's own clock)\n",
                f"clients' chrony.conf: server THIS-MACHINE port {port} iburst "
                "minpoll 0 maxpoll 4 prefer trust\n",
            ]
            yield process, port
        finally:
            process.kill()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_server_survives_any_input_and_ends_cleanly(number: int, share: Share) -> None:
    with serving(stratum=7) as (process, port):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as enemy:
            for k in range(100):
                enemy.sendto(os.urandom(2 * k), ("127.0.0.1", port))
        clock = asked(share("sync", "check", f"127.0.0.1:{port}", "--json", "--limit-ms", 50))
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert (clock["stratum"], clock["answers"]) == (7, 8)
    assert process.returncode == 0
    counts = r"rate-limited: 0, invalid: (\d+)"
    reported = re.fullmatch(rf"answered: (\d+), clients: 1 \(last 127\.0\.0\.1\), {counts}\n", out)
    assert reported, out
    assert int(reported[1]) + int(reported[2]) == 108
    assert err == "share sync: new client: 127.0.0.1\n"


def test_port_in_use_is_reported(share: Share) -> None:
    with serving() as (_, port):
        done = share("sync", "server", "--bind", f"127.0.0.1:{port}")
    assert done == Done(
        1, "", f"share: 127.0.0.1:{port}: the port is in use; stop the other server or choose another port\n"
    )


# ------------------------------------------------------------------ agents


@pytest.mark.parametrize(
    ("sigma_ms", "said"),
    [
        (0.07, "+0.431 ms from this machine's, ±0.427 ms"),
        (
            2.8,
            "offset too uncertain (±3.16 ms, more than clock.claim_ms (1)); latencies use this machine's",
        ),
    ],
)
def test_agent_prints_the_offset_or_that_it_is_too_uncertain(sigma_ms: float, said: str) -> None:
    claim = ClockEstimate(0.431, sigma_ms, 0.357, claim_ms=1.0)
    assert clock_text(claim.report()).startswith(said)
