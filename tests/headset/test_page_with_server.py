"""The headset page in emulated headsets, served by the edge's own server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import Browser

pytest.importorskip("share.headset.headset_page")
from helpers.served_room import ServedRoom, served_room, wear

pytestmark = pytest.mark.slow


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServedRoom]:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with served_room(tmp_path) as one:
        yield one


def test_two_wearers_share_a_marker(chromium: Browser, served: ServedRoom) -> None:
    ann, ben = (wear(chromium, served, name) for name in ("ann", "ben"))
    for page in (ann, ben):
        page.app(worn.SEEN)
    worn.drag_marker(ann, 3.0)
    ben.wait("app.room.objects.size === 1")
    late = worn.lateness_ms(ann, ben)
    print(f"drawn by the other after {np.percentile(late, [50, 95]).round(1)} ms, {len(late)} places")
    assert len(late) > 20
    (marker,) = served.edge.edge.room.report()["objects"].values()
    assert marker["owner"] == "ann" and marker["kind"] == "marker"
    assert ann.app(
        "[...app.room.agents.values()].every((one) => one.sigmaM === 0.006 && one.sigmaRad === 0.002)"
    )
    assert ann.problems == ben.problems == []
