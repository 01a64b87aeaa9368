"""A trial judged by motion capture: clocks that do not agree, a map that drifts, a robot that is hidden."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.study_folder import begin, small_plan, write_lines

from share.cli.main import cli
from share.geometry import se3
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.study.mocap_judge import RobotTrack, match_clocks
from share.lab.study.observations import read_study
from share.lab.study.plan import SuccessRule, plan_text
from share.lab.study.standstill import MotionWatch, RobotSample
from share.lab.study.trials import EVENTS, EVENTS_BY_MAP, read_trials, trial_folder
from share.robot.planar import PlanarPose

PLAN, KEY = small_plan()
P01 = PLAN.participants[0].name
BEGAN_S = datetime(2026, 11, 28, 10, tzinfo=UTC).timestamp()
OFFSET_S = 731.37  # motion capture's clock minus the trial's
FLOOR = PlanarPose(3.2, -1.4, 2.1)  # in the motion capture's world
PAUSE_S = 300.0  # of an interrupted trial


def drive(seed: int) -> tuple[np.ndarray, np.ndarray, list[tuple[float, tuple[float, float]]]]:
    """Return times (N,) s, true poses (N, 3) on the floor, and calls: when, and where the robot goes to. It
    turns to its goal, drives, and stands."""
    rng, t, pose = np.random.default_rng(seed), [0.0], [np.array([3.0, 0.5, 0.0])]
    calls = []

    def go(to: np.ndarray, seconds: float) -> None:
        steps, start = max(1, round(seconds / 0.05)), pose[-1]
        for k in range(1, steps + 1):
            u = k / steps
            pose.append(start + (to - start) * u * u * (3 - 2 * u))
            t.append(t[-1] + 0.05)

    go(pose[-1], 8.0)
    for spot in PLAN.participants[0].trials[0].spots:
        x, y = np.add(PLAN.spots[spot - 1], rng.uniform(-0.2, 0.2, 2)).tolist()
        calls.append((t[-1], (x, y)))
        go(pose[-1], rng.uniform(1, 2))
        here = pose[-1]
        yaw = here[2] + math.remainder(math.atan2(y - here[1], x - here[0]) - here[2], 2 * math.pi)
        go(np.array([*here[:2], yaw]), abs(yaw - here[2]) / 0.8 + 0.5)
        go(np.array([x, y, yaw]), math.hypot(x - here[0], y - here[1]) / 0.2)
        go(pose[-1], rng.uniform(6, 9))
    return np.array(t), np.array(pose), calls


def events_by_map(seed: int, drift_m: float, breaks: bool = False) -> list[dict[str, Any]]:
    """What `share study run` writes by a map that drifts by so much to one side at each goal."""
    t, pose, calls = drive(seed)
    lines = [begin(PLAN, P01, 1, judge="map", utc="2026-11-28T10:00:00.000+00:00")]
    ends = [*(at for at, _ in calls[1:]), t[-1]]
    for goal, ((at, _), end, spot) in enumerate(
        zip(calls, ends, PLAN.participants[0].trials[0].spots, strict=True), 1
    ):
        off = np.array([drift_m * goal, 0.0])
        seen = [
            RobotSample(s, *(xy[:2] + off), xy[2])
            for s, xy in zip(t[::4], pose[::4], strict=True)
            if at <= s < end
        ]
        if breaks and goal == 2:
            utc = f"2026-11-28T10:{(at + PAUSE_S) // 60:02.0f}:{(at + PAUSE_S) % 60:06.3f}+00:00"
            lines.append({"event": "interrupted", "t_s": at, "reason": "the edge is gone"})
            lines.append(begin(PLAN, P01, 1, judge="map", utc=utc, t_s=at))
        x, y = np.add(PLAN.spots[spot - 1], [0.1, 0.0]).tolist()
        robot = [seen[0].x, seen[0].y]
        lines.append(
            {
                "event": "call",
                "t_s": at,
                "goal": goal,
                "spot": spot,
                "cube_m": [x, y],
                "robot_m": robot,
                "by": "enter",
            }
        )
        watch, moved, stood = MotionWatch(seen[0]), False, False
        for one in seen:
            watch.add(one)
            if watch.moves_s is not None and not moved:
                moved = True
                lines.append({"event": "moves", "t_s": watch.moves_s, "goal": goal})
            since = watch.stands_since()
            if moved and since is not None and not stood:
                where = {"robot_m": [one.x, one.y], "path_m": watch.path_m}
                lines.append({"event": "stands", "t_s": since, "goal": goal} | where)
            stood = moved and since is not None
        lines.append({"event": "status", "t_s": seen[-1].t_s, "goal": goal, "status": "arrived"})
    return [*lines, {"event": "end", "t_s": float(t[-1])}]


def mocap_of(seed: int, up: str = "z", pause_s: float = 0.0) -> MocapTrajectory:
    """At 25 Hz, with noise, from a minute before to a minute after; with a pause before the last goal."""
    t, pose, calls = drive(seed)
    rng = np.random.default_rng(seed + 1)
    at = np.arange(-60.0, t[-1] + 60.0 + pause_s, 0.04)
    trial = np.where(at > calls[-1][0], np.maximum(calls[-1][0], at - pause_s), at)
    x, y, yaw = (np.interp(trial, t, column) for column in pose.T)
    c, s = math.cos(FLOOR.yaw), math.sin(FLOOR.yaw)
    p = np.stack([FLOOR.x + c * x - s * y, FLOOR.y + s * x + c * y, np.full(len(x), 0.2)], 1)
    R = se3.so3_exp((yaw + FLOOR.yaw + 0.7)[:, None] * [0, 0, 1])  # its axes are not the robot's
    T = se3.from_rt(R, p + rng.normal(0, 3e-4, p.shape))
    if up == "y":
        T = se3.from_rt(se3.so3_exp(np.array([-math.pi / 2, 0, 0])), np.zeros(3)) @ T
    return MocapTrajectory(np.round((at + OFFSET_S) * 1e9).astype(np.int64), T)


def write_tum(path: Path, mocap: MocapTrajectory) -> Path:
    q = se3.quat_from_matrix(mocap.T[:, :3, :3])
    rows = np.column_stack([mocap.stamps_ns / 1e9, mocap.T[:, :3, 3], q])
    np.savetxt(path, rows, fmt="%.9f")
    return path


def study_with(folder: Path, events: list[dict[str, Any]]) -> Path:
    folder.mkdir()
    (folder / "plan.json").write_text(plan_text(PLAN))
    write_lines(trial_folder(folder, P01, 1) / EVENTS, events)
    return folder


def judge(folder: Path, mocap: Path, *more: str, trial: str = f"{P01}-1") -> Any:
    floor = f"{FLOOR.x},{FLOOR.y},{math.degrees(FLOOR.yaw)}"
    options = [] if "--floor" in more else ["--floor", floor]
    return CliRunner().invoke(
        cli, ["study", "judge", str(folder), trial, "--mocap", str(mocap), *options, *more]
    )


@pytest.mark.parametrize("up", ["z", "y"])
@pytest.mark.parametrize("seed", range(3))
def test_clocks_are_matched_by_driving_and_standing(seed: int, up: str) -> None:
    track = RobotTrack.of(mocap_of(seed, up), FLOOR, up)
    found = match_clocks(track, events_by_map(seed, 0.3))
    assert found.zero_utc_s == pytest.approx(BEGAN_S - OFFSET_S, abs=0.3)
    assert found.agreement > 0.8


def test_a_map_that_drifts_does_not_judge_itself(tmp_path: Path) -> None:
    """Within .5 m of each spot; by the map .6 m off at the first, 1.2 m at the second."""
    folder = study_with(tmp_path / "study", events_by_map(1, 0.6))
    rule = SuccessRule()
    before = read_trials(folder, PLAN)[P01, 1]
    assert not any(goal.reached_s(rule) > 0 for goal in before.goals.values())
    zero = datetime.fromtimestamp(BEGAN_S - OFFSET_S, UTC).isoformat()
    take = write_tum(tmp_path / "take.tum", mocap_of(1))
    assert "1.20 m apart at most calls" in str(judge(folder, take).exception)
    result = judge(folder, take, "--zero", zero)
    assert result.exit_code == 0, result.output
    after = read_trials(folder, PLAN)[P01, 1]
    assert after.judge == "mocap" and after.is_complete
    _, pose, calls = drive(1)
    for (at, to), (number, goal) in zip(calls, sorted(after.goals.items()), strict=True):
        spot = PLAN.spots[goal.spot - 1]
        assert goal.stops[-1].distance_m == pytest.approx(math.dist(to, spot), abs=0.01)
        assert goal.straight_m == pytest.approx(math.dist(pose[round(at / 0.05)][:2], spot), abs=0.03)
        assert goal.reached_s(rule) == pytest.approx(before.goals[number].stops[-1].s, abs=0.6)
        assert goal.status == "arrived"
    assert not any("judged by the map" in note for note in read_study(folder, PLAN, rule).notes)


def test_judging_again_begins_from_what_the_map_said(tmp_path: Path) -> None:
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    path = trial_folder(folder, P01, 1) / EVENTS
    said = path.read_text()
    take = write_tum(tmp_path / "take.tum", mocap_of(1))
    shown = judge(folder, take, "--json")
    first = shown.exit_code, path.read_text()
    assert first[0] == 0 and path.with_name(EVENTS_BY_MAP).read_text() == said
    goals = json.loads(shown.stdout)["goals"]
    record = read_trials(folder, PLAN)[P01, 1]
    for one in goals:
        assert one["distance_m_mocap"] == record.goals[one["goal"]].stops[-1].distance_m
        assert one["reached_s_map"] == pytest.approx(one["reached_s_mocap"], abs=0.6)
    assert len(goals) == len(record.goals) == 2
    assert (judge(folder, take).exit_code, path.read_text()) == first


def test_a_trial_that_was_interrupted_has_one_clock(tmp_path: Path) -> None:
    """The trial's clock stands still while it is interrupted, the motion capture's goes on."""
    folder = study_with(tmp_path / "study", events_by_map(2, 0.0, breaks=True))
    result = judge(folder, write_tum(tmp_path / "take.tum", mocap_of(2, pause_s=PAUSE_S)))
    assert result.exit_code == 0, result.output
    goals = read_trials(folder, PLAN)[P01, 1].goals
    assert len(goals) == 2 and all(goal.reached_s(SuccessRule()) > 0 for goal in goals.values())


def test_a_floor_marker_may_be_a_body(tmp_path: Path) -> None:
    """As Motive exports it, with y up."""
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    marker = mocap_of(1, "y")
    T = se3.from_rt(se3.so3_exp(np.array([-math.pi / 2, 0, 0])), np.zeros(3)) @ se3.from_rt(
        se3.so3_exp(np.array([0, 0, FLOOR.yaw])), np.array([FLOOR.x, FLOOR.y, 0.0])
    )
    write_motive(
        tmp_path / "take.csv", {"Robot": marker.T, "Marker": np.broadcast_to(T, marker.T.shape)}, marker
    )
    result = judge(folder, tmp_path / "take.csv", "--floor", "Marker", "--up", "y")
    assert result.exit_code == 0, result.output
    goals = read_trials(folder, PLAN)[P01, 1].goals
    _, _, calls = drive(1)
    for (_, to), goal in zip(calls, goals.values(), strict=True):
        assert goal.stops[-1].distance_m == pytest.approx(math.dist(to, PLAN.spots[goal.spot - 1]), abs=0.01)


def write_motive(path: Path, bodies: dict[str, np.ndarray], at: MocapTrajectory) -> None:
    names = [name for name in bodies for _ in range(7)]
    kinds = [kind for _ in bodies for kind in ["Rotation"] * 4 + ["Position"] * 3]
    rows = [
        ["Format Version", "1.23", "Length Units", "Meters", "Coordinate Space", "Global"],
        ["", "Type", *["Rigid Body"] * len(names)],
        ["", "Name", *names],
        ["", "ID", *names],
        ["", "", *kinds],
        ["Frame", "Time (Seconds)", *[*"XYZWXYZ"] * len(bodies)],
    ]
    values = [np.arange(len(at.stamps_ns)), at.stamps_ns / 1e9]
    for T in bodies.values():
        values += [*se3.quat_from_matrix(T[:, :3, :3]).T, *T[:, :3, 3].T]
    rows += [[f"{value:.9f}" for value in row] for row in np.column_stack(values)]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--floor", "Marker"), "neither X,Y,DEG nor a body of"),
        (("--floor", "1,2"), "neither X,Y,DEG nor a body of"),
        (("--floor", "nan,0,0"), "neither X,Y,DEG nor a body of"),
        (("--body", "Robot"), "has no body 'Robot'"),
        (("--zero", "2026-11-28T09:00"), "did not see the robot for more than 2 s under way to goal 1"),
        (("--zero", "noon"), "is not a UTC time such as"),
        (("--zero", "9999-99-99"), "is not a UTC time such as"),
    ],
)
def test_wrong_options_leave_the_trial_as_it_was(tmp_path: Path, more: tuple[str, ...], said: str) -> None:
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    path = trial_folder(folder, P01, 1) / EVENTS
    before = path.read_text()
    result = judge(folder, write_tum(tmp_path / "take.tum", mocap_of(1)), *more)
    assert result.exit_code in (1, 2) and said in str(result.exception)
    assert path.read_text() == before and not path.with_name(EVENTS_BY_MAP).exists()


def test_another_trials_motion_capture_is_refused(tmp_path: Path) -> None:
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    still = mocap_of(1)
    rest = MocapTrajectory(still.stamps_ns, np.broadcast_to(still.T[0], still.T.shape).copy())
    result = judge(folder, write_tum(tmp_path / "take.tum", rest))
    assert result.exit_code == 1 and "agree at no time offset" in str(result.exception)


def test_what_is_not_there_or_not_finished_is_refused(tmp_path: Path) -> None:
    events = events_by_map(1, 0.0)
    folder = study_with(tmp_path / "study", events[:-1])
    take = write_tum(tmp_path / "take.tum", mocap_of(1))
    assert "was not carried through" in str(judge(folder, take).exception)
    assert "the plan has no such trial" in str(judge(folder, take, trial="p99-1").exception)
    assert "the trial was not run" in str(judge(folder, take, trial=f"{P01}-2").exception)
    broken = json.loads(json.dumps(events))
    broken[0]["judge"] = "mocap"
    write_lines(trial_folder(folder, P01, 1) / EVENTS, broken)
    assert "is judged by mocap, and there is no events-map.jsonl" in str(judge(folder, take).exception)


def hidden(mocap: MocapTrajectory, from_s: float, to_s: float) -> MocapTrajectory:
    """The same without the samples in a time range of the trial's clock."""
    t_s = mocap.stamps_ns / 1e9 - OFFSET_S
    keep = (t_s < from_s) | (t_s > to_s)
    return MocapTrajectory(mocap.stamps_ns[keep], mocap.T[keep])


