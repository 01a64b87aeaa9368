"""N agents in one cheap process that send prepared messages with the timing of `share.protocol.agent`.

    python tools/experiments/load_agents.py tcp://H:P N SECONDS COUNTED_FROM

Each agent sends 30 poses, 3 keyframes with their evaluations, and 2 pings a second, and reads all replies.
Writes "counted" and "over" to stderr at those times, waits for a line on stdin, and prints JSON.
"""

from __future__ import annotations

import heapq
import json
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

from share import startup

startup.prepare_process()

import msgspec  # noqa: E402
import numpy as np  # noqa: E402
import zmq  # noqa: E402
from keyframe_set import KeyframeSet  # noqa: E402
from load_tracks import RATE_HZ, Walker, room  # noqa: E402

from share.metrics.frame_log import summary  # noqa: E402
from share.types import TrackState  # noqa: E402
from share.wire.codec import encode  # noqa: E402
from share.wire.messages import Bye, Evaluation, Ping, PoseUpdate, peer_id  # noqa: E402

_POSE_S, _PING_S, _KEYFRAME_S = 1 / 30, 0.5, 1 / RATE_HZ
_COMING_S = 3.0  # agents join within this time, at random moments so that their keyframes are not in step
_QUEUE = 128

Frames = list[bytes]


class _LoadAgent:
    """One agent: its messages, and arrival times of replies."""

    def __init__(
        self, context: zmq.Context[Any], address: str, made: KeyframeSet, index: int, count: int
    ) -> None:
        walker = Walker(made, index)
        self.hello = _bytes(walker.hello)
        self.keyframes = [_bytes(k) for k in islice(walker.keyframes(), count)]
        self.pose = _bytes(PoseUpdate(1, TrackState.OK, -1, np.eye(4)))
        self.socket: zmq.Socket[bytes] = context.socket(zmq.DEALER)
        for option in (zmq.SNDHWM, zmq.RCVHWM):
            self.socket.setsockopt(option, _QUEUE)
        self.socket.setsockopt(zmq.LINGER, 500)
        self.socket.setsockopt(zmq.ROUTING_ID, peer_id(walker.hello.run_id))
        self.socket.connect(address)
        self.welcome = False
        self.pings = 0
        self.sent_s: list[float] = []  # of each keyframe
        self.acked_s: list[float] = []
        self.corrected_s: list[tuple[float, int]] = []  # time, answered keyframe
        self.pongs: list[tuple[float, float]] = []  # time of sending, round trip
        self.dropped = 0

    def say(self, frames: Sequence[bytes]) -> None:
        try:
            self.socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.Again:
            self.dropped += 1

    def ping(self, now: float) -> None:
        self.pings += 1
        self.say(_bytes(Ping(self.pings, round(now * 1e9))))

    def keyframe(self, now: float) -> None:
        number = len(self.sent_s)
        self.say(self.keyframes[number])
        self.sent_s.append(now)
        self.say(_bytes(Evaluation(number, 50.0, None)))

    def receive(self, now: float) -> None:
        """Read all replies."""
        while True:
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            _, code, scalars, _ = msgspec.msgpack.decode(frames[0])
            match code:  # docs/lookup/wire.md
                case 16:  # Welcome
                    self.welcome = True
                case 17:  # Refused
                    raise SystemExit(f"load_agents: refused: {scalars[0]}")
                case 18:  # Ack
                    self.acked_s += [now] * (scalars[0] - len(self.acked_s))
                case 19:  # Correction
                    self.corrected_s.append((now, scalars[2]))
                case 21:  # Pong
                    self.pongs.append((scalars[1] * 1e-9, now - scalars[1] * 1e-9))


def main() -> None:
    address, agents, seconds, counted_from = sys.argv[1], *map(float, sys.argv[2:5])
    context: zmq.Context[Any] = zmq.Context()
    made = room()
    count = int(seconds * RATE_HZ) + 2
    all_agents = [_LoadAgent(context, address, made, index, count) for index in range(int(agents))]
    began = time.monotonic()
    cpu = _talk(all_agents, began, seconds, counted_from)
    print(json.dumps(_figures(all_agents, began + counted_from, began + seconds) | {"generator_cpu": cpu}))
    context.destroy(linger=500)


