"""Attacks that are no fuzz: each an idea of its own. A process:

    python attacks.py NAME ADDRESS --corpus FILE [--seconds S] [--count N] [--seed S] [--http URL]
                      [--keys="PUBLIC SECRET SERVER"]

Prints JSON. Nothing of `share` is imported.
"""

from __future__ import annotations

import argparse
import json
import random
import socket
import struct
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from corpus import Corpus
from fuzzer import CurvePeer, _small, own_name
from image_attacks import IMAGE_ATTACKS
from raw_wire import GREETING, LONG, MORE, Message, RawPeer, dial, frame, pack, ready, unpack
from room_attacks import ROOM_ATTACKS

Counts = dict[str, Any]


class Ctx:
    """What an attack knows."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.address, self.draw = args, args.address, random.Random(args.seed)
        self.corpus = Corpus(args.corpus)
        self.counts: Counts = {"sent": 0, "closed": 0, "refused": 0}
        self._end = time.monotonic() + args.seconds

    @property
    def going(self) -> bool:
        return time.monotonic() < self._end

    def peer(self, name: str | None = None, identity: bytes | None = None, hello: bool = True) -> Any:
        identity = identity or self.draw.randbytes(8)
        peer = (
            CurvePeer(self.address, identity, *self.args.keys)
            if self.args.keys
            else RawPeer(self.address, identity)
        )
        if hello:
            peer.send([self.corpus.hello(name or own_name(identity, self.args.keys), identity)])
        return peer

    def keyframe(self, number: int, follows: int, far_m: float = 0.0, points: bool = False) -> Message:
        """A valid one, of that id; relative to the one that it follows."""
        all_of = self.corpus.by_kind["keyframe"]
        header, *arrays = all_of[0] if points else _small(all_of[:2], "keyframe")[1]
        fields: Any = unpack(header)
        fields[2][0], fields[2][1], fields[2][3] = number, follows, follows
        fields[2][2] += 300_000_000 * min(number, 10**6)
        for i in (0, 2):
            T = [float(j % 5 == 0) for j in range(16)]
            T[3] = far_m or (0.05 if i == 0 else 0.05 * min(number, 1000))
            arrays[i] = struct.pack("<16d", *T)
        return [pack(fields), *arrays]

    def send(self, peer: Any, messages: list[Message]) -> bool:
        try:
            peer.send(messages)
            peer.drain()
            self.counts["sent"] += len(messages)
            return True
        except OSError:
            self.counts["closed"] += 1
            peer.close()
            return False


# ------------------------------------------------------------------ values


def leaps(c: Ctx) -> None:
    """Ids that leap: by what an edge may allocate, index or encode."""
    for number in (5 * 10**7, 10**9, 10**12, 2**53, 2**62, 2**63 - 2, 2**63 - 1):
        peer = c.peer()
        c.send(peer, [c.keyframe(0, -1), c.keyframe(number, 0), c.keyframe(1, 0), c.keyframe(number, 1)])
        time.sleep(1.0)
        c.send(peer, c.corpus.by_kind["ping"][:1])
        peer.close()


def far(c: Ctx) -> None:
    """Finite, rigid poses beyond all measure: of a stretch's first keyframe, of a step, and of odometry
    alone while all steps are short; each place is seen twice, so that loops are found there."""
    for power in (4, 5, 6, 9, 12, 30, 77, 153, 154, 200, 300, 307, 308):
        away = 10.0**power if power < 308 else 1.7e308
        for step_m in (None, 0.05, away):
            peer = c.peer()
            chain = [c.keyframe(k, k - 1, away, points=True) for k in range(4)]
            c.send(peer, chain if step_m is None else [chain[0], *(_step(m, step_m) for m in chain[1:])])
            time.sleep(0.15)
            peer.close()


def _step(message: Message, step_m: float) -> Message:
    """That keyframe, but so far from the one before."""
    header, T_ref_body, *others = message
    rows = list(struct.unpack("<16d", T_ref_body))
    rows[3] = step_m
    return [header, struct.pack("<16d", *rows), *others]


def names(c: Ctx) -> None:
    """Honest names of all lengths, and what they may hold, each with a keyframe, so that there is a map."""
    for name in [
        *("n" * n for n in range(54, 66)),
        "é" * 64,
        "日" * 64,
        "a b",
        "<b>",
        "%s",
        "..",
        "~",
        "NUL",
        "-",
        "x" * 64,
    ]:
        peer = c.peer(name)
        time.sleep(0.2)
        c.send(peer, [c.keyframe(k, k - 1, points=True) for k in range(3)])
        time.sleep(0.2)
        c.send(peer, [c.corpus.by_kind["bye"][0]])
        peer.close()


# ------------------------------------------------------------------ form


def never_ending(c: Ctx) -> None:
    """A message whose parts never end."""
    part = frame(bytes(60_000), MORE)
    _stream(c, lambda peer: peer.send_bytes(part * 16), 16 * len(part))


def many_parts(c: Ctx) -> None:
    """One message of 20 million empty parts, over and over."""
    block = frame(b"", MORE) * 500_000
    _stream(c, lambda peer: peer.send_bytes(block), len(block))


def huge_frame(c: Ctx) -> None:
    """Frames that say they are huge, and begin."""
    for size in (64_001, 10**6, 2**31, 2**40, 2**63 - 1, 2**64 - 1):
        for _ in range(20):
            peer = RawPeer(c.address, c.draw.randbytes(8))
            try:
                peer.send_bytes(bytes([LONG]) + struct.pack(">Q", size) + bytes(50_000))
                time.sleep(0.02)
            except OSError:
                c.counts["closed"] += 1
            peer.close()
            c.counts["sent"] += 1


def _stream(c: Ctx, push: Callable[[Any], None], size: int) -> None:
    c.counts["bytes"] = 0
    while c.going:
        try:
            peer = RawPeer(c.address, c.draw.randbytes(8))
            while c.going:
                push(peer)
                c.counts["bytes"] += size
        except OSError:
            c.counts["closed"] += 1
            time.sleep(0.1)


def zmtp_garbage(c: Ctx) -> None:
    """Bytes for a greeting, handshakes cut short, commands out of place, routing ids of all lengths."""
    starts = [
        b"",
        b"\xff",
        GREETING[:11],
        GREETING[:63],
        GREETING,
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(64),
        b"\x01\x00",
    ]
    starts += [GREETING.replace(b"NULL", b"PLAI"), GREETING.replace(b"NULL\0", b"CURVE")]
    while c.going:
        try:
            with dial(c.address) as s:
                s.sendall(c.draw.choice(starts))
                identity = c.draw.randbytes(c.draw.choice((0, 1, 7, 8, 9, 255)))
                s.sendall(c.draw.choice((b"", ready(identity), ready(b"x" * 8)[:9], c.draw.randbytes(300))))
                for _ in range(c.draw.randrange(5)):
                    body = c.draw.choice(
                        (
                            b"\x04PING\xff\xff",
                            b"\x09SUBSCRIBE",
                            b"\x05ERROR\xff",
                            b"\x00",
                            c.draw.randbytes(40),
                        )
                    )
                    s.sendall(frame(body, c.draw.choice((4, 4, 5, 0, 1, 0x80))))
                if c.draw.random() < 0.5:
                    s.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            c.counts["sent"] += 1
        except OSError:
            c.counts["closed"] += 1
        time.sleep(0.002)


def half_open(c: Ctx) -> None:
    """As many connections as one may have open, which say nothing or half a greeting."""
    held: list[socket.socket] = []
    while c.going:
        try:
            s = dial(c.address, 1.0)
            s.sendall(GREETING[: c.draw.choice((0, 5, 20, 64))])
            held.append(s)
        except OSError:
            c.counts["refused"] += 1
            time.sleep(0.05)
        if len(held) > 900:
            held.pop(0).close()
        time.sleep(0.002)
    c.counts["sent"] = len(held)


def reset_while_full(c: Ctx) -> None:
    """Fills the edge's queue, and is gone by a reset in the middle of it."""
    ping = c.corpus.by_kind["ping"][:1] * 300
    while c.going:
        try:
            peers = [c.peer() for _ in range(4)]
        except OSError:  # closed as soon as it was open: not the end of the attack
            c.counts["refused"] += 1
            time.sleep(0.05)
            continue
        for peer in peers:
            try:
                peer.send([*ping, *[c.keyframe(k, k - 1) for k in range(60)]])
                c.counts["sent"] += 360
            except OSError:
                c.counts["closed"] += 1
        for peer in peers:
            peer.close(reset=True) if isinstance(peer, RawPeer) else peer.close()


