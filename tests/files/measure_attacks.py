"""What each attack by a file costs the program that reads it, as a process of its own: memory and CPU time.

    python tests/files/measure_attacks.py [NAME …]

A table in Markdown, on standard output: the exit code, the most memory (MB), CPU time (s), and what was said.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import lz4.frame
import zstandard
from helpers.made_db3 import make_db3
from helpers.made_gltf import tree, write
from helpers.map_changes import small_map
from helpers.onnx_bytes import ints, node, number, small_error_model, tensor
from helpers.recordings import make_euroc, make_tum

from share.store.map_store import MapStore

CPU_S, MEMORY = 60, 8 * 10**9  # where a run is ended
Attack = Callable[[Path], list[str]]
VIEW = (
    "CREATE VIEW {} AS WITH RECURSIVE r(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM r) SELECT x AS number,"
    " x AS id, 'schema' AS name, '3' AS value, 1 AS topic_id, 1 AS timestamp, x'' AS data, 0 AS crc FROM r"
)


def nothing(folder: Path) -> list[str]:
    """To compare with: a recording of 30 small frames that is whole."""
    return ["track", str(make_tum(folder / "room", frames=30))]


def deep_yaml(folder: Path) -> list[str]:
    room = make_euroc(folder / "room")
    (room / "mav0/cam0/sensor.yaml").write_text("a: " + "[" * 100_000)
    return ["track", str(room)]


def aliases(folder: Path) -> list[str]:
    room = make_euroc(folder / "room")
    lines = "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    (room / "mav0/cam0/sensor.yaml").write_text("a: &a [1,1,1,1,1,1,1,1,1]\n" + lines)
    return ["track", str(room)]


def png(width: int, height: int, rows: int | None = None) -> bytes:
    """rows: how many there are, whatever it says."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    packer = zlib.compressobj()
    there = height if rows is None else rows
    packed = b"".join(packer.compress(bytes(width + 1)) for _ in range(there)) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def image(data: bytes) -> Attack:
    def made(folder: Path) -> list[str]:
        room = make_tum(folder / "room", frames=30)
        (room / "depth/2.png").write_bytes(data)
        (room / "rgb/2.jpg").write_bytes(data)
        return ["track", str(room)]

    return made


def special(name: str, make: Callable[[Path], object]) -> Attack:
    def made(folder: Path) -> list[str]:
        room = make_tum(folder / "room", frames=30)
        (room / name).unlink()
        make(room / name)
        return ["track", str(room)]

    return made


