"""The session folder that `share demo` plays: session.yaml, NAME.mcap and truth/NAME.tum per agent.

A folder under its own name is whole: it is written as `.NAME.partial-PID` and renamed at the end. A
lock keeps two processes from making the same one, and lets the next remove what a killed one left.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path

from share import __version__
from share.emulate.plain.agents import AGENTS, RATE_HZ, calibration
from share.errors import ShareError, UsageError
from share.io.files import atomic_write, writable_dir
from share.io.session import SCHEMA, SESSION

GENERATOR_VERSION = 1  # raise it when any picture, motion or file changes: cached sessions are then made anew

Progress = Callable[[int, int], None]  # frames done, frames in all


def cached_session(
    cache: Path | None = None,
    seconds: float = 20.0,
    seed: int = 0,
    workers: int = 2,
    progress: Progress = lambda done, total: None,
) -> Path:
    """The session of these parameters in `cache` (default: the user's cache), made if it is not there.

    Raises as `make_session`.
    """
    folder = default_cache() if cache is None else cache
    frames = _frames(seconds, seed)
    out = folder / f"room-v{GENERATOR_VERSION}-seed{seed}-{frames}frames"
    if not out.exists():
        with _lock(out):
            if not out.exists():  # nobody else made it while we waited
                _make(out, frames, seed, workers, progress)
    return out


def make_session(
    out: Path,
    seconds: float = 20.0,
    seed: int = 0,
    workers: int = 2,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Make a session in the new folder `out` with `workers` processes at a time.

    Raises UsageError where `out` exists or cannot be written, ShareError where the disk fills up.
    """
    frames = _frames(seconds, seed)
    with _lock(out):
        if out.exists():
            raise UsageError(f"{out}: exists already; give the name of a new folder")
        _make(out, frames, seed, workers, progress)
    return out


def default_cache() -> Path:
    """$XDG_CACHE_HOME/share, or ~/.cache/share (XDG Base Directory Specification)."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".cache") / "share"


def _make(out: Path, frames: int, seed: int, workers: int, progress: Progress) -> None:
    from share.emulate.plain.parallel import record_all

    for left in out.parent.glob(f".{escape(out.name)}.partial-*"):
        shutil.rmtree(left, ignore_errors=True)
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    try:
        (partial / "truth").mkdir(parents=True)
        record_all(partial, frames, seed, workers, progress)
        atomic_write(partial / SESSION, _description(frames, seed))
        partial.rename(out)
    except OSError as error:
        raise ShareError(f"{out}: the session cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _frames(seconds: float, seed: int) -> int:
    """How many frames each agent gets. Raises UsageError for what cannot be made."""
    if not 1 <= seconds <= 3600:
        raise UsageError(f"{seconds:g} seconds: a session lasts 1 to 3600 seconds")
    if seed < 0:
        raise UsageError(f"seed {seed}: must not be negative")
    return round(seconds * RATE_HZ)


def _description(frames: int, seed: int) -> str:
    """session.yaml. A stamp in an agent's files is session time + clock_offset_ns."""
    import yaml

    agents = {
        agent.name: {
            "kind": agent.kind.value,
            "sensors": agent.rig.kind,
            "rate_hz": RATE_HZ,
            "clock_offset_ns": 0,
            "calibration": calibration(agent.rig),
        }
        for agent in AGENTS
    }
    provenance = {
        "generator": "share.emulate",
        "generator_version": GENERATOR_VERSION,
        "share_version": __version__,
        "seed": seed,
        "frames": frames,
    }
    data = {"schema": SCHEMA, "provenance": provenance, "agents": agents}
    return str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None))


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Only one process makes a session in a folder at a time; others wait. The lock is on the folder
    itself, so nothing is left behind, and the system releases it if we are killed."""
    import fcntl

    handle = os.open(writable_dir(out.parent), os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
