"""One attacker, a process: mutated messages of one kind, or (for the control run) valid ones, at a pace.

    python fuzzer.py ADDRESS --corpus FILE --kind KIND --count N --rate R --seed S [--valid --cpu SHARE]
                     [--keys="PUBLIC SECRET SERVER"] [--peer HEX] [--ring FILE]

Prints JSON at the end: messages sent; with_run, those sent by a run that the edge had welcomed and had not
refused since; connections, closed, unanswered dials; CPU share; how many messages of each kind came back. It
exits 0 even if the edge has died; the last messages of each connection are then in the ring file. Nothing of
`share` is imported.

A run is kept over connections, and says its hello again now and then (a Bye ends it): the edge takes in only
so many new ones, and messages without a run reach little of it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import random
import sys
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).parent))

from corpus import KINDS, UP, Corpus, Recorded, write
from mutations import mutate
from raw_wire import Message, RawPeer, pack, unpack

CONNECTIONS, RING, BATCH_S = 4, 400, 0.02
HELLO_EVERY_S = 0.5  # of a run
NOBODY_S = 60.0  # without a message that was taken, until an attacker gives up
RENEWED = 0.02  # the share of batches before which a connection that mutates hellos is another run's
SMALL_POINTS = 12  # of keyframes: it is their fields that are mutated; few bytes, many messages


def own_name(identity: bytes, keys: object) -> str:
    """One of its own, always the same of that routing id; with keys, one that the key may speak for."""
    return f"eve{identity[0] % 20}" if keys else f"eve{identity.hex()[:6]}"


class Speaker(Protocol):
    def send(self, messages: list[Message]) -> None: ...
    def come(self) -> list[Message]: ...
    def close(self) -> None: ...


@dataclass
class Run:
    """One of the attacker's runs, and the connection that it has at the moment."""

    identity: bytes
    speaker: Speaker | None = None
    welcome: bool = False
    hello_at: float = -math.inf


@dataclass
class Heard:
    """What the edge has said of the room: with it a client's messages get as far as they can."""

    bridge: str  # the name of the attacker's own robot
    number: int = 0  # of requests and commands
    map_id: str | None = None
    objects: tuple[int, int] = (1, 0)  # session, revision
    commands: deque[tuple[int, str]] = field(default_factory=lambda: deque([(0, "")], maxlen=64))

    def take(self, kind: str, parts: Message) -> None:
        """Raises LookupError, TypeError or ValueError for what is no message."""
        scalars: Any = unpack(parts[0])[2]  # type: ignore[index]
        match kind:
            case "object":
                self.map_id = scalars[5]
            case "objects":
                self.objects = scalars[0], scalars[1]
            case "goto" | "cancel":
                self.commands.append((scalars[0], scalars[2]))

    def fill(self, draw: random.Random, kind: str, message: Message) -> Message:
        """A copy of a client's message that is about what there is."""
        fields: Any = unpack(message[0])
        scalars = fields[2]
        self.number += 1
        match kind:
            case "put":
                scalars[:2], scalars[3] = [self.number, draw.randrange(12)], self.map_id
            case "remove":
                scalars[:2] = self.number, draw.randrange(12)
            case "seen":
                scalars[:2] = self.objects
            case "goto":
                scalars[:2], scalars[3] = [self.number, self.bridge], None
            case "cancel":
                scalars[:2] = self.number, self.bridge
            case "state":
                scalars[0], scalars[2] = draw.choice(self.commands)
                scalars[4] = draw.random() < 0.3
        return [pack(fields), *message[1:]]


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
        """Throw away what has come. Return its bytes."""
        return sum(len(part) for message in self.come() for part in message)

    def come(self) -> list[Message]:
        out: list[Message] = []
        with contextlib.suppress(self._zmq.ZMQError):
            while len(out) < 1000:
                out.append(self._socket.recv_multipart(self._zmq.NOBLOCK))
        return out

    def close(self) -> None:
        self._socket.close(0)
        self._context.term()


