"""The headset page in emulated headsets, served by the edge's own server."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import browser
from helpers.room_server import MAP, RoomServer

from share.types import AgentKind, TrackState
from share.view import events as ev
from share.wire.room_messages import Permission

served_page = pytest.importorskip("share.headset.headset_page")
pytestmark = pytest.mark.slow


@contextmanager
def moving(feed: object, names: list[str]) -> Iterator[None]:
    """Poses of devices on heads that walk, thirty times a second."""
    walk, ended = worn.Walk(), threading.Event()
    walk.walks = True
    for name in names:
        feed.add_event(ev.RunArrived(f"{name}-1", name, AgentKind.AR, np.eye(4), (0.8, 0.6)))
        feed.add_event(ev.CorrectionArrived(f"{name}-1", MAP, np.eye(4), 0))

    def move() -> None:
        while not ended.wait(1 / 30):
            now_ns = time.monotonic_ns()
            T, _, _ = walk(time.time() - 0.012)
            for name in names:
                feed.add_event(
                    ev.PoseArrived(f"{name}-1", TrackState.OK, -1, T, 12.0, now_ns - 12_000_000, now_ns)
                )

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as one:
        yield one


def test_two_wearers_share_a_marker(stack, tmp_path, monkeypatch) -> None:
    from helpers.headset_client import code

    from share.headset.wearers import EdgeAccess

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    rows = [f"  - [{', '.join(f'{value:.12g}' for value in row)}]" for row in worn.T_body_viewer]
    mount = tmp_path / "headset.yaml"
    mount.write_text("\n".join(["T_body_viewer:", *rows, ""]))
    mounts = [f"{name}={mount}" for name in ("ann", "ben")]
    edge, chromium = stack.enter_context(RoomServer()), stack.enter_context(browser())
    access = EdgeAccess(edge.address, frozenset(Permission))
    served = stack.enter_context(
        closing(served_page.HeadsetPage("http://127.0.0.1:0", access, mounts=mounts))
    )
    stack.enter_context(moving(served.feed, ["ann", "ben"]))
    pages = []
    for name in ("ann", "ben"):
        page = worn.wear(chromium, f"http://{served.endpoint}/", name, code(served))
        page.evaluate("walks = true")
        page.wait("app.place.mapId !== null && app.alignmentMm !== null")
        pages.append(page)
    for page in pages:
        end = time.monotonic() + 60.0  # on a busy machine the page learns the server's clock slowly
        while True:
            errors = np.array([worn.drawn_error(page) for _ in range(20)])
            if np.median(errors[:, 0]) < 0.01:
                break
            assert time.monotonic() < end, errors
        print("drawn within {:.1f} mm, {:.2f} deg".format(*np.median(errors, 0) * [1e3, 180 / np.pi]))
        page.app(worn.SEEN)
    ann, ben = pages
    worn.drag_marker(ann, 3.0)
    ben.wait("app.room.objects.size === 1")
    late = worn.lateness_ms(ann, ben)
    print(f"drawn by the other after {np.percentile(late, [50, 95]).round(1)} ms, {len(late)} places")
    assert len(late) > 20
    (marker,) = edge.edge.room.report()["objects"].values()
    assert marker["owner"] == "ann" and marker["kind"] == "marker"
    assert ann.problems == ben.problems == []