def hollow(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(3 * 10**9)


def chunk(compression: str) -> Attack:
    """2 GB in an MCAP file of one chunk."""

    def made(folder: Path) -> list[str]:
        pack = (
            zstandard.ZstdCompressor().compressobj()
            if compression == "zstd"
            else lz4.frame.LZ4FrameCompressor()
        )
        parts = [pack.begin()] if compression == "lz4" else []
        parts += [pack.compress(bytes(10**7)) for _ in range(210)]
        data = b"".join([*parts, pack.flush()])
        body = (
            struct.pack("<QQQI", 0, 10, 21 * 10**8, 0)
            + struct.pack("<I", len(compression))
            + compression.encode()
        )
        body += struct.pack("<Q", len(data)) + data
        head = struct.pack("<BQ", 1, 8) + bytes(8)
        (folder / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + head + struct.pack("<BQ", 6, len(body)) + body)
        return ["dataset", "recover", str(folder / "a.mcap"), "--out", str(folder / "b.mcap")]

    return made


def _altered(path: Path, statements: Iterable[str]) -> list[str]:
    import sqlite3

    with contextlib.closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()
    return ["dataset", "info", str(path)]


def map_file(*statements: str) -> Attack:
    def made(folder: Path) -> list[str]:
        path = folder / "map.sqlite"
        with MapStore.open(path) as store:
            store.write(small_map(12, points=10))
        return _altered(path, statements)

    return made


def sdk(*statements: str) -> Attack:
    def made(folder: Path) -> list[str]:
        return _altered(make_db3(folder / "a.db3"), statements)

    return made


def room(changes: dict[str, object]) -> Attack:
    def made(folder: Path) -> list[str]:
        path = write(folder, tree() | changes)
        out = str(folder / "out")
        return ["emulate", "--scene", str(path), "--motion", "walk:", "--seconds", "3", "--out", out]

    return made


def picture(width: int) -> Attack:
    def made(folder: Path) -> list[str]:
        (folder / "wall.png").write_bytes(png(width, width))
        changes = tree() | {"images": [{"uri": "wall.png"}], "textures": [{"source": 0}]}
        changes["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        changes["meshes"][0]["primitives"][0] |= {"material": 0}
        changes["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 2
        changes["accessors"].append(changes["accessors"][0] | {"type": "VEC2"})
        return room(changes)(folder)

    return made


def model(data: Callable[[], bytes]) -> Attack:
    def made(folder: Path) -> list[str]:
        (folder / "m.onnx").write_bytes(data())
        (folder / "c.yaml").write_text(f"agent: {{error_model: {folder}/m.onnx}}\n")
        source, config = str(make_tum(folder / "room", frames=30)), str(folder / "c.yaml")
        return [
            "agent",
            source,
            "--name",
            "ann",
            "--kind",
            "ar",
            "--edge",
            "tcp://127.0.0.1:9",
            "--config",
            config,
        ]

    return made


def outer() -> bytes:
    """What is made of weights alone is made when a network is opened."""
    long = 30_000
    weights = [tensor("row", [1, long], [0.0] * long), tensor("column", [long, 1], [0.0] * long)]
    return using(node("Add", ["row", "column"], "y"), weights)


def sized() -> bytes:
    return using(node("ConstantOfShape", ["big"], "y"), [ints("big", [10**9])])


def using(layer: bytes, weights: list[bytes]) -> bytes:
    """An error model that needs the largest of what `layer` makes."""
    most = node("ReduceMax", ["y"], "most", number("keepdims", 0))
    added = node("Add", ["said", "most"], "log_error")
    return small_error_model(more=[layer, most, added], weights=weights, first="said")


ZEROS = {"componentType": 5126, "count": 60_000, "type": "MAT4"}
ATTACKS: dict[str, Attack] = {
    "nothing: a recording of 30 small frames": nothing,
    "YAML: 100,000 lists in each other": deep_yaml,
    "YAML: aliases that stand for 9⁹ values": aliases,
    "PNG of 65,500²": image(png(65_500, 65_500, 1)),
    "PNG of 30,000², whole": image(png(30_000, 30_000)),
    "image: link to /dev/zero": special("rgb/2.jpg", lambda path: path.symlink_to("/dev/zero")),
    "image: pipe": special("rgb/2.jpg", os.mkfifo),
    "calibration: link to /dev/zero": special("camera.yaml", lambda path: path.symlink_to("/dev/zero")),
    "list: pipe": special("rgb.txt", os.mkfifo),
    "list: 3 GB of holes": special("rgb.txt", hollow),
    "MCAP: chunk of 2.1 GB, zstd": chunk("zstd"),
    "MCAP: chunk of 2.1 GB, lz4": chunk("lz4"),
    "map: `about` is a view without end": map_file("DROP TABLE about", VIEW.format("about")),
    "map: `keyframe` is a view without end": map_file("DROP TABLE keyframe", VIEW.format("keyframe")),
    ".db3: `topics` is a view without end": sdk("DROP TABLE topics", VIEW.format("topics")),
    ".db3: `messages` is a view without end": sdk("DROP TABLE messages", VIEW.format("messages")),
    ".db3: data are computed, 900 MB each": sdk(
        "CREATE TABLE m(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(900000000)))",
        "INSERT INTO m SELECT id, topic_id, timestamp FROM messages",
        "DROP TABLE messages",
        "ALTER TABLE m RENAME TO messages",
    ),
    "glTF: an array of 6 GB out of nothing": room({"accessors": [ZEROS | {"count": 10**8}]}),
    "glTF: 1,500 arrays of 4 MB out of nothing": room({"accessors": [ZEROS] * 1500}),
    "glTF: texture of 13,000²": picture(13_000),
    "network: adds 30,000 numbers row to column": model(outer),
    "network: 10⁹ numbers out of a shape": model(sized),
}


def measured(arguments: list[str]) -> tuple[str, float, float, str]:
    """How it ended, MB, s, and the last line that it said."""

    def bound() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))

    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "share", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            preexec_fn=bound,
        )
        timer = subprocess.Popen(["sh", "-c", f"sleep 120; kill -9 {process.pid}"])
        _, status, used = os.wait4(process.pid, 0)
        timer.kill()
        timer.wait()
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    how = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"{os.WEXITSTATUS(status)}"
    return how, used.ru_maxrss / 1e3, used.ru_utime + used.ru_stime, lines[-1] if lines else ""


def main(names: list[str]) -> None:
    print("| attack | exit code | MB at most | CPU s | last line |\n|---|---|---|---|---|")
    for name, attack in ATTACKS.items():
        if names and name not in names:
            continue
        folder = Path(tempfile.mkdtemp(prefix="attack-"))
        try:
            how, mb, seconds, said = measured(attack(folder))
        finally:
            shutil.rmtree(folder)
        said = said.replace(str(folder), "…").replace("|", "/")
        print(f"| {name} | {how} | {mb:.0f} | {seconds:.1f} | {said:.160} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
