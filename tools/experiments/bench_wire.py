"""Cost of the wire: encode and decode, sizes, round trips over loopback, plain and with CURVE.

    python tools/experiments/bench_wire.py [--rounds N]

Prints one JSON object; times are medians in microseconds.
"""

from __future__ import annotations

import argparse
import json
import threading
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter_ns, sleep
from typing import Any

import numpy as np

from share.net.keys import AgentKeys, EdgeKeys, allow_list, authorize, generate_pair
from share.net.transport import AgentLink, EdgeLink, bind, connect
from share.types import Keyframe, KeyframeImage, TrackState, View
from share.wire.codec import decode, encode, message_bytes
from share.wire.layouts import Bytes
from share.wire.messages import Message, Ping, PoseUpdate


def messages() -> dict[str, Message]:
    rng = np.random.default_rng(0)
    surfaces = rng.normal(size=(70, 2)), rng.normal(size=(70, 3)), rng.uniform(0, 0.1, 70)
    image = KeyframeImage(rng.integers(0, 256, 17_000, np.uint8), *surfaces)
    return {
        "ping": Ping(1, 10**18),
        "pose": PoseUpdate(10**18, TrackState.OK, 100, np.eye(4)),
        "keyframe": Keyframe(
            100,
            99,
            10**18,
            np.eye(4),
            np.eye(6),
            np.eye(4),
            np.array([0, 0, 1.0]),
            0.01,
            View.empty(),
            image=image,
        ),
    }


def timed_us(call: Callable[[], Any], rounds: int) -> float:
    times = []
    for _ in range(rounds):
        start = perf_counter_ns()
        call()
        times.append(perf_counter_ns() - start)
    return round(median(times) / 1e3, 1)


def keys(folder: Path) -> tuple[EdgeKeys, AgentKeys]:
    """Return keys of an edge and of an agent that it authorises."""
    edge, agent = generate_pair(folder / "edge", "edge"), generate_pair(folder / "agent", "agent")
    authorize(folder / "edge", "agent", agent.public)
    return EdgeKeys(edge, allow_list(folder / "edge")), AgentKeys(agent, edge.public)


def echo(edge: EdgeLink, stop: threading.Event) -> None:
    while not stop.is_set():
        if received := edge.receive(100):
            edge.send(received.peer, received.frames)


def round_trip(agent: AgentLink, frames: list[Bytes]) -> None:
    while not agent.send(frames):
        sleep(0.001)
    while agent.receive(1000) is None:
        pass


def round_trips(edge: EdgeLink, agent: AgentLink, rounds: int) -> dict[str, float]:
    stop = threading.Event()
    server = threading.Thread(target=echo, args=(edge, stop))
    server.start()
    try:
        for _ in range(20):
            round_trip(agent, encode(Ping(0, 0)))
        return {
            name: timed_us(partial(round_trip, agent, encode(m)), rounds) for name, m in messages().items()
        }
    finally:
        stop.set()
        server.join()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=2000)
    rounds = parser.parse_args().rounds
    result: dict[str, Any] = {"rounds": rounds, "unit": "us, median"}
    for name, message in messages().items():
        frames = [bytes(frame) for frame in encode(message)]
        result[name] = {
            "bytes": message_bytes(frames),
            "encode": timed_us(partial(encode, message), rounds),
            "decode": timed_us(partial(decode, frames), rounds),
        }
    with closing(bind("tcp://127.0.0.1:0")) as edge, closing(connect(edge.endpoint, 1)) as agent:
        result["round_trip_zmq"] = round_trips(edge, agent, rounds)
    with TemporaryDirectory() as folder:
        edge_keys, agent_keys = keys(Path(folder))
        with (
            closing(bind("tcp://127.0.0.1:0", edge_keys)) as edge,
            closing(connect(edge.endpoint, 1, agent_keys)) as agent,
        ):
            result["round_trip_curve"] = round_trips(edge, agent, rounds)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