# ------------------------------------------------------------------ floods


def flood(kind: str) -> Callable[[Ctx], None]:
    def run(c: Ctx) -> None:
        messages = (_small(c.corpus.by_kind[kind], kind) * 100)[:100]
        peer = c.peer()
        while c.going:
            if not c.send(peer, messages):
                time.sleep(0.2)
                peer = c.peer()

    run.__doc__ = f"Valid messages of one kind ({kind}), as fast as the link takes them."
    return run


def hello_storm(c: Ctx) -> None:
    """Ever new agents, without a pause; and one that streams every so often."""
    while c.going:
        try:
            identity = c.draw.randbytes(8)
            peer = c.peer(hello=False, identity=identity)
            hello = c.corpus.hello(f"s{identity.hex()}", identity)
            fields: Any = unpack(hello[0])
            fields[2][3] = c.draw.random() < 0.3
            c.send(peer, [[pack(fields), *hello[1:]]])
            peer.close()
        except OSError:
            c.counts["refused"] += 1
        time.sleep(0.001)


def streamed_hellos(c: Ctx) -> None:
    """Thirty agents that want to be tracked, and stay."""
    peers = []
    for k in range(30):
        identity = c.draw.randbytes(8)
        hello = c.corpus.hello(f"streamer{k}", identity)
        fields: Any = unpack(hello[0])
        fields[2][3] = True
        peers.append(c.peer(hello=False, identity=identity))
        c.send(peers[-1], [[pack(fields), *hello[1:]]])
    while c.going:
        for peer in peers:
            c.send(peer, c.corpus.by_kind["ping"][:1])
        time.sleep(0.5)


