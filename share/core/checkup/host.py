"""The computer: its processor, disk, clock and libraries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from share.core.checkup import Finding, fail, ok, skipped, warn

_LEAST_MINUTES, _ENOUGH_MINUTES = 5.0, 60.0
CLOCK_LIMIT_MS = 1.0  # as `share sync check`


def governor(found: Sequence[str], wanted: str, mend: Sequence[str] = ()) -> Finding:
    """found: of each core. wanted: "" where the profile leaves it. mend: what sets it, see `boot.mend`."""
    if not wanted:
        return skipped("CPU governor", "the profile leaves it")
    if not found:
        return skipped("CPU governor", "the cores show none (a container, a virtual machine?)")
    others = sorted(set(found) - {wanted})
    if not others:
        return ok("CPU governor", f"{wanted} on {len(found)} cores")
    count = sum(one != wanted for one in found)
    what = f"{', '.join(others)} on {count} of {len(found)} cores, the profile wants {wanted}"
    return warn("CPU governor", what, *mend)


def throttling(counts: Sequence[int]) -> Finding:
    """counts: how often each core was slowed by heat since it was started."""
    if not counts:
        return skipped("throttling", "the cores count none (not Intel's, or a virtual machine)")
    if not any(counts):
        return ok("throttling", "none since the start")
    what = f"slowed by heat, {max(counts)} times on one core since the start"
    return warn("throttling", what, "cool it better (fan, dust, air), or ask less of it: a lower image rate")


def disk(where: str, free_bytes: int, bytes_s: float) -> Finding:
    """bytes_s: what is written at most, 0 where nothing is recorded."""
    what = f"{where}: {free_bytes / 1e9:.1f} GB free"
    if not bytes_s:
        return ok("disk", what) if free_bytes > 1e9 else fail("disk", what, f"df -h {where}; make room")
    minutes = free_bytes / bytes_s / 60
    what += f", {minutes:.0f} min at {bytes_s / 1e6:.0f} MB/s, the images as they come"
    mend = f"make room (df -h {where}), or give another --out"
    if minutes < _LEAST_MINUTES:
        return fail("disk", what, mend)
    return ok("disk", what) if minutes >= _ENOUGH_MINUTES else warn("disk", what, mend)


def clock(known: tuple[float, float] | None, trouble: str | None) -> Finding:
    """known: offset and the most it is wrong by, ms. trouble: why it is not known, None with `known` None
    where no chronyd runs."""
    if trouble is not None:
        return warn("clock", trouble, "chronyc sources")
    if known is None:
        mend = (
            "sudo apt install chrony",
            "share sync check HOST  # the edge's machine: it says what to tell chrony",
        )
        return warn("clock", "no chronyd runs here: nothing keeps this clock with the others'", *mend)
    offset_ms, uncertainty_ms = known
    what = f"{offset_ms:+.3f} ± {uncertainty_ms:.3f} ms"
    if abs(offset_ms) + uncertainty_ms <= CLOCK_LIMIT_MS:
        return ok("clock", what)
    return warn(
        "clock", f"{what}, should be within {CLOCK_LIMIT_MS:g} ms", "chronyc sources; share sync check HOST"
    )


def clock_of_edge() -> Finding:
    """Others follow it, and it needs to follow none."""
    return ok("clock", "`share sync server` makes it the room's, right or not: devices follow it")


def libraries(found: Mapping[str, str | None], frozen: bool = False) -> Finding:
    """found: by library, why it does not load; None where it does. frozen: whether this is a program that
    brings its own Python, into which nothing can be installed."""
    broken = {name: why for name, why in found.items() if why is not None}
    if not broken:
        return ok("libraries", f"{', '.join(found)} load")
    what = "; ".join(f"{name}: {why}" for name, why in broken.items())
    mend = "pip install --force-reinstall share-slam, for this Python and processor"
    if frozen:
        mend = "put a program here that was frozen on a machine of this kind: make freeze, then tools/deploy"
    return fail("libraries", what, mend)


def port(number: int, free: bool) -> Finding:
    """Where an edge listens unless it is told otherwise."""
    if free:
        return ok("port", f"{number} is free for the edge")
    look = f"ss -ltnp 'sport = :{number}'  # an edge that runs? else: share edge --bind tcp://0.0.0.0:PORT"
    return warn("port", f"something listens at {number} already", look)
