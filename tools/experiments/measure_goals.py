"""The closed loop of a robot by many goals: emulated robots drive to where a headset's wearer points.

    python tools/experiments/measure_goals.py --out goals.jsonl --seeds 6101:6111 --runs truth wheels share \\
        [--scene warehouse] [--goals 10] [--mode 320x240@15] [--seconds 420] [--headset-s 260]
    python tools/experiments/measure_goals.py --out goals.jsonl --table [--plot goals.png]

Runs: `truth` and `wheels` are the robot with perfect poses and with wheel odometry alone, without pictures;
any other name is a policy of the edge, under which the robot sees, tracks and shares the map (`share robot
simulate`). One room a seed, with one headset that walks about (`walk:`) for --headset-s, which stands after
that; the same room, walk, robot and link for all runs of a seed. --mode: of both devices, a D435i's; sizes
that it does not have are scaled from 640x480. A run ends with its last goal, or after --seconds.

--out gets a line of JSON for each goal as it ends, with what bridge and agent said meanwhile, and one for
each finished run; a run that is in the file is not run again, and one that was interrupted counts by its
goals.
--table prints Markdown tables of the file: figures of each run, and goals that were not reached.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()

from goal_figures import draw_goals, print_tables  # noqa: E402
from make_keyframe_sets import seeds_of  # noqa: E402
from tool_main import exit_code  # noqa: E402

from share.config import STREAMED, Config  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe, no_progress  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.lab.emulate.small_pictures import profile_of_mode  # noqa: E402
from share.lab.evaluate.provenance import describe_machine  # noqa: E402
from share.lab.robot.report import goal_report, run_report  # noqa: E402
from share.lab.robot.room import EmulatedRoom, open_room  # noqa: E402
from share.lab.robot.simulate import SHARE, LoopOptions, LoopRun, prepare_run, usual_robot  # noqa: E402
from share.recordings.session import Session, read_session  # noqa: E402
from share.scheduling.policies import POLICIES  # noqa: E402

_BLIND = ("truth", "wheels")
_POLICIES = tuple(name for name in POLICIES if name != STREAMED)  # whose agents track

Row = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    return exit_code("measure_goals", lambda: tables(options) if options.table else measure(options))


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("--out", type=Path, required=True, metavar="FILE")
    made.add_argument("--seeds", type=seeds_of, default=range(6101, 6111), metavar="FIRST:END")
    made.add_argument("--runs", nargs="+", choices=(*_BLIND, *_POLICIES), default=[*_BLIND, SHARE])
    made.add_argument("--scene", default="warehouse")
    made.add_argument("--goals", type=int, default=10)
    made.add_argument("--mode", default="320x240@15", metavar="WxH@HZ")
    made.add_argument("--seconds", type=float, default=420.0)
    made.add_argument("--headset-s", type=float, default=260.0)
    made.add_argument("--table", action="store_true", help="only print what the file has")
    made.add_argument("--plot", type=Path, metavar="PNG")
    return made


def tables(options: argparse.Namespace) -> None:
    """Raises UsageError where there are no lines."""
    rows = read_rows(options.out)
    if not any(row["kind"] == "goal" for row in rows):
        raise UsageError(f"{options.out}: has no goals")
    print_tables(rows)
    if options.plot:
        draw_goals(options.plot, rows)


def measure(options: argparse.Namespace) -> None:
    done = {key(row) for row in read_rows(options.out) if row["kind"] == "run"}
    for seed in options.seeds:
        wanted = [run for run in options.runs if key(about(options, run, seed)) not in done]
        if wanted:
            one_room(options, seed, wanted)


def about(options: argparse.Namespace, run: str, seed: int) -> Row:
    """Return what tells runs apart."""
    mode = None if run in _BLIND else options.mode
    return {"scene": options.scene, "seed": seed, "run": run, "mode": mode}


def one_room(options: argparse.Namespace, seed: int, runs: Sequence[str]) -> None:
    """Make the room, and drive in it."""
    began_s = time.perf_counter()
    profiles = {"": profile_of_mode(options.mode)}
    recipe = SessionRecipe(options.scene, ("ann=walk:",), options.headset_s, seed, profiles=profiles)
    sees = any(run not in _BLIND for run in runs)
    session = read_session(make_cached_session(recipe, workers=1)) if sees else None
    room = open_room(recipe, no_progress, has_pictures=sees)
    print(f"room {seed}: {time.perf_counter() - began_s:.1f} s", flush=True)
    for run in runs:
        one_run(options, run, seed, room, session)


def one_run(
    options: argparse.Namespace, run: str, seed: int, room: EmulatedRoom, session: Session | None
) -> None:
    """Drive, and append lines to the file."""
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    sees, fields = run not in _BLIND, about(options, run, seed)
    loop_options = LoopOptions(
        SHARE if sees else run, run if sees else SHARE, options.goals, None, seed, options.seconds
    )
    loop_options = replace(loop_options, profile=profile_of_mode(options.mode))
    driven = prepare_run(session, room, loop_options, Config(), usual_robot(), no_progress)
    count = 0
    for _ in driven.drive():
        for number in range(count, ended(driven)):
            append(options.out, {"kind": "goal", **fields, "number": number + 1, **goal_row(driven, number)})
            count += 1
    report = run_report(driven, "")
    kept = {name: report[name] for name in report if name not in ("goals", "session", "profile")}
    took = {
        "wall_s": round(time.perf_counter() - began_s, 1),
        "cpu_s": round(time.process_time() - began_cpu_s, 1),
    }
    wanted = {"goals": options.goals, "unfinished": len(driven.outcomes) - count}
    append(options.out, {"kind": "run", **kept, **fields, **wanted, **took, "machine": describe_machine()})
    print(f"{run} {seed}: {report['reached']} of {count}; {took}", flush=True)


def ended(run: LoopRun) -> int:
    """Return how many goals have their end; they end in order."""
    return sum(outcome.has_ended for outcome in run.outcomes)


def goal_row(run: LoopRun, number: int) -> Row:
    """Return what became of a goal that has ended, and the lines meanwhile."""
    outcome = run.outcomes[number]
    lines = [[round(t, 2), text] for t, text in run.loop.lines if t >= outcome.begun_s - 0.2]
    return goal_report(outcome) | {"lines": lines}


# ---------------------------------------------------------------- the file


def key(row: Row) -> tuple[Any, ...]:
    return row["scene"], row["seed"], row["run"], row["mode"]


def append(path: Path, row: Row) -> None:
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[Row]:
    """Return the lines of the file; of a goal twice, as its run was interrupted, the newest."""
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [json.loads(line) for line in lines]
    newest = {(row["kind"], *key(row), row.get("number")): row for row in rows}
    return list(newest.values())


if __name__ == "__main__":
    sys.exit(main())
