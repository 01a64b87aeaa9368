"""One attacker, a process: mutated messages of one kind, or (for the control run) valid ones, at a pace.

    python fuzzer.py ADDRESS --corpus FILE --kind KIND --count N --rate R --seed S [--valid --cpu SHARE]
                     [--keys PUBLIC SECRET SERVER] [--peer HEX] [--ring FILE]

Prints JSON at the end: sent, connections, closed, refused, CPU share. It exits 0 even if the edge has died;
the last messages of each connection are then in the ring file. Nothing of `share` is imported.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).parent))

from corpus import KINDS, Corpus, Recorded, write
from mutations import mutate
from raw_wire import Message, RawPeer, pack, unpack

CONNECTIONS, RING, BATCH_S = 4, 400, 0.02
SMALL_POINTS = 12  # of keyframes: it is their fields that are mutated; few bytes, many messages


def own_name(identity: bytes, keys: object) -> str:
    """One of its own, always the same of that routing id; with keys, one that the key may speak for."""
    return f"eve{identity[0] % 20}" if keys else f"eve{identity.hex()[:6]}"


class Speaker(Protocol):
    def send(self, messages: list[Message]) -> None: ...
    def drain(self) -> int: ...
    def close(self) -> None: ...


class CurvePeer:
    """A DEALER with keys, through libzmq: one cannot be more raw than that inside encryption."""

    def __init__(self, address: str, identity: bytes, public: str, secret: str, server: str) -> None:
        import zmq

        self._zmq, self._context = zmq, zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        for option, value in ((zmq.LINGER, 0), (zmq.SNDTIMEO, 3000), (zmq.SNDHWM, 128), (zmq.IMMEDIATE, 1)):
            self._socket.setsockopt(option, value)
        self._socket.setsockopt(zmq.ROUTING_ID, identity)
        self._socket.setsockopt(zmq.CURVE_PUBLICKEY, public.encode())
        self._socket.setsockopt(zmq.CURVE_SECRETKEY, secret.encode())
        self._socket.setsockopt(zmq.CURVE_SERVERKEY, server.encode())
        self._socket.connect(address)

    def send(self, messages: list[Message]) -> None:
        for parts in messages:
            try:
                self._socket.send_multipart(parts)
            except self._zmq.ZMQError as error:
                raise OSError(str(error)) from None

    def drain(self) -> int:
        n = 0
        try:
            for _ in range(1000):
                n += sum(map(len, self._socket.recv_multipart(self._zmq.NOBLOCK)))
        except self._zmq.ZMQError:
            pass
        return n

    def close(self) -> None:
        self._socket.close(0)
        self._context.term()


class Attacker:
    """Keeps its connections up, and sends as the pace allows."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.draw = args, random.Random(args.seed)
        self.corpus = Corpus(args.corpus)
        self.small = _small(self.corpus.by_kind[args.kind], args.kind)
        self.speakers: list[tuple[bytes, Speaker]] = []
        self.ring: deque[Recorded] = deque(maxlen=RING)
        self.counts = {"sent": 0, "bytes_heard": 0, "connections": 0, "closed": 0, "refused": 0}

    def run(self) -> None:
        args, began, spent = self.args, time.monotonic(), time.process_time()
        last_alive = began
        while self.counts["sent"] < args.count and time.monotonic() - began < args.seconds:
            due = min(args.count, int((time.monotonic() - began) * args.rate) + 1)
            if (batch := min(64, due - self.counts["sent"])) > 0 and self._send(batch):
                last_alive = time.monotonic()
            if time.monotonic() - last_alive > 8:
                break  # nobody is there any more
            self._pause(began, spent, due)
        self.counts["seconds"] = round(time.monotonic() - began, 2)
        self.counts["cpu"] = round((time.process_time() - spent) / max(1e-3, time.monotonic() - began), 3)

    def _pause(self, began: float, spent: float, due: int) -> None:
        if self.counts["sent"] < due:
            return
        until = time.monotonic() + BATCH_S
        while time.monotonic() < until:
            behind = self.args.cpu * (time.monotonic() - began) - (time.process_time() - spent)
            if behind <= 0:
                time.sleep(max(0.0, until - time.monotonic()))

    def _send(self, n: int) -> bool:
        """Whether somebody took them."""
        speaker = self._speaker()
        if speaker is None:
            time.sleep(0.2)
            return False
        identity, peer = speaker
        messages = [self._next(identity) for _ in range(n)]
        self.ring += [Recorded(identity, True, parts) for parts in messages]
        try:
            peer.send(messages)
            self.counts["bytes_heard"] += peer.drain()
        except OSError:
            self.counts["closed"] += 1
            self.speakers.remove(speaker)
            peer.close()
            return False
        self.counts["sent"] += n
        return True

    def _speaker(self) -> tuple[bytes, Speaker] | None:
        if len(self.speakers) < CONNECTIONS:
            identity = self._identity()
            try:
                peer = self._dial(identity)
                hello = self.corpus.hello(own_name(identity, self.args.keys), identity)
                if self.args.kind != "hello" or self.args.valid:
                    self.ring.append(Recorded(identity, True, hello))
                    peer.send([hello])
                self.speakers.append((identity, peer))
                self.counts["connections"] += 1
            except OSError:
                self.counts["refused"] += 1
        return self.draw.choice(self.speakers) if self.speakers else None

    def _identity(self) -> bytes:
        if self.args.peer and self.draw.random() < 0.5:
            return bytes.fromhex(self.args.peer)
        return self.draw.randbytes(8)

    def _dial(self, identity: bytes) -> Speaker:
        if self.args.keys:
            return CurvePeer(self.args.address, identity, *self.args.keys)
        return RawPeer(self.args.address, identity)

    def _next(self, identity: bytes) -> Message:
        if self.args.valid:
            return self._valid(identity)
        message = self.draw.choice(self.small)
        if self.args.kind == "hello" and self.draw.random() < 0.3:
            message = self.corpus.hello(f"m{self.draw.randrange(10**6)}", identity)
        return mutate(self.draw, message)

    def _valid(self, identity: bytes) -> Message:
        """What an agent of that kind of message might say as often: for a Frame a pose, a hello its own."""
        kind = {"frame": "pose", "bye": "ping"}.get(self.args.kind, self.args.kind)
        if KINDS[kind] >= 16:
            kind = "ping"
        if kind == "hello":
            return self.corpus.hello(own_name(identity, self.args.keys), identity)
        return self.draw.choice(_small(self.corpus.by_kind[kind][:50], kind))


