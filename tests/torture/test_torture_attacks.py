"""Attacks that are no fuzz (`attacks.py`), each against an edge with two honest agents."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import harness
import pytest
import siege
from attacks import ATTACKS
from harness import SETUPS, EdgeProgram, Program, Result, Setup
from image_attacks import IMAGE_ATTACKS

SEED = 20261126


@dataclass(frozen=True)
class Case:
    """How an attack is made. keys_of: whose keys it has, where the edge wants some."""

    setup: Setup = SETUPS[0]
    said_bytes: int = siege.SAID_BYTES
    keys_of: str = "eve"
    suspicion: str = ""  # what the edge has to say of the attacker's keyframes


MAP, KEYS = Setup(map=True), Setup(map=True, keys=True)
CASES = {name: Case() for name in ATTACKS if name != "streamed-hellos"} | {
    "leaps": Case(MAP),
    "far": Case(MAP),
    "burst": Case(MAP),
    "replay": Case(MAP),
    "flood-keyframe": Case(MAP),
    "strangers": Case(KEYS, keys_of="mallory"),
    "image-bombs": Case(MAP, suspicion="px"),
    "damaged-images": Case(MAP, suspicion="its image is damaged"),
    "false-spans": Case(MAP, suspicion="off its steps"),
    "odometry-elsewhere": Case(MAP),
    "false-loops": Case(MAP),
    "flood-image": Case(KEYS),
    "four-agents": Case(KEYS),
    "client-hellos": Case(KEYS),
    "client-objects": Case(KEYS),
    "client-places": Case(KEYS),
}
ALSO = [
    ("reset-while-full", Case(KEYS)),
    ("leaps", Case()),
    ("hello-storm", Case(KEYS)),
    ("replay", Case(KEYS)),
]


def attacked(name: str, case: Case, seconds: float, traffic: Path, tmp_path: Path) -> siege.Stay:
    def attack(edge: EdgeProgram) -> Program:
        more = ["--http", edge.http] if edge.http else []
        more += ["--keys=" + " ".join(edge.keys.of(case.keys_of))] if edge.keys else []
        how = (
            "--corpus",
            traffic,
            "--seconds",
            max(seconds, 40.0) if name == "burst" else seconds,
            "--seed",
            SEED,
        )
        return siege.python("attacks.py", tmp_path / "attack.log", name, edge.address, *how, *more)

    return siege.stay(tmp_path / name, case.setup, attack, most_s=3 * seconds + 90)


def run(name: str, case: Case, seconds: float, traffic: Path, tmp_path: Path, results: Path) -> siege.Stay:
    result = Result(name, str(case.setup), SEED)
    stay = attacked(name, case, seconds, traffic, tmp_path)
    siege.judge(result, stay, said_bytes=case.said_bytes)
    if name in IMAGE_ATTACKS:
        siege.judge_steps(result, stay)
        siege.judge_map(result, stay)
    if case.suspicion:
        siege.judge_suspicion(result, stay, case.suspicion)
    if name == "burst":
        result.expect(
            stay.attack.get("acknowledged") == 800,
            f"of 800 at once {stay.attack.get('acknowledged')} acknowledged",
        )
    if name == "hijack":
        result.expect(not stay.attack.get("run_id_shown"), "/snapshot.json shows what a run is known by")
    result.write(results).check()
    return stay


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "case"), [*CASES.items(), *ALSO], ids=lambda v: v if isinstance(v, str) else str(v.setup)
)
def test_attack_short(name: str, case: Case, traffic: Path, tmp_path: Path, results: Path) -> None:
    run(name, case, 8.0, traffic, tmp_path, results)


@pytest.mark.torture
@pytest.mark.parametrize(
    ("name", "case"), [*CASES.items(), *ALSO], ids=lambda v: v if isinstance(v, str) else str(v.setup)
)
def test_attack_long(name: str, case: Case, traffic: Path, tmp_path: Path, results: Path) -> None:
    run(name, case, 20.0, traffic, tmp_path, results)


@pytest.mark.slow
def test_a_flood_of_images_delays_others_little(traffic: Path, tmp_path: Path, results: Path) -> None:
    """By at most twice what as many agents within their rate do."""
    result = Result("flood of images", str(KEYS), SEED)
    flood = attacked("flood-image", Case(KEYS), 12.0, traffic, tmp_path)
    control = attacked("four-agents", Case(KEYS), 12.0, traffic, tmp_path)
    siege.judge_latency(result, flood, control, ratio=2.0, slack_ms=300.0)
    result.write(results).check()


@pytest.mark.slow
def test_agents_that_want_to_be_tracked_come_in_a_storm(traffic: Path, tmp_path: Path, results: Path) -> None:
    """Each that the edge tracks has a process: as many as the machine bears, and no more."""
    result = Result("streamed hellos", "streamed", SEED)
    edge = EdgeProgram(tmp_path / "edge", Setup(), policy="streamed")
    watch = harness.Watch(edge.process.pid, edge.http).start()
    how = ("--corpus", traffic, "--seconds", 10.0, "--seed", SEED)
    attack = siege.python("attacks.py", tmp_path / "attack.log", "streamed-hellos", edge.address, *how)
    with harness.ended(edge, attack):
        attack.process.wait(60)
        watch.stop()
        alive, pids = edge.running, harness.family(edge.process.pid)
        code = edge.interrupt()
    result.figures = {"processes": watch.processes(), "rss_mb": watch.rss_mb(), "attack": attack.said[-300:]}
    result.expect(alive and code == 0, f"exit code {code}: {edge.said[-200:]}")
    result.expect(watch.processes() <= 4 + 2 * (os.cpu_count() or 1), f"{watch.processes()} processes")
    result.expect(watch.rss_mb()[1] < 1200, f"{watch.rss_mb()[1]:.0f} MB")
    result.expect(not harness.left_of(pids), "processes left behind")
    result.write(results).check()
