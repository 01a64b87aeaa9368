"""Read a glTF file and the files that it names, and check their sizes before trimesh loads them.

trimesh builds whatever a file asks for: arrays of any size from nothing, unlimited copies of one buffer,
pictures of any size and format, files anywhere on the disk. This module bounds all of these.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from share.errors import DataError
from share.files.json_file import parse_json
from share.files.reading import MB, path_inside, read_bytes
from share.vision.image_codec import image_header

MAX_TRIANGLES = 300_000
_MAX_BYTES = 500 * MB  # of all files together, of all views of them, of all arrays
_MAX_JSON_BYTES = 50 * MB
_MAX_PARTS = 50_000  # of one kind: nodes, meshes, primitives, accessors …
_MAX_CORNERS = 12 * MAX_TRIANGLES  # trimesh copies them for each part of a mesh
_MAX_DEPTH = 100  # nesting of nodes
_MAX_PIXELS = 2**26  # of one picture; four bytes each when decoded
_MAX_TOTAL_PIXELS = 2 * 10**8  # of all pictures
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_KINDS = ("accessors", "buffers", "bufferViews", "images", "materials", "meshes", "nodes", "textures")
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # bytes of a componentType
_TYPE_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_STRIP, _TRIANGLES = 5, 4
_IGNORED_TYPE = "image/ktx2"  # trimesh ignores it


def read_gltf(path: Path) -> tuple[bytes, dict[str, bytes]]:
    """Return a glTF file and, by name, the files that it names. Raises DataError if they are malformed or too
    large."""
    try:
        data = read_bytes(path, _MAX_BYTES)
        text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, b"")
        if len(text) > _MAX_JSON_BYTES:
            raise ValueError(f"its description has {len(text) / MB:.0f} MB")
        tree = parse_json(text.decode("utf-8-sig"))
        if not isinstance(tree, dict):
            raise ValueError("its description is not an object")
        document = _GltfDocument(path, tree, binary)
        document.check()
        return data, document.files
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}: {error.filename}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, struct.error) as error:
        text_of_error = str(error) if type(error) is ValueError else f"{type(error).__name__} {error}"
        raise DataError(f"{path}: not a readable glTF 2.0 file: {text_of_error:.200}") from None


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """Return the JSON description and the binary chunk of the file."""
    magic, version, _, length, kind = struct.unpack_from("<5I", data)
    if (magic, version, kind) != (_MAGIC, 2, _JSON) or length > len(data) - 20:
        raise ValueError("its header is damaged, or it is truncated")
    text, rest = data[20 : 20 + length], data[20 + length :]
    if len(rest) < 8:
        return text, b""
    length, kind = struct.unpack_from("<2I", rest)
    if kind != _BIN or length > len(rest) - 8:
        raise ValueError("it is truncated")
    return text, rest[8 : 8 + length]


class _GltfDocument:
    """The JSON description and the binary data that it refers to."""

    def __init__(self, path: Path, tree: dict[str, Any], binary: bytes) -> None:
        self._path, self._tree, self._binary = path, tree, binary
        self.files: dict[str, bytes] = {}
        self._views: list[bytes] = []
        self._corners = self._parts = 0

    def check(self) -> None:
        for kind in _KINDS:
            _check_at_most(len(self._list(kind)), _MAX_PARTS, kind)
        buffers = list(self._buffers())
        self._check_views(buffers)
        self._check_accessors()
        self._check_pictures()
        self._check_nodes([self._triangles(mesh) for mesh in self._list("meshes")])

    def _list(self, kind: str) -> list[Any]:
        items = self._tree.get(kind, [])
        if not isinstance(items, list):
            raise ValueError(f"its {kind} are not a list")
        return items

    def _buffers(self) -> Iterator[bytes]:
        for buffer in self._list("buffers"):
            yield self._binary if "uri" not in buffer else self._read_uri(buffer["uri"])

    def _read_uri(self, uri: str) -> bytes:
        if "base64," in uri:
            try:
                return base64.b64decode(uri.partition("base64,")[2])
            except binascii.Error:
                raise ValueError("its binary data is damaged") from None
        if uri not in self.files:
            remaining = _MAX_BYTES - sum(map(len, self.files.values()))
            self.files[uri] = read_bytes(
                path_inside(self._path.parent, unquote(uri), str(self._path)), remaining
            )
        return self.files[uri]

    def _check_views(self, buffers: list[bytes]) -> None:
        """Check buffer views, since trimesh copies each."""
        total = 0
        for view in self._list("bufferViews"):
            start, length = _checked_count(view.get("byteOffset", 0)), _checked_count(view["byteLength"])
            total += length
            _check_at_most(total, _MAX_BYTES, "bytes in views")
            self._views.append(buffers[_checked_count(view["buffer"])][start : start + length])

    def _check_accessors(self) -> None:
        total = 0
        for one in self._list("accessors"):
            total += (
                _checked_count(one["count"])
                * _COMPONENT_BYTES[one["componentType"]]
                * _TYPE_COMPONENTS[one["type"]]
            )
            _check_at_most(total, _MAX_BYTES, "bytes of numbers")

    def _check_pictures(self) -> None:
        total = 0
        for one in self._list("images"):
            if one.get("mimeType") == _IGNORED_TYPE or ("uri" not in one and "bufferView" not in one):
                continue
            data = (
                self._views[_checked_count(one["bufferView"])]
                if "bufferView" in one
                else self._read_uri(one["uri"])
            )
            if (header := image_header(data)) is None:
                raise ValueError("a picture of it is damaged, or neither JPEG nor PNG")
            pixels = header.width * header.height
            total += pixels
            if not 0 < pixels <= _MAX_PIXELS:
                raise ValueError(f"a picture of it is {header.width}x{header.height}")
            _check_at_most(total, _MAX_TOTAL_PIXELS, "pixels")

    def _triangles(self, mesh: Any) -> int:
        self._parts += len(mesh["primitives"])
        _check_at_most(self._parts, _MAX_PARTS, "primitives")
        return sum(map(self._primitive_triangles, mesh["primitives"]))

    def _primitive_triangles(self, part: Any) -> int:
        accessors, mode = self._list("accessors"), part.get("mode", _TRIANGLES)
        corners = count = _checked_count(accessors[_checked_count(part["attributes"]["POSITION"])]["count"])
        if "indices" in part:
            count = _checked_count(accessors[_checked_count(part["indices"])]["count"])
        self._corners += corners + count
        _check_at_most(self._corners, _MAX_CORNERS, "corners in all meshes")
        return {_TRIANGLES: count // 3, _STRIP: max(0, count - 2)}.get(mode, 0)

    def _check_nodes(self, triangles: list[int]) -> None:
        """Check nodes: each has one parent at most and draws a mesh again."""
        nodes = self._list("nodes")
        parent_of: dict[int, int] = {}
        total = 0
        for number, node in enumerate(nodes):
            for child in node.get("children", ()):
                if _checked_count(child) in parent_of or child >= len(nodes):
                    raise ValueError(f"node {child} has two parents, or does not exist")
                parent_of[child] = number
            if "mesh" in node:
                total += triangles[_checked_count(node["mesh"])]
                if total > MAX_TRIANGLES:
                    raise ValueError(f"more than {MAX_TRIANGLES} triangles: simplify it")
        for number in range(len(nodes)):
            ancestor, depth = number, 0
            while ancestor in parent_of:
                ancestor, depth = parent_of[ancestor], depth + 1
                _check_at_most(depth, _MAX_DEPTH, "nodes in each other")


def _checked_count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r:.40} in place of a count")
    return value


def _check_at_most(value: int, limit: int, noun: str) -> None:
    if value > limit:
        raise ValueError(f"it has {value:,} {noun}, at most {limit:,} are read")
