"""Compare `share sync` with chrony on one machine, where all clocks are equal and the true offset is 0.

    python tools/experiments/measure_sync.py [ROUNDS]

Three set-ups: our server over loopback; a chronyd as the server; our server through a relay that delays each
datagram like a radio link, by 0.5 ms and on average 2 ms more towards the server, 1 ms more on the way back.
A round is 8 queries of `share sync check`, and a `chronyd -Q`, which measures without setting. Needs chrony.
"""

from __future__ import annotations

import getpass
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402

from share.devices.time_client import query_servers  # noqa: E402
from share.devices.time_server import TimeServer, TimeServerRun  # noqa: E402
from share.net.udp import HostPort, StampedSocket, clock_precision  # noqa: E402

LEAST_S, THERE_S, BACK_S = 0.0005, 0.002, 0.001  # of the relay: minimum, and mean of the rest
US = 1e3
HERE = "127.0.0.1"


@dataclass
class Round:
    """Offsets, microseconds."""

    ours: float
    bound: float
    chrony: float


@contextmanager
def our_server() -> Iterator[int]:
    with closing(StampedSocket.bind(HostPort(HERE, 0))) as link:
        run = TimeServerRun(link, TimeServer(precision=clock_precision()), lambda text: None)
        with in_thread(run.run, run.stop):
            yield link.port


@contextmanager
def chrony_server() -> Iterator[int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HERE, 0))
        port = int(probe.getsockname()[1])
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "chrony.conf"
        files = ["cmdport 0", "bindcmdaddress /", f"pidfile {folder}/pid"]
        config.write_text("\n".join([*files, "local stratum 10", f"port {port}", f"allow {HERE}", ""]))
        with subprocess.Popen([*chronyd("-d", "-x", "-f", str(config))], stderr=subprocess.DEVNULL) as server:
            time.sleep(1)
            yield port
            server.terminate()


@contextmanager
def relayed(port: int) -> Iterator[int]:
    over, rng = threading.Event(), np.random.default_rng(0)

    def relay() -> None:
        while not over.is_set():
            try:
                data, client = front.recvfrom(2048)
            except TimeoutError:
                continue
            time.sleep(LEAST_S + rng.exponential(THERE_S))
            back.sendto(data, (HERE, port))
            answer = back.recv(2048)
            time.sleep(LEAST_S + rng.exponential(BACK_S))
            front.sendto(answer, client)

    with socket.socket(type=socket.SOCK_DGRAM) as front, socket.socket(type=socket.SOCK_DGRAM) as back:
        front.bind((HERE, 0))
        front.settimeout(0.1)
        back.settimeout(5)
        with in_thread(relay, over.set):
            yield front.getsockname()[1]


@contextmanager
def in_thread(target: Callable[[], None], stop: Callable[[], None]) -> Iterator[None]:
    thread = threading.Thread(target=target)
    thread.start()
    try:
        yield
    finally:
        stop()
        thread.join()


def chronyd(*arguments: str) -> list[str]:
    return ["/usr/sbin/chronyd", "-U", "-u", getpass.getuser(), *arguments]


def measure(port: int) -> Round:
    (found,) = query_servers([HostPort(HERE, port)], 8)
    assert found.estimate is not None, found.trouble
    asked = chronyd("-Q", "-t", "30", f"server {HERE} port {port} iburst minpoll -2 maxpoll -2")
    done = subprocess.run(asked, capture_output=True, text=True, check=True)
    wrong = re.search(r"wrong by (-?[\d.]+) seconds", done.stdout + done.stderr)
    assert wrong, done
    return Round(found.estimate.offset_ns / US, found.estimate.uncertainty_ns / US, 1e6 * float(wrong[1]))


def row(way: str, rounds: list[Round]) -> str:
    ours, chrony = (np.abs([getattr(r, name) for r in rounds]) for name in ("ours", "chrony"))
    bounds = np.array([r.bound for r in rounds])
    cells = (np.median(ours), ours.max(), np.median(bounds), np.median(chrony), chrony.max())
    within = f"{int((ours <= bounds).sum())} of {len(rounds)}"
    return f"| {way} | {' | '.join(f'{cell:.0f}' for cell in cells)} | {within} |"


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print("| µs off | ours, median | worst | stated ± | chronyd, median | worst | ours within ± |")
    print("|---|---|---|---|---|---|---|")
    for way in ("our server", "chronyd as the server", "our server, through a relay"):
        with ExitStack() as stack:
            port = stack.enter_context(chrony_server() if "as the" in way else our_server())
            if "relay" in way:
                port = stack.enter_context(relayed(port))
            print(row(way, [measure(port) for _ in range(count)]), flush=True)


if __name__ == "__main__":
    main()
