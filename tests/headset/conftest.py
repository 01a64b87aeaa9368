"""A browser for all tests of the headset page, and a room for each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import Browser, BrowserPage, browser
from helpers.headset_room import HeadsetRoom, still

from share.geometry import se3

BEN = se3.from_rt(
    se3.so3_exp(np.array([0, 0, 2.0])) @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    np.array([2.6, 0.9, 0.05]),
)
BOT = se3.from_rt(
    se3.so3_exp(np.array([0, 0, -0.6])) @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    np.array([3.4, -1.2, -1.37]),
)


@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    with browser() as one:
        yield one


@pytest.fixture(scope="package")
def modules(chromium: Browser) -> Iterator[BrowserPage]:
    """A page whose modules a test calls."""
    with HeadsetRoom({}) as one:
        page = chromium.page(f"{one.url}page.css")  # draws nothing
        chromium.pages.remove(page)
        yield page
        page.close()


@pytest.fixture(autouse=True)
def _closed(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "chromium" in request.fixturenames:
        request.getfixturevalue("chromium").close_pages()


@pytest.fixture
def room() -> Iterator[HeadsetRoom]:
    """Ann, whose headset is emulated, Ben, who stands still, and a robot."""
    agents = {"ann": ("ar", worn.Walk()), "ben": ("ar", still(BEN)), "bot": ("robot", still(BOT))}
    with HeadsetRoom(agents) as one:
        one.mount = worn.T_body_viewer
        yield one
