"""Users' rooms: a file made by trimesh comes back at the right place, size, colour and light."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.errors import DataError, UsageError
from share.lab.emulate.world.build import build_room, draw_materials
from share.lab.emulate.world.gltf import load_gltf
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.occupancy import Occupancy

trimesh: Any = pytest.importorskip("trimesh")

HALVES = np.full((64, 64, 3), 60, np.uint8)
HALVES[:32] = 188  # the upper half; half of the light of 255, by the sRGB curve


def material(**values: Any) -> Any:
    return trimesh.visual.material.PBRMaterial(**values)


def scene() -> Any:
    """8 x 6 x 3 m (y up), its walls facing out as modellers like; a plain box; a picture on a quad."""
    from PIL import Image

    out, move = trimesh.Scene(), trimesh.transformations.translation_matrix
    out.add_geometry(trimesh.creation.box((8, 3, 6)), node_name="walls", geom_name="walls")
    box = trimesh.creation.box((1, 1, 1))
    box.visual = trimesh.visual.TextureVisuals(material=material(baseColorFactor=[255, 255, 0, 255]))
    out.add_geometry(box, node_name="box", geom_name="box", transform=move([2, -1, -1]))
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    quad = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    texture = material(baseColorTexture=Image.fromarray(HALVES))
    quad.visual = trimesh.visual.TextureVisuals(uv=np.array(corners)[:, :2], material=texture)
    out.add_geometry(quad, node_name="quad", geom_name="quad", transform=move([-0.5, -0.5, -2.9]))
    return out


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gltf") / "hall.glb"
    scene().export(path)
    return path


@pytest.fixture(scope="module")
def hall(file: Path) -> Layout:
    return load_gltf(file)


def named(layout: Layout, name: str) -> Any:
    return next(p for p in layout.shell if p.name == name)


def test_y_up_becomes_z_up_with_the_corner_at_the_origin(hall: Layout) -> None:
    assert hall.name == "hall" and hall.size == pytest.approx((8, 6, 3))
    # x 1.5..2.5, y -1.5..-0.5 (up), z -1.5..-0.5 of the file: y of the room is -z
    assert named(hall, "box").bounding_box == pytest.approx(
        np.array([[5.5, 3.5, 0], [6.5, 4.5, 1]]), abs=1e-6
    )


def test_walls_face_inwards_and_things_outwards(hall: Layout) -> None:
    for name, sign in (("walls", -1), ("box", 1)):
        shape = named(hall, name).shape
        away = shape.mesh.vertices - shape.bounding_box.mean(0)
        assert (sign * (away * shape.mesh.normals).sum(1) > 0).all()
        a, b, c = shape.mesh.triangles.swapaxes(0, 1)
        assert ((np.cross(b - a, c - a) * shape.mesh.normals[shape.mesh.faces[:, 0]]).sum(1) > 0).all()


def test_colours_become_linear_gray(hall: Layout) -> None:
    box = draw_materials(named(hall, "box").shape.materials, 0)[0]
    assert box.min() == box.max() == round((0.2126 + 0.7152) * 255)
    quad = draw_materials(named(hall, "quad").shape.materials, 0)[0]
    assert quad[10].mean() == pytest.approx(0.503 * 255, abs=1.5)  # IEC 61966-2-1 of 188
    assert quad[-10].mean() == pytest.approx(0.0452 * 255, abs=1.5)  # of 60


def test_textures_are_upright(hall: Layout) -> None:
    """The upper half of the quad shows the rows of smaller v."""
    mesh = named(hall, "quad").shape.mesh
    high = mesh.vertices[:, 2] > mesh.vertices[:, 2].mean()
    assert mesh.uv[high, 1] == pytest.approx(0) and mesh.uv[~high, 1] == pytest.approx(1)


@pytest.mark.long
def test_the_room_has_free_floor_and_light(hall: Layout) -> None:
    occupancy = Occupancy.from_layout(hall)
    at = np.array([(4.0, 3.0, 1.5), (6.0, 4.0, 0.5)])
    assert occupancy.clearance(at) == pytest.approx([1.5, 0], abs=0.06)
    room = build_room(hall)
    assert room.light_map.max() > 120 and np.median(room.light_map[room.light_map > 0]) > 40


def test_vertex_colours_are_kept_in_steps(tmp_path: Path) -> None:
    room = trimesh.creation.box((4, 3, 4))
    room.visual.vertex_colors = np.tile([128, 128, 128, 255], (8, 1))
    trimesh.Scene(room).export(tmp_path / "gray.glb")
    shape = load_gltf(tmp_path / "gray.glb").shell[0].shape
    picture = draw_materials(shape.materials, 0)[shape.mesh.layer[0]]
    assert picture.mean() == pytest.approx(128, abs=9)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.glb", b"glTF and then nothing", "not a readable glTF"),
        ("a.gltf", b"{", "not a readable glTF"),
        ("a.glb", b"", "not a readable glTF"),
        ("a.obj", b"v 0 0 0", r"expected a glTF file \(.gltf or .glb\)"),
    ],
)
def test_bad_files_give_one_line(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises((DataError, UsageError), match=said) as caught:
        load_gltf(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_cut_file_is_refused(file: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.glb").write_bytes(file.read_bytes()[:900])
    with pytest.raises(DataError, match="not a readable glTF"):
        load_gltf(tmp_path / "cut.glb")


def test_a_file_without_a_room_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        load_gltf(tmp_path / "none.glb")
    trimesh.Scene(trimesh.creation.box((0.08, 0.03, 0.06))).export(tmp_path / "tiny.glb")
    with pytest.raises(DataError, match=r"0.08 x 0.06 x 0.03 m \(z up\) is no room: glTF is in metres"):
        load_gltf(tmp_path / "tiny.glb")
    line = trimesh.load_path(np.array([[0, 0, 0], [1, 1, 1]]))
    trimesh.Scene(line).export(tmp_path / "line.glb")
    with pytest.raises(DataError, match="holds no triangles"):
        load_gltf(tmp_path / "line.glb")


def test_without_trimesh_one_line_names_the_package(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(UsageError, match=r"trimesh is not installed: pip install 'share-slam\[emulate\]'"):
        load_gltf(file)
