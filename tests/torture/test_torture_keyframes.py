"""Mutated keyframes straight into the edge's code, and lies of motion: what the map makes of them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from harness import ENV, HERE, Program, Result

SEED = 20261127
# CPU ms, of the longest call among thousands, on cores that others use too. Joining two maps compares all
# their views, and the agents: that is the longest that follows from a step.
LONGEST_MS = {"edge": 50, "add": 100, "describe": 200, "place": 200, "align": 200, "verify": 200}
LONGEST_MS |= {"finish": 1000, "solve": 1000}
HONEST_ERROR_M = 0.005  # 0.7 to 0.9 mm were measured


def fuzz(tmp_path: Path, cases: int, work_every: int, seed: int = SEED) -> tuple[dict[str, Any], str]:
    """The figures, and what was written to stderr."""
    out = tmp_path / "fuzz.log"
    command = [sys.executable, str(HERE / "keyframe_fuzz.py"), str(cases), "--seed", str(seed)]
    program = Program(out, [*command, "--work-every", str(work_every)], ENV)
    assert program.process.wait(7200) == 0, program.said[-2000:]
    *others, figures = program.said.splitlines()
    return json.loads(figures), "\n".join(others)


def judge(result: Result, figures: dict[str, Any], stderr: str) -> None:
    result.figures = figures
    result.expect(not figures["raised"], f"raised: {figures['raised']}")
    result.expect(not figures["not_finite"], "poses that are not finite")
    result.expect(figures["honest_error_m"] < HONEST_ERROR_M, f"honest: {figures['honest_error_m']} m off")
    result.expect(0.2 < figures["applied"] / figures["cases"] < 0.95, "the mutations are all alike")
    for call, most in LONGEST_MS.items():
        spent = figures["cpu_ms"].get(call, 0.0)
        result.expect(spent < most, f"{call}: {spent:.0f} ms of CPU")
    result.expect(not stderr, f"on stderr: {stderr[:200]}")


@pytest.mark.slow
@pytest.mark.parametrize(("cases", "work_every"), [(5000, 400), (300, 1)], ids=["intake", "all steps"])
def test_mutated_keyframes_short(cases: int, work_every: int, tmp_path: Path, results: Path) -> None:
    result = Result("keyframe fuzz", f"{cases} by {work_every}", SEED)
    judge(result, *fuzz(tmp_path, cases, work_every))
    result.write(results).check()


@pytest.mark.torture
@pytest.mark.parametrize(("cases", "work_every"), [(200_000, 400), (20_000, 1)], ids=["intake", "all steps"])
def test_mutated_keyframes_long(cases: int, work_every: int, tmp_path: Path, results: Path) -> None:
    result = Result("keyframe fuzz", f"{cases} by {work_every}", SEED + 1)
    judge(result, *fuzz(tmp_path, cases, work_every, SEED + 1))
    result.write(results).check()