def refused_hellos(c: Ctx) -> None:
    """One connection that asks again and again for a name that is taken."""
    peer = c.peer("hope")
    while c.going:
        identity = c.draw.randbytes(8)
        if not c.send(peer, [c.corpus.hello("hope", identity) for _ in range(50)]):
            time.sleep(0.2)
            peer = c.peer("hope")


def replay(c: Ctx) -> None:
    """All that was recorded, again and again, by new peers and in any order."""
    everything = [m for messages in c.corpus.by_kind.values() for m in messages]
    while c.going:
        peer = c.peer()
        for _ in range(20):
            if not c.send(peer, c.draw.sample(everything, min(50, len(everything)))):
                break
        else:
            peer.close()


def hijack(c: Ctx) -> None:
    """Speaks for an honest agent by what /snapshot.json shows of it."""
    while c.going:
        snapshot = json.loads(urllib.request.urlopen(f"{c.args.http}/snapshot.json", timeout=5).read())
        victim = snapshot["agents"].get("hope", {})
        c.counts["run_id_shown"] = "run_id" in victim
        number = victim.get("run_id", c.draw.getrandbits(63))
        identity = number.to_bytes(8, "big", signed=True)
        peer = c.peer("hope", identity)
        forged = [
            c.keyframe(victim.get("keyframes", 0) + k, victim.get("keyframes", 0) + k - 1) for k in range(3)
        ]
        c.send(peer, [*forged, c.keyframe(10**9, 0), *c.corpus.by_kind["bye"][:1]])
        time.sleep(0.5)
        peer.close()


def burst(c: Ctx) -> None:
    """So many keyframes of one agent at once: all are to be acknowledged. What is not, is sent again, but as
    slowly as an agent would."""
    n = c.args.count
    peer = c.peer("burst")
    time.sleep(1.0)
    for first in range(0, n, 100):
        peer.send([c.keyframe(k, k - 1) for k in range(first, min(n, first + 100))])
    c.counts |= {"sent": n, "resent": 0}
    best, progress_s = 0, time.monotonic()
    while c.going and best < n:
        for parts in peer.hear(1.0):
            fields: Any = unpack(parts[0])
            if fields[1] == 18 and fields[2][0] > best:
                best, progress_s = fields[2][0], time.monotonic()
        c.counts["acknowledged"] = best
        if time.monotonic() > progress_s + 2.0:  # as an agent does, so many at a time
            peer.send([c.keyframe(k, k - 1) for k in range(best, min(n, best + 16))])
            c.counts["resent"] += 16
            progress_s = time.monotonic()
    peer.close()


