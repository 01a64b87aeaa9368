"""Malicious glTF files are refused in one line, soon, in little memory."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.made_gltf import DATA, tree, write
from helpers.special_files import KINDS, special

from share.errors import DataError, ShareError
from share.lab.emulate.world.gltf import load_gltf
from share.lab.emulate.world.gltf_file import read_gltf

pytest.importorskip("trimesh")

pytestmark = pytest.mark.usefixtures("soon")


def glb(folder: Path, made: Any, data: bytes = DATA, length: int | None = None) -> Path:
    text = json.dumps(made).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<2I", len(text) if length is None else length, 0x4E4F534A) + text
    body += struct.pack("<2I", len(data), 0x004E4942) + data
    (folder / "room.glb").write_bytes(struct.pack("<3I", 0x46546C67, 2, 12 + len(body)) + body)
    return folder / "room.glb"


def test_the_unchanged_room_is_read(tmp_path):
    assert load_gltf(write(tmp_path, tree())).size == pytest.approx((4, 5, 3))
    inner = tree()
    del inner["buffers"][0]["uri"]
    assert load_gltf(glb(tmp_path, inner)).size == pytest.approx((4, 5, 3))
    inner["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(DATA).decode()
    assert load_gltf(write(tmp_path, inner)).size == pytest.approx((4, 5, 3))
    inner["buffers"][0]["uri"] = "of%20mine/room.bin"
    (tmp_path / "of mine").mkdir()
    (tmp_path / "of mine/room.bin").write_bytes(DATA)
    assert load_gltf(write(tmp_path, inner)).size == pytest.approx((4, 5, 3))


def bomb(kind: str, **values: Any) -> dict[str, Any]:
    made = tree()
    made[kind][0] |= values
    return made


def many(kind: str, count: int, one: Any) -> dict[str, Any]:
    return tree() | {kind: [one] * count}


ZEROS = {"componentType": 5126, "count": 10**12, "type": "MAT4"}
PART = {"attributes": {"POSITION": 0}, "indices": 1}
ATTACKS = {
    "an array out of nothing": (tree() | {"accessors": [ZEROS]}, "bytes of numbers"),
    "many arrays out of nothing": (many("accessors", 10_000, ZEROS | {"count": 10**5}), "bytes of numbers"),
    "a count that is none": (bomb("accessors", count=-1), "-1 in place of a count"),
    "a count of 10^400": (json.dumps(tree()).replace('"count": 8', f'"count": 1{"0" * 400}'), "is not a"),
    "a count that is infinite": (json.dumps(tree()).replace('"count": 8', '"count": 1e999'), "is not a"),
    "NaN": (json.dumps(bomb("nodes", translation=[float("nan"), 0, 0])), "NaN is not a valid number"),
    "many views of one buffer": (
        many("bufferViews", 50_000, {"buffer": 0, "byteLength": 10**5}),
        "bytes in views",
    ),
    "a stride": (bomb("bufferViews", byteStride=10**12), "AssertionError|stride"),
    "more triangles than are drawn": (
        tree() | {"nodes": [{"mesh": 0}] * 40_000, "scenes": [{"nodes": list(range(40_000))}]},
        "more than 300000 triangles",
    ),
    "many meshes": (many("meshes", 30_000, {"primitives": [PART] * 2}), "primitives"),
    "many meshes of the same corners": (
        many("meshes", 1000, {"primitives": [PART]}) | {"accessors": [ZEROS | {"count": 4000}] * 2},
        "corners in all",
    ),
    "a node below itself": (bomb("nodes", children=[0]), "nodes in each other"),
    "a node below two": (
        tree() | {"nodes": [{"mesh": 0}, {"children": [0]}, {"children": [0]}]},
        "node 0 has two parents",
    ),
    "nodes in each other": (
        tree() | {"nodes": [{"mesh": 0}, *({"children": [k]} for k in range(5000))]},
        "nodes in each other",
    ),
    "more nodes than any room has": (many("nodes", 60_000, {}), "60,000 nodes"),
    "nesting": (json.dumps(tree())[:-1] + ', "extras": ' + "[" * 100_000, "nested too deeply"),
    "nothing": ("[]", "is not an object"),
    "other types": (tree() | {"meshes": 5}, "are not a list"),
    "an index of none": (bomb("meshes", primitives=[{"attributes": {"POSITION": 7}}]), "IndexError"),
    "bytes beyond the buffer": (bomb("bufferViews", byteOffset=10**6), "glTF"),
    "corners that are not there": (
        tree() | {"accessors": [tree()["accessors"][0] | {"count": 2}, tree()["accessors"][1]]},
        "glTF",
    ),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", ATTACKS)
def test_a_file_that_is_too_large_is_refused(tmp_path, name):
    made, says = ATTACKS[name]
    with pytest.raises(DataError, match=says) as error:
        load_gltf(write(tmp_path, made))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "/etc/passwd", "%2e%2e/secret.bin", "a/../../secret.bin", "a\0b"]
)
@pytest.mark.parametrize("kind", ["buffers", "images"])
def test_files_elsewhere_are_not_read(tmp_path, uri, kind):
    (tmp_path / "secret.bin").write_bytes(DATA)
    (tmp_path / "room").mkdir()
    made = tree()
    made[kind] = [{"uri": uri, "byteLength": 1}]
    with pytest.raises(DataError, match="is not a file name below"):
        read_gltf(write(tmp_path / "room", made))


@pytest.mark.parametrize("kind", KINDS)
def test_a_path_that_is_no_regular_file_is_refused(tmp_path, kind):
    path = write(tmp_path, tree())
    (tmp_path / "room.bin").unlink()
    special(tmp_path / "room.bin", kind)
    with pytest.raises(DataError, match="not a regular file"):
        load_gltf(path)
    path.unlink()
    special(path, kind)
    with pytest.raises(ShareError):
        load_gltf(path)


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (_png(60_000, 60_000), "a picture of it is 60000x60000"),
        (_png(0, 5), "a picture of it is 0x5"),
        (b"GIF89a" + bytes(100), "neither JPEG nor PNG"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n", "neither JPEG nor PNG"),
        (_png(64, 64)[:-20], "glTF"),
    ],
    ids=["huge", "empty", "GIF", "EPS", "cut short"],
)
def test_invalid_pictures_are_refused(tmp_path, data, says):
    made = tree()
    (tmp_path / "wall.png").write_bytes(data)
    made |= {"images": [{"uri": "wall.png"}], "textures": [{"source": 0}]}
    made["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    made["meshes"][0]["primitives"][0] |= {"material": 0}
    made["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
    made["accessors"].append(made["accessors"][0] | {"type": "VEC2"})
    with pytest.raises(DataError, match=says):
        load_gltf(write(tmp_path, made))
    (tmp_path / "wall.png").write_bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    assert load_gltf(write(tmp_path, made))


def test_the_total_size_of_pictures_is_limited(tmp_path):
    (tmp_path / "wall.png").write_bytes(_png(8000, 8000))
    with pytest.raises(DataError, match="pixels"):
        read_gltf(write(tmp_path, tree() | {"images": [{"uri": "wall.png"}] * 10}))


@pytest.mark.parametrize("length", [2**32 - 1, 10**6, 3])
def test_a_chunk_with_a_wrong_length_is_refused(tmp_path, length):
    with pytest.raises(DataError, match="not a readable glTF"):
        load_gltf(glb(tmp_path, tree(), length=length))