def test_a_robot_that_was_hidden_is_not_judged_and_missed(tmp_path: Path) -> None:
    events = events_by_map(1, 0.0)
    folder = study_with(tmp_path / "study", events)
    stood_s = [event["t_s"] for event in events if event["event"] == "stands"][-1]
    take = write_tum(tmp_path / "a.tum", hidden(mocap_of(1), stood_s - 2.5, stood_s + 1.0))
    assert "under way to goal 2 (3.5 s)" in str(judge(folder, take).exception)
    cut = hidden(mocap_of(1), stood_s - 3, 1e9)
    assert "under way to goal 2" in str(judge(folder, write_tum(tmp_path / "b.tum", cut)).exception)
    short = hidden(mocap_of(1), stood_s - 0.7, stood_s + 0.7)
    assert judge(folder, write_tum(tmp_path / "c.tum", short)).exit_code == 0
    goal = read_trials(folder, PLAN)[P01, 1].goals[2]
    assert goal.stops[-1].s == pytest.approx(stood_s - goal.called_s, abs=1.5)


def test_a_robot_that_stands_at_the_last_spot_already_has_come(tmp_path: Path) -> None:
    """Goal 2 is called again and again; it does not drive, and the trial ends with the navigator's word."""
    events = events_by_map(1, 0.0)[:-1]
    call = next(one for one in events if one["event"] == "call" and one["goal"] == 2)
    at = float(drive(1)[0][-1]) + 2.0
    events.append({**call, "t_s": at, "robot_m": list(drive(1)[2][-1][1])})
    events += [
        {"event": "status", "t_s": at + 0.4, "goal": 2, "status": "arrived"},
        {"event": "end", "t_s": at + 0.4},
    ]
    folder = study_with(tmp_path / "study", events)
    assert judge(folder, write_tum(tmp_path / "take.tum", mocap_of(1))).exit_code == 0
    record = read_trials(folder, PLAN)[P01, 1]
    assert record.is_complete and record.goals[2].reached_s(SuccessRule()) < 1.0


