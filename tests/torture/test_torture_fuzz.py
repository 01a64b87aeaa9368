"""Live fuzz of a running edge, a kind of message at a time, with two honest agents beside it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import harness
import pytest
import siege
from corpus import KINDS, UP
from harness import SETUPS, EdgeProgram, Program, Result, Setup

SEED = 20261126


@dataclass(frozen=True)
class Form:
    """How long and how hard. A kind's `count` is spread over `setups`."""

    count: int
    rate: float
    ratio: float
    slack_ms: float
    control_s: float = 30.0  # at most: 200 keyframes


SHORT = Form(10_000, 1_000, 1.5, 150)  # some forty keyframes: their p95 is two of them
LONG = Form(10**6 // len(SETUPS), 4_000, 1.5, 10)


def cases() -> list[object]:
    """In the short form each kind with one setup, in the long one with all; and what only an edge says."""
    short = [(kind, SETUPS[i % len(SETUPS)], SHORT) for i, kind in enumerate((*UP, "correction"))]
    long = [(kind, setup, LONG) for kind in KINDS for setup in SETUPS if kind in UP or setup == SETUPS[0]]
    return [
        pytest.param(*case, marks=mark, id=f"{case[0]}-{case[1]}-{form}")
        for cases, mark, form in ((short, pytest.mark.slow, "short"), (long, pytest.mark.torture, "long"))
        for case in cases
    ]


@pytest.mark.parametrize(("kind", "setup", "form"), cases())
def test_fuzz(kind: str, setup: Setup, form: Form, traffic: Path, tmp_path: Path, results: Path) -> None:
    result = Result(f"fuzz {kind}", str(setup), SEED)
    ring = tmp_path / "ring.jsonl"

    def attack(edge: EdgeProgram, *more: object) -> Program:
        arguments = [
            "--corpus",
            traffic,
            "--kind",
            kind,
            "--count",
            form.count,
            "--rate",
            form.rate,
            "--seed",
            SEED,
        ]
        keys = ["--keys=" + " ".join(edge.keys.of("eve"))] if edge.keys else []
        return siege.python("fuzzer.py", tmp_path / "fuzzer.log", edge.address, *arguments, *keys, *more)

    most_s = 120 + 6 * form.count / form.rate
    attacked = siege.stay(tmp_path / "attacked", setup, lambda edge: attack(edge, "--ring", ring), most_s)
    siege.judge(result, attacked)
    if (sent := attacked.attack.get("sent", 0)) < form.count:
        result.findings.append(f"only {sent} of {form.count} messages were taken: not a whole attack")
    if attacked.alive_s is None:
        busy = ("--valid", *_as_busy(attacked, form))
        control = siege.stay(tmp_path / "control", setup, lambda edge: attack(edge, *busy), most_s)
        siege.judge_latency(result, attacked, control, form.ratio, form.slack_ms)
    if result.findings and ring.exists():
        kept = results / f"{kind}-{setup}.jsonl"
        results.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ring, kept)
        result.reproducer = str(kept)
    result.write(results).check()


def _as_busy(attacked: siege.Stay, form: Form) -> tuple[object, ...]:
    """The control: at the rate that the attack came to, and its share of a processor, for long enough."""
    sent, took_s = attacked.attack.get("sent", 0), attacked.until - attacked.since
    seconds = min(took_s, form.control_s)
    return ("--cpu", attacked.attack.get("cpu", 0.0), "--rate", max(1.0, sent / took_s), "--seconds", seconds)


@pytest.mark.slow
def test_the_judge_notices_an_edge_that_is_killed(tmp_path: Path) -> None:
    """The suite can fail."""

    def kill(edge: EdgeProgram) -> Program:
        return Program(
            tmp_path / "kill.log", ["/bin/sh", "-c", f"sleep 0.5; kill -9 {edge.process.pid}; sleep 0.5"]
        )

    stay = siege.stay(tmp_path / "edge", harness.Setup(http=False), kill)
    result = siege.judge(Result("kill", "bare", 0), stay)
    assert stay.alive_s is not None
    assert "the edge ended" in result.findings[0]
