"""Poses for another program."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.errors import UsageError
from share.geometry.se3 import from_rt, matrix_from_quat, so3_exp
from share.recordings.trajectory import read_tum
from share.runtime.pose_feed import PoseFeed


@pytest.fixture
def app() -> Iterator[socket.socket]:
    """Somebody else's program."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(2.0)
        yield listening


def where(app: socket.socket) -> str:
    return f"udp://127.0.0.1:{app.getsockname()[1]}"


def waiting(app: socket.socket) -> Iterator[dict[str, Any]]:
    """What has come and was not read yet."""
    app.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            yield json.loads(app.recv(2000))


def test_a_pose_arrives_as_published(app):
    feed = PoseFeed(where(app), "ann")
    T_odom = from_rt(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, -0.5]))
    T_map = from_rt(so3_exp(np.array([0.0, 0.0, 1.5])), np.array([0.25, 0.0, 3.0]))
    feed.publish(123, "INITIALISING")
    feed.publish(456, "OK", 7.1234, 1, T_odom, T_map, "bob-1/0")
    first, second = (json.loads(app.recv(2000)) for _ in range(2))
    assert first == {
        "schema": 2,
        "agent": "ann",
        "sequence": 0,
        "stamp_ns": 123,
        "age_ms": None,
        "state": "INITIALISING",
        "segment": None,
        "odom": None,
        "map": None,
        "map_id": None,
    }
    assert (second["sequence"], second["stamp_ns"], second["age_ms"]) == (1, 456, 7.123)
    assert (second["segment"], second["map_id"]) == (1, "bob-1/0")
    for reported, T in ((second["odom"], T_odom), (second["map"], T_map)):
        assert np.allclose(reported["position"], T[:3, 3], atol=1e-9)
        assert np.allclose(matrix_from_quat(np.array(reported["quaternion"])), T[:3, :3], atol=1e-8)
    feed.close()


def test_no_receiver_is_needed():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        address = where(gone)
    feed = PoseFeed(address, "ann")
    for stamp_ns in range(100):
        feed.publish(stamp_ns, "LOST")
    feed.close()
    feed.publish(0, "LOST")  # as a socket that has failed


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("127.0.0.1:7000", r"--poses 127\.0\.0\.1:7000: expected udp://HOST:PORT"),
        ("udp://a b:1", "'a b:1' is not an address"),
        ("udp://nobody.invalid:7000", "no such host"),
    ],
)
def test_malformed_feed_addresses_are_refused(address, what):
    with pytest.raises(UsageError, match=what):
        PoseFeed(address, "ann")


@pytest.mark.long
def test_an_agent_publishes_every_pose_that_it_writes(share, app, plain_session, tmp_path):
    """Without an edge: what it has is its odometry."""
    config = tmp_path / "config.yaml"
    config.write_text("agent: {finish_s: 0.1}\n")
    out = tmp_path / "out"
    nobody = ("--edge", "tcp://127.0.0.1:1", "--kind", "ar", "--config", config)
    done = share(
        "agent", f"{plain_session}/ar1", "--name", "ann", *nobody, "--out", out, "--poses", where(app)
    )
    assert done.code == 1, done.err
    reported = list(waiting(app))
    assert [one["sequence"] for one in reported] == list(range(45))
    posed = [one for one in reported if one["odom"] is not None]
    written = read_tum(Path(out) / "odom.tum")
    assert [one["stamp_ns"] for one in posed] == written.stamps_ns.tolist()
    assert np.allclose([one["odom"]["position"] for one in posed], written.T[:, :3, 3], atol=1e-8)
    assert all(0 < one["age_ms"] < 5000 for one in posed)
    assert {one["map"] for one in reported} == {None}
    unknown = [one["state"] for one in reported if one["odom"] is None]
    assert set(unknown) <= {"INITIALISING", "LOST"}
