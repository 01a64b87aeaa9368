"""An edge with two honest agents beside an attack or beside an equally busy control, and the judgement."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
from harness import EdgeProgram, HonestAgents, Keys, Program, Result, Setup, Watch

SETTLED_S = 3.0  # of the honest agents alone, before anything begins
RSS_MB = 300.0  # by which all processes of the edge together may grow from the attack's beginning on
BAD_WORDS = (
    "JPEG data",
    "JPEG file",
    "Traceback",
    "Warning:",
    "Assertion failed",
    "mapper died",
    "step failed",
    "write failed",
)
STEP_MS = 300.0  # median of a kind of step of the mapper
LONGEST_STEP_MS = 5000.0  # on a machine whose cores others have
MAP_ERROR_M = 0.1  # of the honest agents' places in one map; some cm without an attack
SAID_BYTES = 2_000_000  # log and events together; honest agents of some minutes write a tenth of it


@dataclass
class Stay:
    """What one run of the edge with two honest agents came to."""

    alive_s: float | None  # from the attack's beginning to the edge's death; None: it lived
    exit_code: int | None  # after SIGINT; None: it did not end
    agents: list[dict[str, Any]]
    since: float
    until: float
    rss_mb: tuple[float, float]
    processes: int
    said_bytes: int
    health_ms: list[float]
    health_failed: list[str]
    unwell: list[str]
    log: str
    strays: list[int]
    attack: dict[str, Any]
    map: Path | None
    counts: dict[str, Any]

    def p95(self, what: str) -> float:
        return harness.p95(harness.latencies(self.agents, what, self.since, self.until))


Attack = Callable[[EdgeProgram], Program]


def stay(folder: Path, setup: Setup, attack: Attack, most_s: float = 600.0) -> Stay:
    """Edge, two honest agents, then `attack` until it ends; all ended in good order then."""
    keys = Keys.make(folder / "keys") if setup.keys else None
    edge = EdgeProgram(folder, setup, keys=keys)
    honest = HonestAgents(edge.address, folder / "honest.log", keys)
    watch = Watch(edge.process.pid, edge.http).start()
    with harness.ended(edge, honest):
        honest.wait_for("welcomed")
        time.sleep(SETTLED_S)
        since = time.monotonic()
        attacker = attack(edge)
        died = None
        with harness.ended(attacker):
            while attacker.running and time.monotonic() - since < most_s:
                if died is None and not edge.running:
                    died = round(time.monotonic() - since, 2)
                time.sleep(0.05)
        until = time.monotonic()
        died = died or (None if edge.running else round(until - since, 2))
        unwell = _trouble(edge) if edge.running and edge.http else []
        agents = honest.finish()
        edge.family = harness.family(edge.process.pid) or edge.family
        watch.stop()
        strays_of = edge.family
        code = edge.interrupt() if died is None else edge.process.returncode
    counts = json.loads(report.read_text()) if (report := edge.out / "edge.json").exists() else {}
    return Stay(
        died, code, agents, since, until, watch.rss_mb(since), watch.processes(), edge.bytes_said(),
        watch.health_ms, watch.health_failed, unwell, edge.said, harness.left_of(strays_of),
        _last_json(attacker), edge.map, counts,
    )  # fmt: skip


def _trouble(edge: EdgeProgram) -> list[str]:
    """What /health says is wrong; that does not answer is wrong too."""
    try:
        return list(json.loads(harness.get(f"{edge.http}/health"))["trouble"])
    except (OSError, ValueError) as error:
        return [f"/health: {error}"]


def _last_json(program: Program) -> dict[str, Any]:
    rows = [line for line in program.said.splitlines() if line.startswith("{")]
    return dict(json.loads(rows[-1])) if rows else {"said": program.said[-500:]}


def python(script: str, log: Path, *arguments: object) -> Program:
    return Program(log, [harness.PYTHON, str(harness.HERE / script), *map(str, arguments)])


def judge(result: Result, stay: Stay, rss_mb: float = RSS_MB, said_bytes: int = SAID_BYTES) -> Result:
    """All but the latencies."""
    result.figures |= {
        "attack": stay.attack,
        "rss_mb": [round(x) for x in stay.rss_mb],
        "processes": stay.processes,
        "said_bytes": stay.said_bytes,
        "said_by_health": stay.unwell,
        "health_p95_ms": round(harness.p95(stay.health_ms), 1) if stay.health_ms else None,
        "ack_p95_ms": round(stay.p95("acked"), 1),
        "correction_p95_ms": round(stay.p95("corrected"), 1),
        "edge_died_after_s": stay.alive_s,
        "exit_code": stay.exit_code,
    }
    died = (
        "" if stay.alive_s is None else f"the edge ended after {stay.alive_s} s, exit code {stay.exit_code}"
    )
    result.expect(stay.alive_s is None, f"{died}: {_last_line(stay.log)}")
    result.expect("said" not in stay.attack, f"the attacker itself failed: {stay.attack}")
    if stay.alive_s is None:
        code = "it did not end" if stay.exit_code is None else f"exit code {stay.exit_code}"
        result.expect(stay.exit_code == 0, f"in the end, or before: {code}: {_last_line(stay.log)}")
        unwell = [
            line for line in stay.unwell if "refused" not in line
        ]  # that is the attack, and is to be said
        result.expect(not unwell, f"/health: {unwell}")
        result.expect(
            not stay.health_failed,
            f"/health failed {len(stay.health_failed)} times: {stay.health_failed[:1]}",
        )
    for word in BAD_WORDS:
        (*_, line) = ["", *(line for line in stay.log.splitlines() if word in line)]
        result.expect(not line, f"in the log: {line.strip()[:200]}")
    grown = stay.rss_mb[1] - stay.rss_mb[0]
    result.expect(grown < rss_mb, f"the edge's processes grew by {grown:.0f} MB")
    result.expect(stay.said_bytes < said_bytes, f"log and events grew to {stay.said_bytes / 1e6:.1f} MB")
    result.expect(not stay.strays, f"left behind: processes {stay.strays}")
    _judge_keyframes(result, stay)
    return result


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1][:300]


def _judge_keyframes(result: Result, stay: Stay) -> None:
    """Each once: all acknowledged, and all in the map's file, or counted by the edge."""
    for agent in stay.agents:
        name, made, acked = agent["name"], agent["keyframes"], len(agent["acked"])
        result.expect(agent["error"] is None, f"{name}: {agent['error']}")
        result.expect(made > 0, f"{name}: made no keyframe")
        lost = f"{name}: {agent['open']} of {made} keyframes not acknowledged, {agent['drop_oldest']} dropped"
        result.expect(agent["open"] == 0 and agent["drop_oldest"] == 0 and not agent["running"], lost)
        if stay.map is not None:
            kept = harness.kept_ids(stay.map, name)
            result.expect(
                kept[:acked] == list(range(acked)), f"{name}: {acked} acknowledged, {len(kept)} in the file"
            )
        elif stay.counts and not agent["open"]:
            counted = _counted_keyframes(stay.counts["agents"], agent)
            result.expect(counted == made, f"{name}: made {made} keyframes, the edge counted {counted}")


