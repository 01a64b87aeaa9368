"""A small fuzzer of files: valid recordings, calibrations and maps, damaged by chance, each read in a child
process with bounds on memory and time. A run ends well with a result or a ShareError, else with a complaint.

    python tests/helpers/file_fuzzer.py SECONDS [SEED [NAME,NAME]]
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from helpers.file_seeds import seeds

from share.errors import ShareError

MEMORY = 3 * 2**30  # of addresses: Python, OpenCV and NumPy take 1.5 of them
SECONDS = 30  # of CPU time, for one case
EXTREMES = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-300", "0", "-1", "9223372036854775807", "-9223372036854775808",  # noqa: E501
    "18446744073709551616", "1000000000000", "", "x", "9" * 400, "[", "{", "&a", "*a", "../../x", "/dev/zero",
    "\0", "1e9", "0.1", "'", "!!int", "true", "~",
)  # fmt: skip


# ------------------------------------------------------------------ damage


def damage(path: Path, rng: np.random.Generator) -> str:
    """One file of `path`, damaged in one to three ways; what was done."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    text = [p for p in files if p.suffix in (".yaml", ".csv", ".txt", ".tum", ".json", ".jsonl", ".gltf")]
    pool = text if text and rng.random() < 0.6 else files
    file = pool[int(rng.integers(len(pool)))]
    said = []
    for _ in range(int(rng.integers(1, 4))):
        if not file.is_file() or file.is_symlink():
            break
        way = _WAYS[int(rng.integers(len(_WAYS)))] if rng.random() < 0.9 else _SPECIAL[int(rng.integers(2))]
        way(file, rng)
        said.append(way.__name__)
    return f"{file.name}: {', '.join(said)}"


def flip(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    for _ in range(int(rng.integers(1, 20)) if data else 0):
        data[int(rng.integers(len(data)))] = int(rng.integers(256))
    file.write_bytes(data)


def cut(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(rng.integers(len(data) + 1))])


