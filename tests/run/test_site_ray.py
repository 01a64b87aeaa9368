"""`share site --ray`, on nodes that are killed with rooms on them: the rooms answer again on another, and
nothing that was acknowledged is lost. Needs Ray."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.children import Child
from helpers.crowd import EVERY, Script, Walker, script
from helpers.edge_sim import Person, walls
from helpers.ray_nodes import RayNodes, memory_mb

from share.mapping.map_changes import StoredMap
from share.store.map_store import MapStore

NAMES = tuple("abcde")  # of rooms and who is in them
ALL_SENT_AND_KEPT = "edge: {max_keyframes: 100000, policy: covins-g}\n"  # as in test_edge_killed
FOUND_S = 60.0


def until(what: str, condition: Any, seconds: float = FOUND_S) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.02)


def start_site(folder: Path, ray: str) -> tuple[Child, str]:
    rooms = "".join(f"  {name}: {{map: {name}.sqlite, agents: [{name}]}}\n" for name in NAMES)
    (folder / "rooms.yaml").write_text(f"rooms:\n{rooms}")
    (folder / "share.yaml").write_text(ALL_SENT_AND_KEPT)
    files = "--rooms", str(folder / "rooms.yaml"), "--config", str(folder / "share.yaml")
    out = "--bind", "tcp://127.0.0.1:0", "--out", str(folder / "out")
    site = Child(folder / "site.log", "site", *files, *out, "--ray", ray)
    return site, site.wait_for(r"listening on (tcp://\S+?),", 60)[1]


def start_walkers(address: str, frames: int) -> list[Walker]:
    place = walls(1)
    people = [Person(name, place, 0.5 * i, 11 * (i + 1)) for i, name in enumerate(NAMES)]
    scripts = [to_and_fro(script(person, 301), frames) for person in people]
    walkers = [Walker(p.hello, way, address) for p, way in zip(people, scripts, strict=True)]
    for walker in walkers:
        walker.start()
    for walker in walkers:
        until(f"{walker.name} is corrected", lambda w=walker: w.lives and w.lives[-1].corrected)
    return walkers


def finish(walkers: list[Walker]) -> None:
    for walker in walkers:
        walker.finish()
    for walker in walkers:
        walker.join(FOUND_S)
        assert not walker.is_alive()
        assert walker.error is None


@pytest.mark.slow
def test_nodes_are_killed_with_rooms_on_them(tmp_path: Path) -> None:
    rounds = 2
    nodes = RayNodes([2, 2])  # eight rooms fit on each
    try:
        for node in nodes.nodes:
            nodes.settle(node)
        site, address = start_site(tmp_path, nodes.address)
        walkers = start_walkers(address, 600 + 400 * rounds)
        memory = [round(memory_mb(nodes.pids(node))) for node in nodes.nodes]
        print(f"MB of two nodes with five rooms: {memory}, of the front: {memory_mb([site.process.pid]):.0f}")
        seconds: list[float] = []
        for i in range(rounds):
            seconds += (took := kill_a_node(nodes, walkers, i))
            print(
                f"kill {i}: {len(took)} rooms, answered again after {np.round(sorted(took), 2)} s", flush=True
            )
        finish(walkers)
        began = time.monotonic()
        assert site.interrupt(90) == 0
        print(f"the site ended after {time.monotonic() - began:.1f} s")
    finally:
        nodes.close()
    for walker in walkers:
        check(walker, tmp_path)
    report = json.loads((tmp_path / "out" / "edge.json").read_text())
    assert report["internal_errors"] == 0
    text = f"median {np.median(seconds):.2f}, p95 {np.quantile(seconds, 0.95):.2f}, most {max(seconds):.2f}"
    print(f"{rounds} kills, {len(seconds)} rooms lost; answered again after s: {text}")


@pytest.mark.slow
def test_the_whole_cluster_is_lost_and_comes_back(tmp_path: Path) -> None:
    """Ray would end a process that has joined a minute after its head is gone: the front goes on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = int(server.getsockname()[1])
    nodes = RayNodes([2], port)
    try:
        nodes.settle(nodes.nodes[0])
        site, address = start_site(tmp_path, nodes.address)
        walkers = start_walkers(address, 2500)
        lives = [len(walker.lives) for walker in walkers]
        nodes.kill_all()
        site.wait_for("the Ray cluster is gone, and all rooms on it", 60)
        time.sleep(75.0)
        assert site.process.poll() is None
        nodes.close()
        nodes = RayNodes([2], port)
        site.wait_for("the Ray cluster is joined again", 120)
        for walker, before in zip(walkers, lives, strict=True):
            until(f"{walker.name} is welcomed", lambda w=walker, n=before: len(w.lives) > n)
            until(f"{walker.name} is corrected", lambda w=walker: w.lives[-1].corrected is not None)
        for walker in walkers:  # of more than a minute
            until(f"all of {walker.name} is kept", lambda w=walker: w.machine.report()["pending"] <= 1, 120.0)
        finish(walkers)
        nodes.kill_all()
        began = time.monotonic()
        assert site.interrupt(60) == 1
        assert "changes are not in the map file" in site.said  # poses after what was acknowledged
        print(f"the site, whose cluster is gone, ended after {time.monotonic() - began:.1f} s")
        assert "FATAL" not in site.said and "rpc_client.h" not in site.said
    finally:
        nodes.close()
    for walker in walkers:
        check(walker, tmp_path)
    assert json.loads((tmp_path / "out" / "edge.json").read_text())["internal_errors"] == 0