def test_what_the_robot_does_after_a_goal_is_not_the_goals(tmp_path: Path) -> None:
    """The navigator gave up as soon as the robot was called, long before somebody drove it there."""
    events = []
    for event in events_by_map(1, 0.0):
        if event.get("goal") != 2 or event["event"] == "call":
            events.append(event)
        if event.get("goal") == 2 and event["event"] == "call":
            events.append({"event": "status", "t_s": event["t_s"] + 0.2, "goal": 2, "status": "failed"})
    folder = study_with(tmp_path / "study", events)
    zero = datetime.fromtimestamp(BEGAN_S - OFFSET_S, UTC).isoformat()
    result = judge(folder, write_tum(tmp_path / "take.tum", mocap_of(1)), "--zero", zero)
    assert result.exit_code == 0, result.output
    assert math.isnan(read_trials(folder, PLAN)[P01, 1].goals[2].reached_s(SuccessRule()))


def test_a_trial_that_was_run_anew_is_not_overwritten(tmp_path: Path) -> None:
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    path = trial_folder(folder, P01, 1) / EVENTS
    assert judge(folder, write_tum(tmp_path / "old.tum", mocap_of(1))).exit_code == 0
    write_lines(path, events_by_map(2, 0.0))
    anew = path.read_text()
    result = judge(folder, write_tum(tmp_path / "new.tum", mocap_of(2)))
    assert "is of another trial than events.jsonl; move it away" in str(result.exception)
    assert path.read_text() == anew


