"""Remove from the frozen program what its libraries bring and SHARE never uses. Figures:
docs/do/freeze.md."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

from stub_library import exported, needed, wanted, write_forward, write_hollow

# Libraries to replace by hollow ones, by their user: video for cv2's VideoCapture, and Pillow's formats other
# than PNG (the only one that matplotlib writes). Their functions report and abort. But cv2 tries AVIF on
# every image that it decodes: that libaom answers that it finds none.
HOLLOW = (
    (["cv2/cv2*.so"], ("libavcodec", "libavformat", "libavutil", "libswscale"), False),
    (["PIL/_imaging.*.so", "pillow.libs/libtiff-*"], ("libjpeg", "libzstd", "liblzma", "libxcb"), False),
    (["opencv_python_headless.libs/libavif-*"], ("libaom",), True),
)
_HASH = re.compile(r"(-[0-9a-f]{8})+(?=\.so)")  # auditwheel's
_ELF = b"\x7fELF"


def slim(inside: Path) -> None:
    """Slim the frozen program. inside: its `_internal`.

    Raises subprocess.CalledProcessError where a tool fails, and what `one_blas` does.
    """
    for patterns, names, answers in HOLLOW:
        users = [user for pattern in patterns for user in inside.glob(pattern)]
        for library in _bundled(inside, names):
            write_hollow(library, wanted(users, library), answers)
    one_blas(inside)
    remove_orphans(inside)
    for binary in binaries(inside):
        strip(binary)
    link_twins(inside)
    remove_dangling(inside)


def one_blas(inside: Path) -> None:
    """Redirect cv2's LAPACK, an OpenBLAS of 39 MB that it uses for large matrices only, to SciPy's.

    Raises KeyError where SciPy's lacks a function, ValueError where there is not one of each.
    """
    (ours,), (theirs,) = _bundled(inside, ("libopenblasp",)), _bundled(inside, ("libscipy_openblas-",))
    symbols = wanted(inside.glob("cv2/cv2*.so"), ours)
    prefix, there = "scipy_", exported(theirs)
    if missing := [name for name in symbols if prefix + name not in there]:
        raise KeyError(f"{theirs.name} has no {', '.join(missing)}; leave cv2 its own OpenBLAS")
    write_forward(ours, symbols, prefix, theirs)


def remove_orphans(inside: Path) -> None:
    """Remove libraries that only the hollowed ones needed."""
    while True:
        asked = {name for binary in binaries(inside) for name in needed(binary)}
        orphans = [path for path in _bundled(inside, ("lib",)) if path.name not in asked]
        if not orphans:
            return
        for path in orphans:
            path.unlink()


def strip(binary: Path) -> None:
    """Strip debugging symbols, if the result still loads.

    `strip` breaks some files that auditwheel has patched.
    """
    trial = binary.with_name(binary.name + ".stripped")
    subprocess.run(["strip", "--strip-unneeded", "-o", trial, binary], check=True, stderr=subprocess.DEVNULL)
    if loadable(trial) and trial.stat().st_size < binary.stat().st_size:
        shutil.copymode(binary, trial)
        trial.replace(binary)
    else:
        trial.unlink()


def loadable(binary: Path) -> bool:
    """Return whether every segment of a 64-bit ELF file has equal offsets in file and memory, modulo a page.
    elf(5)"""
    data = binary.read_bytes()
    (table,), (entries,) = struct.unpack_from("<Q", data, 32), struct.unpack_from("<H", data, 56)
    for k in range(entries):
        kind, _, offset, address, _, _, _, align = struct.unpack_from("<IIQQQQQQ", data, table + 56 * k)
        if kind == 1 and (address - offset) % align:  # PT_LOAD
            return False
    return True


def link_twins(inside: Path) -> None:
    """Replace copies of a library by several wheels (same name but for the hash, same symbols) by links to
    one."""
    first: dict[tuple[str, frozenset[tuple[str, str]]], Path] = {}
    for path in _bundled(inside, ("lib",)):
        key = _HASH.sub("", path.name), frozenset(exported(path).items())
        if (known := first.setdefault(key, path)) is not path:
            path.unlink()
            path.symlink_to(os.path.relpath(known, path.parent))


def remove_dangling(inside: Path) -> None:
    for path in inside.iterdir():
        if path.is_symlink() and not path.exists():
            path.unlink()


def binaries(inside: Path) -> Iterator[Path]:
    """Yield every ELF file."""
    for path in sorted(inside.rglob("*.so*")):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as file:
                if file.read(4) == _ELF:
                    yield path


def _bundled(inside: Path, begin: tuple[str, ...]) -> list[Path]:
    """Return libraries bundled by wheels (NAME.libs) with names that begin with `begin`."""
    return sorted(
        path for path in inside.glob("*.libs/*.so*") if path.name.startswith(begin) and not path.is_symlink()
    )