def to_and_fro(way: Script, frames: int) -> Script:
    """The same way again and again, which costs nothing to make."""
    turn = len(way.T_odom_body) - 1
    places = [turn - abs(k % (2 * turn) - turn) for k in range(frames)]
    views = {k: way.views[place] for k, place in enumerate(places) if place in way.views}
    return Script([way.T_odom_body[place] for place in places], views)


def kill_a_node(nodes: RayNodes, walkers: list[Walker], number: int) -> list[float]:
    """Return after how many seconds each room that was on it answered again."""
    if len(nodes.nodes) < 2:
        nodes.nodes.append(nodes.add(2))
        nodes.settle(nodes.nodes[-1])
    time.sleep(0.1 * number)
    victim = nodes.nodes.pop(0)  # the one that has the rooms that were lost last
    rooms = [w for w in walkers if is_on(nodes, victim, w.name)]
    lives = {w.name: len(w.lives) for w in rooms}
    began = time.monotonic()
    nodes.kill(victim)
    for walker in rooms:
        until(f"{walker.name} is welcomed", lambda w=walker: len(w.lives) > lives[w.name])
        until(f"{walker.name} is corrected", lambda w=walker: w.lives[-1].corrected is not None)
    nodes.forget(victim)
    return [w.lives[lives[w.name]].welcomed - began for w in rooms]


def is_on(nodes: RayNodes, node: Any, room: str) -> bool:
    """Whether a process of the node has the room's map open."""
    for pid in nodes.pids(node):
        for file in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                if file.readlink().name == f"{room}.sqlite":
                    return True
            except OSError:
                continue
    return False


def check(walker: Walker, folder: Path) -> None:
    """All is acknowledged and in the file, once, as odometry made it; odometry noticed nothing."""
    report = walker.machine.report()
    assert report["pending"] == 0
    assert report["keyframes"] == -(-len(walker.odometry) // EVERY)
    with MapStore.open(folder / f"{walker.name}.sqlite") as store:
        kept: StoredMap = store.load()
    assert kept.problems == ()
    assert [k.keyframe_key.id for k in kept.keyframes] == list(range(report["keyframes"]))
    for k, T in enumerate(walker.odometry):
        assert np.array_equal(T, walker.script.T_odom_body[k])
    for found in kept.keyframes:
        k = EVERY * found.keyframe_key.id
        np.testing.assert_allclose(found.keyframe.T_odom_body, walker.odometry[k], atol=1e-9)