def _small(messages: list[Message], kind: str) -> list[Message]:
    """Keyframes with few points, as they could well be."""
    if kind != "keyframe":
        return messages
    out = []
    for parts in messages[:200]:
        fields: Any = unpack(parts[0])
        n = min(SMALL_POINTS, fields[3][4][1][0])
        for i, size in ((4, 8), (5, 12), (6, 32)):
            fields[3][i][1][0] = n
            parts = [*parts[: i + 1], parts[i + 1][: n * size], *parts[i + 2 :]]
        out.append([pack(fields), *parts[1:]])
    return out


def arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("address")
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--rate", type=float, default=2000.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--valid", action="store_true")
    parser.add_argument("--cpu", type=float, default=0.0)
    parser.add_argument("--keys", nargs=3)
    parser.add_argument("--peer")
    parser.add_argument("--ring", type=Path)
    return parser.parse_args(argv)


def main() -> None:
    args = arguments(sys.argv[1:])
    attacker = Attacker(args)
    attacker.run()
    if args.ring is not None:
        about = {"attack": f"fuzz {args.kind}", "seed": args.seed, "sent": attacker.counts["sent"]}
        write(args.ring, attacker.ring, about)
    print(json.dumps(attacker.counts))


if __name__ == "__main__":
    main()
