"""chrony as a peer: it follows our server, our client queries it. No clock is set (-Q, -x)."""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from helpers.shell import Done
from helpers.time_servers import (
    CHRONYC,
    chronyd,
    free_port,
    needs_chrony,
    running_chronyd,
    shifted,
    udp,
    wait_for,
)

from share.devices import time_client
from share.devices.clocks import follow_lines, read_tracking
from share.devices.time_client import query_servers
from share.devices.time_server import TimeServer, TimeServerRun
from share.net.udp import HostPort, StampedSocket

pytestmark = needs_chrony
QUICK = "iburst minpoll -2 maxpoll -2"  # four questions in a second
MS = 1_000_000
CLOSE_MS = 2.0  # on a machine busy with tests; usual values: docs/do/sync.md


@pytest.fixture(autouse=True)
def _brief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_client, "QUESTION_PERIOD_S", 0.02)


@contextmanager
def our_server() -> Iterator[tuple[int, TimeServer]]:
    with closing(StampedSocket.bind(HostPort("127.0.0.1", 0))) as link:
        server = TimeServer(precision=-20)
        run = TimeServerRun(link, server, lambda text: None)
        thread = threading.Thread(target=run.run)
        thread.start()
        try:
            yield link.port, server
        finally:
            run.stop()
            thread.join()


def chrony_says_ms(port: int) -> float:
    """How far it is from this machine's clock, as chronyd measures it and does not set it."""
    done = subprocess.run(
        chronyd("-Q", "-t", "20", f"server 127.0.0.1 port {port} {QUICK}"),
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    found = re.search(r"System clock wrong by (-?[\d.]+) seconds \(ignored\)", done.stdout + done.stderr)
    assert found, done.stdout + done.stderr
    return 1e3 * float(found[1])


def test_chronyd_accepts_our_server() -> None:
    with our_server() as (port, server):
        assert abs(chrony_says_ms(port)) < CLOSE_MS
        assert server.counts["answered"] >= 3  # fewer and it would not believe them
        assert server.counts["ignored"] == server.counts["limited"] == 0


@pytest.mark.parametrize("offset_ms", [-40.0, 5.0])
def test_chronyd_and_our_client_agree_on_a_clock_that_is_off(offset_ms: float) -> None:
    with udp(shifted(offset_ms)) as port:
        theirs = chrony_says_ms(port)
        (ours,) = query_servers([HostPort("127.0.0.1", port)], 8)
    assert ours.estimate is not None
    assert abs(ours.estimate.offset_ns / MS - offset_ms) <= ours.estimate.uncertainty_ns / MS
    assert theirs == pytest.approx(offset_ms, abs=CLOSE_MS)
    assert theirs == pytest.approx(ours.estimate.offset_ns / MS, abs=CLOSE_MS)


def test_chronyd_prefers_our_server_to_three_others(tmp_path: Path) -> None:
    """They are nearer to a true clock, and many, as those that a package of chrony brings."""
    addresses = ("127.0.0.2", "127.0.0.3", "127.0.0.4")
    with ExitStack() as servers:
        ports = [servers.enter_context(udp(shifted(0.0, stratum=2), address)) for address in addresses]
        lines = [f"server {a} port {p} {QUICK}" for a, p in zip(addresses, ports, strict=True)]
        room = follow_lines(HostPort("127.0.0.1", servers.enter_context(udp(shifted(40.0)))))
        control = servers.enter_context(running_chronyd(tmp_path / "run", "port 0", *lines, *room))
        refused = dict.fromkeys(addresses, "x")  # falsetickers, chronyc(1)
        wait_for(lambda: _chosen(control) == {**refused, "127.0.0.1": "*"})


def _chosen(control: Path) -> dict[str, str]:
    """What that chronyd makes of its servers."""
    command = [str(CHRONYC), "-h", str(control), "-c", "sources"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return {row[2]: row[1] for row in (line.split(",") for line in done.stdout.splitlines())}


def test_our_client_asks_a_chronyd(tmp_path: Path) -> None:
    port = free_port()
    with running_chronyd(tmp_path / "run", "local stratum 10", f"port {port}", "allow 127.0.0.1"):
        (found,) = query_servers([HostPort("127.0.0.1", port)], 8)
    assert found.trouble is None and found.estimate is not None
    assert (found.estimate.answers, found.estimate.stratum) == (8, 10)
    assert abs(found.estimate.offset_ns) <= found.estimate.uncertainty_ns < MS


def test_an_unsynchronised_chronyd_is_not_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_client, "REPLY_TIMEOUT_S", 0.3)
    port = free_port()
    with running_chronyd(tmp_path / "run", f"port {port}", "allow 127.0.0.1"):
        (found,) = query_servers([HostPort("127.0.0.1", port)], 4)
    assert found.estimate is None
    assert found.trouble == "invalid reply: the server is not synchronised itself"


def own_chronyd(folder: Path, control: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on `chronyc` speaks to this one, and not to one that this machine may have."""
    (folder / "chronyc").write_text(f'#!/bin/sh\nexec {CHRONYC} -h {control} "$@"\n')
    (folder / "chronyc").chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def is_settled() -> bool:
    """In its first second chronyd knows how far it is off, but not how fast that changes."""
    found = read_tracking()
    return found is not None and found.synchronised and found.uncertainty_s < 1e-3


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ("local stratum 10", "follows its own clock; fine if others follow it: check on their machines"),
        ("port 0", "follows no other clock yet; see `chronyc sources`"),
    ],
)
def test_a_local_chronyd_without_sources_reports_no_offset(
    config: str, said: str, tmp_path: Path, share: Callable[..., Done], monkeypatch: pytest.MonkeyPatch
) -> None:
    with running_chronyd(tmp_path / "run", config, f"port {free_port()}") as control:
        own_chronyd(tmp_path, control, monkeypatch)
        wait_for(lambda: (found := read_tracking()) is not None and found.local == ("local" in config))
        done = share("sync", "check")
    assert (done.code, done.err) == (1, f"share: chronyd: {said}\n")
    assert done.out.splitlines()[1].split() == ["chronyd", *"–––––––"]


def test_the_local_chronyds_offset_is_shown_without_a_host(
    tmp_path: Path, share: Callable[..., Done], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It follows a server that is 5 ms ahead, and may not set this machine's clock."""
    with (
        udp(shifted(5.0)) as port,
        running_chronyd(tmp_path / "run", "port 0", f"server 127.0.0.1 port {port} {QUICK}") as control,
    ):
        own_chronyd(tmp_path, control, monkeypatch)
        wait_for(is_settled)
        good = share("sync", "check", "--limit-ms", 8)
        bad = share("sync", "check", "--limit-ms", 2)
    assert good.code == 0
    assert re.search(r"chronyd, by 127\.0\.0\.1 +\+[45]\.\d{3} ", good.out)
    assert bad.code == 1
    off = r"off by \+[45]\.\d+ ± 0\.\d+ ms, the limit is 2 ms; see `chronyc sources`"
    assert re.fullmatch(rf"share: chronyd, by 127\.0\.0\.1: {off}\n", bad.err)