def _counted_keyframes(rows: dict[str, Any], agent: dict[str, Any]) -> int:
    """Return the keyframes that edge.json counts for the agent's run. Its name may have passed to an attacker
    when it left, so the row is found by the run's public tag."""
    prefix = f"{agent['name']}-"
    own = [
        row
        for row in rows.values()
        if (tag := row["run"].removeprefix(prefix)) != row["run"] and agent["tag"].startswith(tag)
    ]
    return sum(row["keyframes"] for row in own)


def judge_steps(result: Result, stay: Stay) -> None:
    """No kind of step of the mapper takes long."""
    for kind in ("describe", "place", "align", "verify", "solve"):
        ms = stay.counts.get(f"{kind}_ms", {})
        result.figures[f"{kind}_ms"] = [ms.get(key) for key in ("n", "p50", "max")]
        usual, longest = ms.get("p50") or 0.0, ms.get("max") or 0.0
        result.expect(usual < STEP_MS, f"{kind}: {usual:.0f} ms in the median")
        result.expect(longest < LONGEST_STEP_MS, f"{kind}: {longest:.0f} ms once")


def judge_map(result: Result, stay: Stay) -> None:
    """The honest agents are in one map, where they are in truth."""
    error_m = stay.agents[0]["joint_error_m"]
    result.figures["joint_error_m"] = error_m
    result.expect(error_m < MAP_ERROR_M, f"the honest agents are {error_m:.3g} m off in the map")


def judge_suspicion(result: Result, stay: Stay, word: str) -> None:
    """The edge said what is wrong with an attacker's keyframes."""
    rows = stay.counts.get("agents", {}).values()
    said = [row["last_suspicion"] for row in rows if row["last_suspicion"]]
    result.figures["suspicion"] = said[:1]
    result.expect(any(word in line for line in said), f"nobody was suspected of {word!r}: {said[:2]}")


def judge_latency(result: Result, attacked: Stay, control: Stay, ratio: float, slack_ms: float) -> None:
    """p95 <= max(ratio x control's, control's + slack_ms)."""
    for what in ("acked", "corrected"):
        mine, theirs = attacked.p95(what), control.p95(what)
        result.figures[f"{what}_p95_ms"] = [round(mine, 1), round(theirs, 1)]
        if theirs == theirs:  # the control had some
            bound = max(ratio * theirs, theirs + slack_ms)
            result.expect(
                mine <= bound, f"{what} p95 {mine:.0f} ms beside the attack, {theirs:.0f} beside the control"
            )