def _part(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    a, b = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    return a, min(b, a + 5000)


def remove(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    a, b = _part(data, rng)
    file.write_bytes(data[:a] + data[b:])


def double(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    a, b = _part(data, rng)
    file.write_bytes(data[:b] + data[a:b] * int(rng.integers(1, 50)) + data[b:])


def move(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    a, b = _part(data, rng)
    at = int(rng.integers(len(data) + 1))
    rest = data[:a] + data[b:]
    file.write_bytes(rest[:at] + data[a:b] + rest[at:])


def extreme(file: Path, rng: np.random.Generator) -> None:
    """A number, of text or of eight bytes, becomes one that nobody expects."""
    data = file.read_bytes()
    found = list(re.finditer(rb"-?[\d.]+(e-?\d+)?", data)) if b"\0" not in data else []
    if found:
        for _ in range(int(rng.integers(1, 4))):
            match = found[int(rng.integers(len(found)))]
            new = EXTREMES[int(rng.integers(len(EXTREMES)))].encode()
            data = data[: match.start()] + new + data[match.end() :]
            found = list(re.finditer(rb"-?[\d.]+(e-?\d+)?", data))
            if not found:
                break
    elif len(data) > 8:
        at = int(rng.integers(len(data) - 8))
        value = (2**64 - 1, 2**63, 2**40, 2**32 - 1, 0, 1)[int(rng.integers(6))]
        data = data[:at] + value.to_bytes(8, ("little", "big")[int(rng.integers(2))]) + data[at + 8 :]
    file.write_bytes(data)


def nest(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    at = int(rng.integers(len(data) + 1))
    file.write_bytes(data[:at] + (b"[", b"{a: ", b"- ", b"'", b"?")[int(rng.integers(5))] * 3000 + data[at:])


def row(file: Path, rng: np.random.Generator) -> None:
    """One message of an SDK recording, damaged as a file is: SQLite sees nothing of it."""
    if file.suffix != ".db3":
        return flip(file, rng)
    with (
        contextlib.suppress(sqlite3.Error, TypeError, ValueError),  # it is damaged already
        contextlib.closing(sqlite3.connect(file)) as connection,
    ):
        (last,) = connection.execute("SELECT max(id) FROM messages").fetchone()
        number = int(rng.integers(1, last + 1))
        (data,) = connection.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
        part = file.with_name("message")
        part.write_bytes(data)
        (flip, cut, remove, double, extreme)[int(rng.integers(5))](part, rng)
        connection.execute("UPDATE messages SET data = ? WHERE id = ?", (part.read_bytes(), number))
        connection.commit()
        part.unlink()
    return None


def shuffle(file: Path, rng: np.random.Generator) -> None:
    lines = file.read_bytes().splitlines(keepends=True)
    a, b = sorted(int(k) for k in rng.integers(0, len(lines) + 1, 2))
    part = lines[a:b]
    rng.shuffle(part)  # type: ignore[arg-type]
    file.write_bytes(b"".join(lines[:a] + part + lines[b:]))


def endless(file: Path, rng: np.random.Generator) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def pipe(file: Path, rng: np.random.Generator) -> None:
    file.unlink()
    os.mkfifo(file)


_WAYS = (flip, flip, cut, remove, double, move, extreme, extreme, extreme, nest, shuffle, row, row)
_SPECIAL = (endless, pipe)


# ------------------------------------------------------------------ a case, and many


def attempt(read: Callable[[Path], None], path: Path) -> tuple[str, str]:
    """`well`, `refused`, or `failed` and how. The child's CPU time and memory are bounded."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        _bound()
        sys.stderr = sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        try:
            read(path)
            reported = "well"
        except ShareError as error:
            reported = (
                "failed\nmore than a line" if "\n" in str(error) and len(str(error)) > 3000 else "refused"
            )
        except BaseException:
            reported = "failed\n" + traceback.format_exc()
        os.write(writer, reported.encode()[:60_000])
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as answer:
        reported = answer.read().decode(errors="replace")
    _, status = os.waitpid(child, 0)
    if not reported:
        return "failed", f"ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else "ended"
    how, _, why = reported.partition("\n")
    return how, why


def _bound() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(2 * SECONDS)  # it waits for something


def fuzz(
    seconds: float,
    seed: int,
    keep: Path | None = None,
    only: str = "",
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[Counter[str], list[str]]:
    """Cases for so long (CPU time of children): how many ended how, and what failed. only: names of `seeds`,
    with commas between."""
    counts: Counter[str] = Counter()
    failures: list[str] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        root = Path(name)
        wanted = only.split(",")
        made = {what: found for what, found in seeds(root).items() if only == "" or what in wanted}
        for what, (read, path) in made.items():
            how, why = attempt(read, _copied(path, root / "case"))
            assert how == "well" or what in ("mcap", "session", "euroc", "tum"), f"{what}: {how} {why}"
        number = 0
        began_s = _spent()
        while _spent() - began_s < seconds and not stopped():
            what = list(made)[number % len(made)]
            rng = np.random.default_rng([seed, number])
            case = _copied(made[what][1], root / "case")
            done = damage(case, rng)
            began = time.monotonic()
            how, why = attempt(made[what][0], case)
            counts[f"{what} {how}"] += 1
            if how == "failed":
                took = time.monotonic() - began
                failures.append(f"{what} seed {seed} number {number} ({done}), {took:.1f} s: {why}")
                print(failures[-1], flush=True)
                if keep is not None:
                    shutil.rmtree(keep / f"{seed}-{number}", ignore_errors=True)
                    shutil.copytree(root / "case", keep / f"{seed}-{number}", symlinks=True, ignore=_no_pipes)
            number += 1
    return counts, failures


def _no_pipes(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_fifo()]


def _spent() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _copied(path: Path, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    copy = folder / path.name
    if path.is_dir():
        shutil.copytree(path, copy)
    else:
        shutil.copyfile(path, copy)
    return copy


if __name__ == "__main__":
    stop: list[object] = []
    signal.signal(signal.SIGINT, lambda *_: stop.append(True))
    reported, failed = fuzz(
        float(sys.argv[1]),
        int(sys.argv[2]) if len(sys.argv) > 2 else 1,
        Path(tempfile.mkdtemp(prefix="fuzz-kept-")),
        "".join(sys.argv[3:4]),
        lambda: bool(stop),
    )
    print(dict(sorted(reported.items())))
    sys.exit(bool(failed))
