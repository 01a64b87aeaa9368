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
from share.geometry.se3 import exp, from_rt, matrix_from_quat, so3_exp, so3_log
from share.net.udp import MAX_DATAGRAM_BYTES
from share.recordings.trajectory import read_tum
from share.runtime.pose import Pose
from share.runtime.pose_feed import PoseFeed, fixed_axes_cov, open_pose_sinks
from share.types import TrackState

V, W = np.array([0.5, -0.25, 0.125]), np.array([0.1, 0.2, -0.3])  # m/s, rad/s


@pytest.fixture
def app() -> Iterator[socket.socket]:
    """Somebody else's program."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(2.0)
        yield listening


def where(app: socket.socket) -> str:
    return f"udp://127.0.0.1:{app.getsockname()[1]}"


def test_origins_are_for_web_pages_alone(app):
    with pytest.raises(UsageError, match="--poses-origin works only with --poses ws://"):
        open_pose_sinks([where(app)], "ann", ["https://app.example"])


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
    cov, map_cov = (np.diag(np.arange(1.0, 7.0)) * scale for scale in (1e-6, 1e-4))
    pose = Pose(456, TrackState.OK, T_odom, T_map, "bob-1/0", 1, V, W, cov, map_cov, 7.1234)
    feed.publish_state(123, TrackState.INITIALISING)
    feed.publish(pose)
    first, second = (json.loads(app.recv(2000)) for _ in range(2))
    assert first == {
        "schema": 3,
        "agent": "ann",
        "sequence": 0,
        "stamp_ns": 123,
        "age_ms": None,
        "state": "INITIALISING",
        "segment": None,
        "odom": None,
        "map": None,
        "map_id": None,
        "edge": None,
    }
    assert (second["sequence"], second["stamp_ns"], second["age_ms"]) == (1, 456, 7.123)
    assert (second["segment"], second["map_id"]) == (1, "bob-1/0")
    assert (second["odom"]["velocity"], second["odom"]["angular_velocity"]) == (V.tolist(), W.tolist())
    for reported, T, sigma2 in ((second["odom"], T_odom, cov), (second["map"], T_map, map_cov)):
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = reported["covariance"]
        position, rotation = upper[:3, :3], upper[3:, 3:]
        R = T[:3, :3]
        assert np.allclose(position, np.triu(R @ sigma2[3:, 3:] @ R.T), rtol=1e-3, atol=1e-9)
        assert np.allclose(rotation, np.triu(R @ sigma2[:3, :3] @ R.T), rtol=1e-3, atol=1e-9)
        assert np.allclose(reported["position"], T[:3, 3], atol=1e-9)
        assert np.allclose(matrix_from_quat(np.array(reported["quaternion"])), T[:3, :3], atol=1e-8)
    feed.close()


@pytest.mark.parametrize(
    ("name", "map_id", "most"),
    [
        ("r" * 64, "b" * 96, 1472),  # of a UDP packet on Ethernet
        ("ä" * 64, "b" * 96, 1472),
        ("ロ" * 64, "ロ" * 64 + "-" + "1" * 31, 1472),
        ("𠮷" * 64, "𠮷" * 96, MAX_DATAGRAM_BYTES),
    ],
)
def test_the_longest_datagram_fits(app, name: str, map_id: str, most: int) -> None:
    feed = PoseFeed(where(app), name)
    T = from_rt(so3_exp(np.array([0.1, -0.2, 0.3])), np.array([-1000.123456789] * 3))
    cov = np.full((6, 6), -1.2345e-10)
    long = (
        2**62,
        TrackState.INERTIAL_ONLY,
        T,
        T,
        map_id,
        10**6,
        -1234.567891 * V,
        -V,
        cov,
        cov,
        12345.678,
        False,
    )
    feed.publish(Pose(*long))
    datagram = app.recv(4000)
    assert len(datagram) <= most and json.loads(datagram)["agent"] == name
    feed.close()


def test_covariance_is_about_the_axes_of_the_frame(rng):
    """By drawing poses: what scatters is position in the frame, and rotation about its axes."""
    root = rng.normal(size=(6, 6)) * 1e-3
    T, cov = from_rt(so3_exp(np.array([0.4, -1.2, 0.9])), np.array([3.0, -2.0, 1.0])), root @ root.T
    drawn = T @ exp(rng.multivariate_normal(np.zeros(6), cov, 20_000))
    turned = so3_log(drawn[:, :3, :3] @ T[:3, :3].T)
    scatter = np.cov(np.hstack([drawn[:, :3, 3], turned]).T)
    expected = fixed_axes_cov(T, cov)
    assert np.allclose(scatter, expected, atol=0.05 * np.abs(expected).max())


def test_no_receiver_is_needed():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        address = where(gone)
    feed = PoseFeed(address, "ann")
    for stamp_ns in range(100):
        feed.publish_state(stamp_ns, TrackState.LOST)
    feed.close()
    feed.publish_state(0, TrackState.LOST)  # as a socket that has failed


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
    # what comes too late to be tracked, as on a busy machine, has the IMU's prediction alone
    tracked = [one["odom"] for one in posed if one["odom"]["velocity"] is not None]
    assert tracked
    assert all(len(one["velocity"]) == len(one["angular_velocity"]) == 3 for one in tracked)
    assert all(len(one["covariance"]) == 21 for one in tracked)
    unknown = [one["state"] for one in reported if one["odom"] is None]
    assert set(unknown) <= {"INITIALISING", "LOST"}