class Attacker:
    """Keeps its connections up, and sends as the pace allows."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.draw = args, random.Random(args.seed)
        self.corpus = Corpus(args.corpus)
        self.small = _small(self.corpus.by_kind[args.kind], args.kind)
        self.valid = self._said_validly()
        self.runs = [Run(self._identity()) for _ in range(CONNECTIONS)]
        self.room = Heard(own_name(self.runs[0].identity, args.keys))
        self.ring: deque[Recorded] = deque(maxlen=RING)
        self.counts: Counter[str] = Counter(sent=0, with_run=0, connections=0, closed=0, unanswered=0)
        self.heard: Counter[str] = Counter()

    def run(self) -> dict[str, Any]:
        args, began, spent = self.args, time.monotonic(), time.process_time()
        last_alive = began
        while self.counts["sent"] < args.count and time.monotonic() - began < args.seconds:
            due = min(args.count, int((time.monotonic() - began) * args.rate) + 1)
            if (batch := min(64, due - self.counts["sent"])) > 0 and self._send(batch):
                last_alive = time.monotonic()
            if time.monotonic() - last_alive > NOBODY_S:
                break  # nobody is there any more
            self._pause(began, spent, due)
        seconds = time.monotonic() - began
        cpu = (time.process_time() - spent) / max(1e-3, seconds)
        return {**self.counts, "heard": self.heard, "seconds": round(seconds, 2), "cpu": round(cpu, 3)}

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
        run = self.draw.choice(self.runs)
        if self._mutates_hellos and self.draw.random() < RENEWED:
            self._end(run)
            run.identity = self._identity()
        messages = [self._next(run.identity) for _ in range(n)]
        try:
            speaker = self._speaker(run)
            self.ring += [Recorded(run.identity, True, parts) for parts in messages]
            speaker.send(messages)
            self._hear(run, speaker.come())
        except OSError:
            self.counts["closed" if run.speaker else "unanswered"] += 1
            time.sleep(0.0 if run.speaker else 0.2)
            self._end(run)
            return False
        self.counts["sent"] += n
        self.counts["with_run"] += n * run.welcome
        return True

    @property
    def _mutates_hellos(self) -> bool:
        return self.args.kind in ("hello", "client") and not self.args.valid

    def _speaker(self, run: Run) -> Speaker:
        """Its connection, made if it has none. Raises OSError."""
        if run.speaker is None:
            run.speaker, run.hello_at = self._dial(run.identity), -math.inf
            self.counts["connections"] += 1
        if time.monotonic() - run.hello_at > HELLO_EVERY_S and not self._mutates_hellos:
            run.hello_at = time.monotonic()
            hello = self._hello(own_name(run.identity, self.args.keys), run.identity)
            self.ring.append(Recorded(run.identity, True, hello))
            run.speaker.send([hello])
            if self.args.kind in ("state", "place") and run is not self.runs[0]:  # for the robot to answer
                run.speaker.send([self.room.fill(self.draw, "goto", self.corpus.by_kind["goto"][0])])
        return run.speaker

    def _hello(self, name: str, identity: bytes) -> Message:
        """A valid one: of a client for the kinds that only clients send; the first of them drives a robot."""
        if not self._is_client:
            return self.corpus.hello(name, identity)
        header, *arrays = self.corpus.hello(name, identity, "client")
        fields: Any = unpack(header)
        fields[2][2] = self.args.kind in ("state", "place") or identity == self.runs[0].identity
        return [pack(fields), *arrays]

    @property
    def _is_client(self) -> bool:
        return 32 <= KINDS[self.args.kind] < 48

    def _hear(self, run: Run, messages: list[Message]) -> None:
        for parts in messages:
            kind = Recorded(run.identity, False, parts).kind
            self.heard[kind] += 1
            if kind in ("welcome", "refused"):
                run.welcome = kind == "welcome"
            with contextlib.suppress(LookupError, TypeError, ValueError):
                self.room.take(kind, parts)

    def _end(self, run: Run) -> None:
        if run.speaker is not None:
            run.speaker.close()
        run.speaker, run.welcome = None, False

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
        if self._mutates_hellos:
            any_name = f"m{self.draw.randrange(10**6)}"
            name = any_name if self.draw.random() < 0.3 else own_name(identity, self.args.keys)
            message = self._hello(name, identity)
        elif self._is_client:
            message = self.room.fill(self.draw, self.args.kind, message)
        return mutate(self.draw, message)

    def _said_validly(self) -> list[Message]:
        """What an agent of that kind might say as often: for a Frame a pose, for what an edge says a ping."""
        kind = {"frame": "pose", "bye": "ping"}.get(self.args.kind, self.args.kind)
        if kind not in UP:
            kind = "ping"
        return _small(self.corpus.by_kind[kind][:50], kind)

    def _valid(self, identity: bytes) -> Message:
        if self.args.kind in ("hello", "client"):  # its own
            return self._hello(own_name(identity, self.args.keys), identity)
        message = self.draw.choice(self.valid)
        return self.room.fill(self.draw, self.args.kind, message) if self._is_client else message


def _small(messages: list[Message], kind: str) -> list[Message]:
    """Keyframes with few points, as they could well be; one in eight with its image."""
    if kind != "keyframe":
        return messages
    out = []
    for k, parts in enumerate(messages[:200]):
        fields: Any = unpack(parts[0])
        image_bytes = 0 if k % 8 else fields[3][7][1][0]
        for i, size, most in (
            *((i, size, SMALL_POINTS) for i, size in ((4, 8), (5, 12), (6, 32), (8, 8), (9, 12), (10, 4))),
            (7, 1, image_bytes),
        ):
            n = fields[3][i][1][0] = min(most, fields[3][i][1][0])
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
    parser.add_argument("--keys", type=str.split)
    parser.add_argument("--peer")
    parser.add_argument("--ring", type=Path)
    return parser.parse_args(argv)


def main() -> None:
    args = arguments(sys.argv[1:])
    attacker = Attacker(args)
    counts = attacker.run()
    if args.ring is not None:
        about = {"attack": f"fuzz {args.kind}", "seed": args.seed, "sent": counts["sent"]}
        write(args.ring, attacker.ring, about)
    print(json.dumps(counts))


if __name__ == "__main__":
    main()
