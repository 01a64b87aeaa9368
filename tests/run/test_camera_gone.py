"""A live camera that is gone for three seconds: the agent's own line, its pose feed and the edge say so
within a second, and that it is back."""

from __future__ import annotations

import json
import socket
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from helpers.capture_bench import quick
from helpers.children import Child
from helpers.room_camera import HZ, STEREO, RoomCamera

from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.sample_queue import NewestImageQueue
from share.config import Config
from share.net.transport import connect
from share.runtime.agent import AgentRun
from share.runtime.pose_feed import PoseFeed
from share.runtime.source import open_source
from share.types import AgentKind
from share.wire.messages import Hello

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.mark.slow
def test_a_disconnected_camera_is_reported_everywhere_within_a_second(
    plain_session: Path, tmp_path: Path
) -> None:
    http, udp = free_port(socket.SOCK_STREAM), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind(("127.0.0.1", 0))
    udp.setblocking(False)
    child = Child(tmp_path / "edge.log", "edge", "--bind", "tcp://127.0.0.1:0", "--http", str(http))
    address = child.wait_for(r"listening on (tcp://\S+?),")[1]
    room, said, lines = RoomCamera(rs, open_source(str(plain_session / "ar1"))), list[str](), list[str]()
    source = LiveSource(room.feed(STEREO, NewestImageQueue(2 * MAX_WAITING_FRAMES), said, quick), HZ)
    hello = Hello("ann", AgentKind.AR, 77, source.rig)
    feed = PoseFeed(f"udp://127.0.0.1:{udp.getsockname()[1]}", "ann")
    run = AgentRun(
        source, hello, Config(), lambda: connect(address, 77), None, said.append,
        lambda status: lines.append(status.state), pose_sinks=[feed],
    )  # fmt: skip
    thread = threading.Thread(target=run.run, daemon=True)

    def shown() -> dict[str, Any]:
        with urllib.request.urlopen(f"http://127.0.0.1:{http}/snapshot.json", timeout=5) as answer:
            return dict(json.load(answer)["agents"]["ann"])

    def reported() -> str:
        state = ""
        while True:
            try:
                state = json.loads(udp.recv(2000))["state"]
            except BlockingIOError:
                return state

    try:
        thread.start()
        time.sleep(1.0)
        end = room.play(lambda: time.sleep(1 / HZ))
        before = shown()
        reported()
        time.sleep(1.0)  # and nothing comes
        gone, datagram = shown(), reported()
        time.sleep(2.0)
        later = shown()
        room.play(lambda: time.sleep(1 / HZ), 100_000 + end)
        back = shown()
    finally:
        run.stop()
        thread.join(20)
        child.kill()
        udp.close()
    assert before["state"] in ("OK", "WEAK") and before["pose_age_ms"] < 1000
    assert (gone["state"], datagram) == ("LOST", "LOST")
    assert "no image for" in gone["reason"] and gone["pose_age_ms"] > 500
    assert later["state"] == "LOST" and later["pose_age_ms"] > 2500
    assert any(line.startswith("LOST, no image for 2.") for line in lines)
    assert back["state"] != "LOST" and back["pose_age_ms"] < 1500
