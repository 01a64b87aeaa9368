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


def throttling(counts: Sequence[int], pi: int | None = None) -> Finding:
    """counts: how often each core was slowed by heat since it was started. pi: a Raspberry Pi's own bits."""
    if pi is not None:
        return _pi_throttling(pi)
    if not counts:
        return skipped(
            "throttling", "nobody counts it (neither Intel nor a Raspberry Pi, or a virtual machine)"
        )
    if not any(counts):
        return ok("throttling", "none since the start")
    what = f"slowed by heat, {max(counts)} times on one core since the start"
    return warn("throttling", what, _COOL)


_COOL = "cool it better (fan, dust, air), or ask less of it: a lower image rate"
_SUPPLY = "give it 5.1 V and 3 A by a short, thick cable, or the camera a USB 3 hub with a supply of its own"
_VOLTAGE, _SLOWED, _HOT = 0x1, 0xE, 0x8  # bits of now
_EVER = 16  # by so many they are shifted for "since the start"


def _pi_throttling(bits: int) -> Finding:
    """Bits of the firmware: 0 too little voltage, 1 frequency capped, 2 throttled, 3 soft limit of
    temperature (Raspberry Pi documentation, vcgencmd get_throttled)."""
    now, ever = bits, bits | bits >> _EVER
    if not ever & (_VOLTAGE | _SLOWED):
        return ok("throttling", "none since the start")
    what = []
    if ever & _VOLTAGE:
        what.append(f"its supply {'gives' if now & _VOLTAGE else 'gave'} too little voltage")
    if ever & _SLOWED:
        what.append("it is slowed" if now & _SLOWED else "it was slowed since the start")
    needed = ((_SUPPLY, ever & _VOLTAGE), (_COOL, ever & _HOT or not ever & _VOLTAGE))
    mends = [mend for mend, there in needed if there]
    return warn("throttling", f"{' and '.join(what)} (get_throttled 0x{bits:x})", *mends)


def disk(where: str, free_bytes: int, bytes_s: float, may_write: bool = True) -> Finding:
    """bytes_s: what is written at most, 0 where nothing is recorded. may_write: whether this user may."""
    what = f"{where}: {free_bytes / 1e9:.1f} GB free"
    if not may_write:
        return fail("disk", f"{where}: this user may not write there", "give another --out")
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
        slower = "" if "poselib" in found else "; no poselib for this processor: OpenCV finds places, slower"
        return ok("libraries", f"{', '.join(found)} load{slower}")
    what = "; ".join(f"{name}: {why}" for name, why in broken.items())
    mend = "pip install --force-reinstall share-slam, for this Python and processor"
    if frozen:
        mend = "put a program here that was frozen on a machine of this kind: make freeze, then tools/deploy"
    return fail("libraries", what, mend)


def edge_keys(own: str, let_in: Sequence[str]) -> Finding:
    """own: name of its pair. let_in: names on its list."""
    if let_in:
        return ok("keys", f"{own}; lets in: {', '.join(let_in)}")
    return warn(
        "keys",
        f"{own}; lets in nobody from another machine",
        "share keys authorize NAME 'PUBLIC KEY OF THE AGENT'",
    )


def no_edge_keys(folder: str) -> Finding:
    what = f"{folder}: none; without them it serves this machine alone"
    return warn("keys", what, "share keys generate")


def port(number: int, free: bool) -> Finding:
    """Where an edge listens unless it is told otherwise."""
    if free:
        return ok("port", f"{number} is free for the edge")
    look = f"ss -ltnp 'sport = :{number}'  # an edge that runs? else: share edge --bind tcp://0.0.0.0:PORT"
    return warn("port", f"something listens at {number} already", look)
