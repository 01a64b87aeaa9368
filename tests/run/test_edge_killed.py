"""The edge's processes are killed at random instants under load, and started again on the same file.

What was acknowledged is there, once; agents go on as if nothing had been.
"""

from __future__ import annotations

import json
import os
import random
import signal
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from helpers.children import Child
from helpers.crowd import EVERY, FRAME_S, Walker, crowd

from share.mapping.map_changes import map_poses
from share.store.map_store import MapStore

NAMES = ("ann", "bob", "cy")
# None is taken out for want of room, or withheld by an agent that is late and has a rate: neither is a loss.
ALL_SENT_AND_KEPT = "edge: {max_keyframes: 100000, policy: covins-g}\n"
FOUND_S = 25.0  # after which all that is waited for has come, on a machine that is busy


def start(folder: Path, bind: str) -> tuple[Child, str]:
    """`share edge --map` on the same file as before, and its address."""
    settings = folder / "share.yaml"
    settings.write_text(ALL_SENT_AND_KEPT)
    log = folder / f"edge{len(list(folder.glob('edge*.log')))}.log"
    file, config = str(folder / "room.sqlite"), str(settings)
    edge = Child(log, "edge", "--bind", bind, "--map", file, "--config", config)
    return edge, edge.wait_for(r"listening on (tcp://\S+?),")[1]


def family(pid: int) -> dict[str, int]:
    """The edge's processes by what they are."""
    (mapper,) = _workers(pid)
    (solver,) = _workers(mapper)
    return {"front": pid, "mapper": mapper, "solver": solver}


def _workers(pid: int) -> list[int]:
    """By any of its threads: not the main thread starts one again after a pause."""
    of_threads = Path(f"/proc/{pid}/task").glob("*/children")
    children = [child for file in of_threads for child in file.read_text().split()]
    return [int(c) for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def until(what: str, condition, seconds: float = FOUND_S) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.02)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


class Rounds:
    """Kills, and what came of them."""

    def __init__(self, folder: Path, seed: int, walkers: list[Walker], edge: Child, address: str) -> None:
        self.folder, self.walkers, self.edge, self.address = folder, walkers, edge, address
        self.draw = random.Random(seed)
        self.killed: Counter[str] = Counter()
        self.seconds: dict[str, list[float]] = {"listening": [], "welcomed": [], "corrected": []}
        self.orphans: list[int] = []

    def kill(self, victim: str, after_s: float) -> None:
        time.sleep(after_s)
        lives = [len(w.lives) for w in self.walkers]
        pids: dict[str, int] = {}
        until("all three are there", lambda: pids.update(self._family()) or pids)
        self.killed[victim] += 1
        began = time.monotonic()
        os.kill(pids[victim], signal.SIGKILL)
        if victim == "solver":  # nobody but the mapper notices
            until("a new solver", lambda: self._family().get("solver", pids["solver"]) != pids["solver"])
            assert [len(w.lives) for w in self.walkers] == lives
            return
        if victim == "front":
            self.edge.process.wait()
            self.orphans += [pids["mapper"], pids["solver"]]
            began = time.monotonic()
            self.edge, _ = start(self.folder, self.address)
            self.seconds["listening"].append(time.monotonic() - began)
        for walker, before in zip(self.walkers, lives, strict=True):
            until(f"{walker.name} is welcomed", lambda w=walker, b=before: len(w.lives) > b)
            until(f"{walker.name} is corrected", lambda w=walker: w.lives[-1].corrected is not None)
            self.seconds["welcomed"].append(walker.lives[before].welcomed - began)
            self.seconds["corrected"].append(walker.lives[-1].corrected - began)

    def _family(self) -> dict[str, int]:
        """Nobody while one of them has not begun."""
        try:
            return family(self.edge.process.pid)
        except (ValueError, FileNotFoundError):
            return {}


@pytest.mark.parametrize("rounds", [3, pytest.param(50, marks=pytest.mark.slow)])
def test_killed_at_random_instants_under_load(tmp_path, rounds):
    edge, address = start(tmp_path, "tcp://127.0.0.1:0")
    walkers = crowd(NAMES, address, frames=60 + 120 * rounds)
    began = time.monotonic()
    for walker in walkers:
        walker.start()
    for walker in walkers:
        until(f"{walker.name} is welcomed", lambda w=walker: w.lives)
    run = Rounds(tmp_path, rounds, walkers, edge, address)
    if rounds > 3:
        until("one map", lambda: len({w.maps[-1][1] if w.maps else w.name for w in walkers}) == 1, 90)
    joined = time.monotonic()
    victims = ["front", "mapper", "solver"]
    for i in range(rounds):
        victim = victims[i] if rounds == 3 else run.draw.choice(["front", *victims])
        run.kill(victim, run.draw.uniform(0.0, 1.0 if rounds == 3 else 2.5))
    for walker in walkers:
        walker.finish()
    for walker in walkers:
        walker.join(FOUND_S)
        assert not walker.is_alive()
        assert walker.error is None
    took_s = time.monotonic() - began
    assert run.edge.interrupt() == 0
    check_agents(walkers, took_s)
    check_map(tmp_path / "room.sqlite", walkers)
    if rounds > 3:
        assert len({name for w in walkers for at, name in w.maps if at > joined}) == 1
    until("orphans end", lambda: not [pid for pid in run.orphans if alive(pid)], 10)
    late = [s for w in walkers for s in w.late_s]
    print(f"killed {dict(run.killed)} in {took_s:.0f} s")
    for what, seconds in run.seconds.items():
        median, most = np.median(seconds), max(seconds)
        print(f"{what}: median {median:.2f} s, 95 % {np.quantile(seconds, 0.95):.2f}, most {most:.2f}")
    print(f"frames late: median {1e3 * np.median(late):.1f} ms, 99 % {1e3 * np.quantile(late, 0.99):.1f} ms")
    print("maps:", json.dumps({w.name: sorted({m for _, m in w.maps}) for w in walkers}))


def check_agents(walkers: list[Walker], took_s: float) -> None:
    """Odometry is what was made, to the bit; no frame was left out; everything is acknowledged."""
    for walker in walkers:
        for k, T in enumerate(walker.odometry):
            assert T is walker.script.T_odom_body[k] or np.array_equal(T, walker.script.T_odom_body[k])
        assert len(walker.odometry) >= min(len(walker.script.T_odom_body), (took_s - FOUND_S) / FRAME_S)
        report = walker.machine.report()
        assert report["pending"] == 0
        assert report["keyframes"] == -(-len(walker.odometry) // EVERY)
        assert report["drop_oldest"] == report["drop_rate"] == 0


def check_map(path: Path, walkers: list[Walker]) -> None:
    """Every keyframe that was acknowledged, once, with the pose that odometry gave it."""
    with MapStore.open(path) as store:
        kept = store.load()
    assert kept.problems == ()
    assert len(kept.runs) == len(walkers)
    for walker in walkers:
        own = [k for k in kept.keyframes if k.run_key.startswith(walker.name)]
        assert [k.keyframe_key.id for k in own] == list(range(walker.machine.report()["keyframes"]))
        assert {k.segment_name for k in own} == {f"{own[0].run_key}/0"}
        for found in own:
            np.testing.assert_allclose(
                found.keyframe.T_odom_body, walker.odometry[EVERY * found.keyframe_key.id], atol=1e-9
            )
    maps = {name for name, _ in map_poses(kept).values()}
    print(f"kept: {len(kept.keyframes)} keyframes, {len(kept.loops)} loops, {len(maps)} maps")