@pytest.mark.parametrize("utc", ["1970-01-01T00:00:10+00:00", "2027-11-28T10:00:00+00:00"])
def test_a_clock_that_was_set_in_between_is_said(tmp_path: Path, utc: str) -> None:
    events = events_by_map(2, 0.0, breaks=True)
    [second] = [one for one in events[1:] if one["event"] == "begin"]
    second["utc"] = utc
    folder = study_with(tmp_path / "study", events)
    result = judge(folder, write_tum(tmp_path / "take.tum", mocap_of(2)))
    assert "the clock of the machine that led the trial was set in between" in str(result.exception)


def test_a_standstill_may_be_written_after_what_came_later(tmp_path: Path) -> None:
    """It is known a second after it began; the navigator's word may come before."""
    events = events_by_map(1, 0.0)
    last = next(k for k, one in reversed([*enumerate(events)]) if one["event"] == "stands")
    stands = events.pop(last)
    events.insert(last + 1, stands)  # after the status, which is later
    folder = study_with(tmp_path / "study", events)
    zero = datetime.fromtimestamp(BEGAN_S - OFFSET_S, UTC).isoformat()
    assert judge(folder, write_tum(tmp_path / "take.tum", mocap_of(1)), "--zero", zero).exit_code == 0


def test_trials_that_were_left_are_no_change_of_judge(tmp_path: Path) -> None:
    folder = study_with(tmp_path / "study", events_by_map(1, 0.0))
    left = begin(PLAN, P01, 2, judge="map")
    write_lines(trial_folder(folder, P01, 2) / EVENTS, [left])
    assert judge(folder, write_tum(tmp_path / "take.tum", mocap_of(1))).exit_code == 0
    assert not any("JUDGE CHANGES" in note for note in read_study(folder, PLAN, SuccessRule()).notes)