def _talk(all_agents: list[_LoadAgent], began: float, seconds: float, counted_from: float) -> float:
    """Run all agents in real time. Return CPU seconds per second since `counted_from`."""
    poller = zmq.Poller()
    by_socket = {agent.socket: agent for agent in all_agents}
    for agent in all_agents:
        poller.register(agent.socket, zmq.POLLIN)
    offsets = np.random.default_rng(len(all_agents)).uniform(size=len(all_agents))
    join_s = _COMING_S * (np.arange(len(all_agents)) + offsets) / len(all_agents)
    due = [(began + at, i, "hello") for i, at in enumerate(join_s.tolist())]
    heapq.heapify(due)
    cpu_at = 0.0
    while (now := time.monotonic()) < began + seconds:
        if not cpu_at and now >= began + counted_from:
            cpu_at = time.process_time()
            print("counted", file=sys.stderr, flush=True)
        while due[0][0] <= now:
            at, i, what = heapq.heappop(due)
            for later in _act(all_agents[i], what, time.monotonic()):
                heapq.heappush(due, (at + later[0], i, later[1]))
        for socket, _ in poller.poll(max(0, round(1e3 * (due[0][0] - time.monotonic())))):
            by_socket[socket].receive(time.monotonic())
    print("over", file=sys.stderr, flush=True)
    spent = time.process_time() - cpu_at
    sys.stdin.readline()  # until measure_load has read the edge's CPU
    for agent in all_agents:
        agent.say(_bytes(Bye()))
    return spent / (seconds - counted_from)


def _act(agent: _LoadAgent, what: str, now: float) -> list[tuple[float, str]]:
    """Do an action; return actions to repeat, and after how many seconds."""
    match what:
        case "hello" if agent.welcome:
            return [(0.0, "pose"), (0.0, "ping"), (0.1, "keyframe")]
        case "hello":
            agent.say(agent.hello)
            return [(0.5, "hello")]
        case "pose":
            agent.say(agent.pose)
            return [(_POSE_S, what)]
        case "ping":
            agent.ping(now)
            return [(_PING_S, what)]
        case _:
            agent.keyframe(now)
            return [(_KEYFRAME_S, what)]


def _figures(all_agents: list[_LoadAgent], since: float, until: float) -> dict[str, Any]:
    """Return latencies in ms of keyframes and pings sent in the counted time, less its last second."""
    acks: list[float] = []
    corrections: list[float] = []
    pongs: list[float] = []
    halves: tuple[list[float], list[float]] = ([], [])
    sent = answered = received = 0
    for agent in all_agents:
        acks += [1e3 * (b - a) for a, b in zip(agent.sent_s, agent.acked_s, strict=False) if a >= since]
        pongs += [1e3 * trip for at, trip in agent.pongs if at >= since]
        counted = {k for k, at in enumerate(agent.sent_s) if since <= at < until - 1}
        sent += len(counted)
        received += sum(since <= at < until for at, _ in agent.corrected_s)
        first = {k: at for at, k in reversed(agent.corrected_s)}
        for k in counted & first.keys():
            latency = 1e3 * (first[k] - agent.sent_s[k])
            corrections.append(latency)
            halves[agent.sent_s[k] >= (since + until) / 2].append(latency)
            answered += 1
    return {
        "correction_ms": summary(corrections).report(),
        "correction_p95_ms_by_half": [summary(half).report()["p95"] for half in halves],
        "any_correction_ms": summary(list(_until_any(all_agents, since, until))).report(),
        "ack_ms": summary(acks).report(),
        "pong_ms": summary(pongs).report(),
        "keyframes": sent,
        "answered": answered / max(1, sent),
        "corrections_per_s": received / (until - since) / len(all_agents),
        "dropped_by_link": sum(agent.dropped for agent in all_agents),
    }


def _until_any(all_agents: list[_LoadAgent], since: float, until: float) -> Iterator[float]:
    """Yield the time from sending a keyframe to the first correction that answers it or a later one."""
    for agent in all_agents:
        answers = sorted((at, k) for at, k in agent.corrected_s if k >= 0)
        number = 0
        for k, sent in enumerate(agent.sent_s):
            while number < len(answers) and (answers[number][1] < k):
                number += 1
            if number < len(answers) and since <= sent < until - 1:
                yield 1e3 * (answers[number][0] - sent)


def _bytes(message: Any) -> Frames:
    return [bytes(frame) for frame in encode(message)]


if __name__ == "__main__":
    main()
