"""Saved rooms come back as they were, or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from share.errors import DataError, UsageError
from share.lab.emulate.types import DrawableRoom
from share.lab.emulate.world.build import build_room
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import box
from share.lab.emulate.world.room_files import load_room, save_room

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def peopled(small_layout: Layout) -> DrawableRoom:
    parts = [
        box((0, 0, 0), (0.4, 0.3, 0.1), Material("rubber")),
        box((0, 0, 0.1), (0.3, 0.3, 0.2), Material("wood")),
    ]
    return build_room(small_layout, {"robot": parts, "ar1": parts[:1]})


def test_a_room_comes_back_whole(peopled: DrawableRoom, tmp_path: Path) -> None:
    save_room(peopled, tmp_path / "a" / "room")
    found = load_room(tmp_path / "a" / "room")
    assert (found.name, found.seed, found.mover_light) == (peopled.name, peopled.seed, peopled.mover_light)
    for key in ("size", "pictures", "light_uv", "light_map"):
        assert np.array_equal(getattr(found, key), getattr(peopled, key))
    assert list(found.agent_parts) == ["robot", "ar1"] and len(found.agent_parts["robot"]) == 2
    for a, b in zip(found.agent_parts["robot"], peopled.agent_parts["robot"], strict=True):
        assert all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("vertices", "uv", "layer", "faces"))
    assert not found.pictures.flags.writeable  # mapped, not copied
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["room"]


def test_movers_count_into_the_pictures_of_the_room(peopled: DrawableRoom, built: DrawableRoom) -> None:
    assert len(peopled.pictures) == len(built.pictures) + 1  # rubber is new, wood is the table's
    assert np.array_equal(peopled.pictures[: len(built.pictures)], built.pictures)
    rubber = int(peopled.agent_parts["ar1"][0].layer[0])
    assert peopled.pictures[rubber].mean() < 60


def test_a_second_writer_changes_nothing(peopled: DrawableRoom, tmp_path: Path) -> None:
    save_room(peopled, tmp_path / "room")
    save_room(replace(peopled, name="other"), tmp_path / "room")
    assert load_room(tmp_path / "room").name == peopled.name
    assert [p.name for p in tmp_path.iterdir()] == ["room"]


def test_a_damaged_room_is_refused_in_one_line(peopled: DrawableRoom, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a complete room"):
        load_room(tmp_path / "none")
    save_room(peopled, tmp_path / "room")
    (tmp_path / "room" / "light_map.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(DataError, match=r"not a complete room .*delete it"):
        load_room(tmp_path / "room")


def test_nothing_is_left_where_it_cannot_be_written(peopled: DrawableRoom, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        save_room(peopled, tmp_path / "file" / "room")
