"""Fixtures of the tests of rooms."""

import pytest
from helpers.smallroom import small_room

from share.lab.emulate.types import DrawableRoom
from share.lab.emulate.world.build import build_room
from share.lab.emulate.world.layout import Layout


@pytest.fixture(scope="session")
def small_layout() -> Layout:
    return small_room()


@pytest.fixture(scope="session")
def built(small_layout: Layout) -> DrawableRoom:
    return build_room(small_layout)
