"""A release: the frozen program, units, rules and settings, under one name."""

from __future__ import annotations

import gzip
import hashlib
import io
import re
import subprocess
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from share.devices import camera_check, checks
from share.errors import ShareError, UsageError
from share.sensors.profile import load_host_profile, shipped_profiles

HERE = Path(__file__).resolve().parent / "device"
RULES = "deploy/99-share-realsense.rules"
_ELF, _MACHINE = b"\x7fELF", {62: "x86_64", 183: "aarch64"}  # e_machine, elf(5)


@dataclass(frozen=True)
class Release:
    """folder: dist/share. name: VERSION-DIGEST, the digest of all bytes. size: bytes. machine, glibc: of the
    oldest device that can run it; "" and 0 if unknown (2.36 is 36)."""

    folder: Path
    name: str
    size: int
    machine: str
    glibc: int


def read_release(folder: Path) -> Release:
    """Return the release in `folder`. Raises UsageError without a frozen program, ShareError without a
    version."""
    if not (folder / "share").is_file():
        raise UsageError(f"{folder}: no frozen program there; make one with `make freeze`")
    digest, size, machine, glibc = hashlib.sha256(), 0, "", 0
    for name, source in _members(folder):
        data = _content(source)
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
        size += len(data)
        if data[:4] == _ELF:
            machine = machine or _MACHINE.get(int.from_bytes(data[18:20], "little"), "unknown")
            glibc = max(glibc, *(int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", data)), 0)
    return Release(folder, f"{_version(folder)}-{digest.hexdigest()[:8]}", size, machine, glibc)


def write_tar(release: Release, to: IO[bytes], wrote: Callable[[int], None]) -> None:
    """Write a tar.gz of the release. wrote: called with the bytes of each file. Raises OSError of `to`."""
    with (
        gzip.GzipFile(fileobj=to, mode="wb", compresslevel=1) as packed,
        tarfile.open(fileobj=packed, mode="w|") as tar,
    ):
        for name, source in _members(release.folder):
            if isinstance(source, bytes):
                entry = tarfile.TarInfo(name)
                entry.size = len(source)
                tar.addfile(entry, io.BytesIO(source))
            else:
                tar.add(source, name, recursive=False)
            wrote(len(_content(source)) if isinstance(source, bytes) else source.lstat().st_size)


def _members(folder: Path) -> list[tuple[str, Path | bytes]]:
    """Return each member's name in the release and its source; folders are made as needed."""
    program = [path for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file()]
    units = sorted(path for path in HERE.iterdir() if path.suffix in (".service", ".sh"))
    return [
        *((str(path.relative_to(folder)), path) for path in program),
        *((f"deploy/{path.name}", path) for path in units),
        *((f"deploy/{name}.conf", _at_boot(name)) for name in shipped_profiles()),
        (RULES, "".join(f"{rule}\n" for rule in camera_check.UDEV_RULES).encode()),
    ]


def _at_boot(profile: str) -> bytes:
    """Return the boot settings for computers of this profile."""
    host = load_host_profile(profile).host
    head = f"# Of SHARE, for {profile}: docs/do/deploy.md"
    return "".join(
        f"{line}\n" for line in (head, *checks.tmpfiles_lines(host.cpu_governor, host.usbfs_mb))
    ).encode()


def _content(source: Path | bytes) -> bytes:
    if isinstance(source, bytes):
        return source
    return str(source.readlink()).encode() if source.is_symlink() else source.read_bytes()


def _version(folder: Path) -> str:
    """Return the version that `make freeze` wrote; the program may be for another processor than this one."""
    if (folder / "VERSION").is_file():
        text = (folder / "VERSION").read_text(errors="replace").strip()
        if not re.fullmatch(r"[\w.+-]+", text, re.ASCII):
            raise ShareError(
                f"{folder}/VERSION: '{text}' is not a version; make the program again by `make freeze`"
            )
        return text
    try:
        done = subprocess.run([folder / "share", "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise ShareError(
            f"{folder}: has no file VERSION, and its program does not start here ({error}); make it again: "
            "`make freeze` on a machine of the device's kind"
        ) from None
    return done.stdout.split()[-1]