# ------------------------------------------------------------------ keys


def strangers(c: Ctx) -> None:
    """Handshakes with a key that nobody knows, with the wrong server key, and without any."""
    import zmq

    public, secret, server = c.args.keys
    while c.going:
        own = zmq.curve_keypair() if c.draw.random() < 0.5 else (public.encode(), secret.encode())
        try:
            if c.draw.random() < 0.3:
                RawPeer(c.address, c.draw.randbytes(8), 0.3).close()
            else:
                peer = CurvePeer(c.address, c.draw.randbytes(8), own[0].decode(), own[1].decode(), server)
                time.sleep(0.02)
                peer.close()
            c.counts["sent"] += 1
        except OSError:
            c.counts["refused"] += 1


# ------------------------------------------------------------------ HTTP


def slow_loris(c: Ctx) -> None:
    """Hundreds of clients that ask a byte at a time."""
    held: list[socket.socket] = []
    while c.going:
        while len(held) < 200:
            try:
                s = dial(c.args.http, 1.0)
                s.sendall(b"GET / HTTP/1.1\r\n")
                held.append(s)
            except OSError:
                c.counts["refused"] += 1
                break
        for s in list(held):
            try:
                s.sendall(b"X")
                c.counts["sent"] += 1
            except OSError:
                held.remove(s)
                c.counts["closed"] += 1
        time.sleep(0.2)


def http_garbage(c: Ctx) -> None:
    """Requests that are none: huge heads, wrong lengths, other methods, bytes; pipelined and never read."""
    head = b"GET /snapshot.json HTTP/1.1\r\nHost: localhost\r\n"
    while c.going:
        text = c.draw.choice(
            (
                head + b"X-A: " + b"a" * 200_000 + b"\r\n\r\n",
                head + b"A: b\r\n" * 20_000,
                b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
                b"POST /health HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n" + bytes(1000),
                b"GET /health HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nfffffffff\r\n",
                (head + b"\r\n") * 200,
                b"GET /../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
                b"GET /%00%ff HTTP/9.9\r\n\r\n",
                b"\r\n" * 10_000,
                b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
                c.draw.randbytes(2000),
                b"GET /health HTTP/1.1\r\nHost: evil.example\r\n\r\n",
            )
        )
        try:
            with dial(c.args.http, 1.0) as s:
                s.sendall(text)
                if c.draw.random() < 0.5:
                    s.settimeout(0.2)
                    s.recv(65536)
            c.counts["sent"] += 1
        except OSError:
            c.counts["closed"] += 1
        time.sleep(0.005)


ATTACKS: dict[str, Callable[[Ctx], None]] = {
    f.__name__.replace("_", "-"): f
    for f in (
        leaps, far, names, never_ending, many_parts, huge_frame, zmtp_garbage, half_open, reset_while_full,
        hello_storm, streamed_hellos, refused_hellos, replay, hijack, burst, strangers, slow_loris,
        http_garbage,
    )
}  # fmt: skip
ATTACKS |= IMAGE_ATTACKS | ROOM_ATTACKS
ATTACKS |= {f"flood-{kind}": flood(kind) for kind in ("ping", "pose", "evaluation", "keyframe")}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=ATTACKS)
    parser.add_argument("address")
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--count", type=int, default=800)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--http")
    parser.add_argument("--keys", type=str.split)  # one argument: a key may begin with a dash
    c = Ctx(parser.parse_args())
    spent, began = time.process_time(), time.monotonic()
    try:
        ATTACKS[c.args.name](c)
    except OSError as error:  # the edge is no longer there, or does not answer
        c.counts["ended_by"] = str(error)
    c.counts["seconds"] = round(time.monotonic() - began, 2)
    c.counts["cpu"] = round((time.process_time() - spent) / max(1e-3, time.monotonic() - began), 3)
    print(json.dumps(c.counts))


if __name__ == "__main__":
    main()
