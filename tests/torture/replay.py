"""Sends a reproducer, or any recorded traffic, to a running edge again.

    python tests/torture/replay.py FILE tcp://H:P [--last N] [--keys PUBLIC SECRET SERVER]
    python tests/torture/replay.py FILE --shrink OUT

Each peer of the file gets a connection with its routing id; messages go in their order. With --shrink an edge
(with a map file) is started for each try, and the fewest messages that end it, or bring a traceback into
its log, are sought by halving and written to OUT.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import corpus
from corpus import Recorded
from fuzzer import CurvePeer, Speaker
from raw_wire import RawPeer

PATIENCE_S = 2.5  # after the last message


def send(messages: list[Recorded], address: str, keys: list[str] | None = None) -> int:
    """How many were taken."""
    peers: dict[bytes, Speaker] = {}
    taken = 0
    for message in messages:
        try:
            if message.peer not in peers:
                peers[message.peer] = (
                    CurvePeer(address, message.peer, *keys) if keys else RawPeer(address, message.peer)
                )
            peers[message.peer].send([message.parts])
            peers[message.peer].drain()
            taken += 1
        except OSError:
            peers.pop(message.peer, None)
    for peer in peers.values():
        time.sleep(0.02)
        peer.close()
    return taken


def ends_an_edge(messages: list[Recorded]) -> bool:
    """Whether an edge of their own is dead after them, or has said a traceback."""
    from harness import EdgeProgram, Setup, ended

    with tempfile.TemporaryDirectory() as folder:
        edge = EdgeProgram(Path(folder), Setup(map=True))
        with ended(edge):
            send(messages, edge.address)
            end = time.monotonic() + PATIENCE_S
            while time.monotonic() < end and edge.running:
                time.sleep(0.05)
            bad = not edge.running or "Traceback" in edge.said or "mapper died" in edge.said
            return bad or edge.interrupt() != 0


def shrink(
    messages: list[Recorded], fails: Callable[[list[Recorded]], bool], tries: int = 60
) -> list[Recorded]:
    """Fewer of them that still fail (delta debugging), within so many tries."""
    parts = 2
    while len(messages) > 1 and tries > 0:
        size = max(1, len(messages) // parts)
        for at in range(0, len(messages), size):
            tries -= 1
            left = messages[:at] + messages[at + size :]
            if left and fails(left):
                messages, parts = left, max(2, parts - 1)
                break
        else:
            if size == 1:
                break
            parts = min(len(messages), 2 * parts)
    return messages


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("address", nargs="?")
    parser.add_argument("--last", type=int, default=0, help="only the last N messages")
    parser.add_argument("--keys", nargs=3)
    parser.add_argument("--shrink", type=Path)
    args = parser.parse_args()
    about, messages = corpus.read(args.file)
    messages = [m for m in messages if m.up][-args.last :]
    if args.shrink is None:
        print(f"{send(messages, args.address, args.keys)} of {len(messages)} messages sent")
        return
    if not ends_an_edge(messages):
        sys.exit(f"{len(messages)} messages do not end an edge")
    fewest = shrink(messages, ends_an_edge)
    corpus.write(args.shrink, fewest, about | {"shrunk_from": len(messages)})
    print(f"{len(fewest)} of {len(messages)} messages end it: {args.shrink}")


if __name__ == "__main__":
    main()
