"""Compare the emulated network with the kernel's: the same messages over loopback through `tc`, and through
the emulation.

    sudo python tools/experiments/check_link.py [--mbps 10] [--delay_ms 5] [--loss 0.01] [--seconds 20]

Runs in its own network namespace, which it removes. With netem: rate, delay and loss. If the kernel has no
netem, only the rate is compared (tbf), and the output says so. Prints a Markdown table: one-way delays of
poses (200 bytes, 30 a second) and keyframes (30 kB, 3 a second), ms.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time

import numpy as np
from tool_main import exit_code, line

from share.errors import UsageError
from share.lab.evaluate.emulated_network import ChannelModel, EmulatedLink, NetworkModel
from share.net.transport import AgentLink, EdgeLink, bind, connect

POSE, KEYFRAME = 200, 30_000  # bytes
POSE_S, KEYFRAME_S = 1 / 30, 1 / 3
HEAD = ("bytes", "by", "n", "mean", "p50", "p95", "p99", "most")

Delays = dict[int, list[float]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--mbps", type=float, default=10.0)
    parser.add_argument("--delay_ms", type=float, default=5.0)
    parser.add_argument("--loss", type=float, default=0.01)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    return exit_code("check_link", lambda: inside(options) if options.inside else compare(options))


def compare(options: argparse.Namespace) -> None:
    """Measure both, the kernel first: it decides what can be compared."""
    if os.geteuid():
        raise UsageError("network namespaces need root: sudo python tools/experiments/check_link.py")
    kernel, has_netem = by_kernel(options)
    way = (
        ChannelModel(options.mbps, options.delay_ms, 0.0, options.loss)
        if has_netem
        else ChannelModel(options.mbps)
    )
    print(
        "with netem" if has_netem else "this kernel has no netem: only the rate is compared (tbf)", flush=True
    )
    ours = talk(options.seconds, NetworkModel(way, ChannelModel(delay_ms=way.delay_ms)))
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))))
    for size in (POSE, KEYFRAME):
        for name, delays in (("kernel", kernel[size]), ("emulated", ours[size])):
            quantiles = np.percentile(delays, [50, 95, 99, 100])
            figures = [f"{value:.2f}" for value in (np.mean(delays), *quantiles)]
            print(line([str(size), name, str(len(delays)), *figures]))


def by_kernel(options: argparse.Namespace) -> tuple[Delays, bool]:
    """Return delays through `tc`, and whether it had netem."""
    name = f"share-link-{os.getpid()}"
    within = ["ip", "netns", "exec", name]
    subprocess.run(["ip", "netns", "add", name], check=True)
    try:
        subprocess.run([*within, "ip", "link", "set", "lo", "up", "mtu", "1500"], check=True)
        rate = f"rate {options.mbps}mbit"
        has_netem = shape(within, f"netem {rate} delay {options.delay_ms}ms loss {options.loss:%}")
        if not has_netem and not shape(within, f"tbf {rate} burst 3200 limit 1000000"):
            raise UsageError("this kernel has neither netem nor tbf: nothing to compare with")
        command = [*within, sys.executable, __file__, "--inside", "--seconds", str(options.seconds)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    finally:
        subprocess.run(["ip", "netns", "del", name], check=False)
    return {int(size): delays for size, delays in json.loads(output).items()}, has_netem


def shape(within: list[str], discipline: str) -> bool:
    """Set a traffic discipline; return whether the kernel supports it."""
    command = [*within, "tc", "qdisc", "replace", "dev", "lo", "root", *discipline.split()]
    return subprocess.run(command, capture_output=True).returncode == 0


def inside(options: argparse.Namespace) -> None:
    print(json.dumps(talk(options.seconds, None)))


def talk(seconds: float, network: NetworkModel | None) -> Delays:
    """Return one-way delays, ms, of an agent's messages to an edge in this process."""
    edge = bind("tcp://127.0.0.1:0")
    plain = connect(edge.endpoint, 1)
    link: AgentLink = plain if network is None else EmulatedLink(plain, network, 1)
    out: Delays = {POSE: [], KEYFRAME: []}
    over = threading.Event()
    listener = threading.Thread(target=listen, args=(edge, out, over))
    listener.start()
    while not link.poll_connected():
        link.receive(20)
    due = [(POSE_S, POSE, time.monotonic()), (KEYFRAME_S, KEYFRAME, time.monotonic())]
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        for at, (every, size, when) in enumerate(due):
            if when <= now:
                link.send([time.monotonic_ns().to_bytes(8, "big") + bytes(size - 8)])
                due[at] = every, size, when + every
        left_ms = int(1e3 * (min(when for *_, when in due) - time.monotonic()))
        link.receive(max(1, left_ms))
    end = time.monotonic() + 1.0
    while time.monotonic() < end:  # messages in flight
        link.receive(20)
    over.set()
    listener.join()
    link.close()
    edge.close()
    return out


def listen(edge: EdgeLink, out: Delays, over: threading.Event) -> None:
    """Collect delays, ms, by size."""
    while not over.is_set():
        if (message := edge.receive(20)) is not None:
            (frame,) = message.frames
            out[len(frame)].append((time.monotonic_ns() - int.from_bytes(frame[:8], "big")) / 1e6)


if __name__ == "__main__":
    sys.exit(main())
