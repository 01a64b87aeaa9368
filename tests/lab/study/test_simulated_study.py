"""A simulated study: its plan, its folder, its participants in the loop, its figures."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from helpers.robot_loop import PERIOD_NS, Drive
from helpers.study_folder import small_plan

from share.cli.main import cli
from share.errors import UsageError
from share.lab.emulate.recipe import no_progress
from share.lab.robot.goals import drawn_goals
from share.lab.study.plan import SuccessRule
from share.lab.study.simulated_loop import StudyLoop, replayed_members
from share.lab.study.simulated_participant import SimulatedParticipant
from share.lab.study.simulated_report import result_rows, wilson_interval
from share.lab.study.simulated_room import PlannedCall, longest_way_m
from share.lab.study.simulated_run import TimeLeft, run_missing
from share.lab.study.simulated_study import SimulatedStudy, SimulationSettings, begin_study, open_study
from share.lab.study.simulated_trial import JUDGE, TrialDone
from share.lab.study.trials import EVENTS, read_trial, trial_folder
from share.robot.settings import CREATE3_SPEED_M_S

SETTINGS = SimulationSettings(participants=2, goals=3, seed=8101)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> SimulatedStudy:
    return begin_study(tmp_path_factory.mktemp("simulated") / "study", SETTINGS)


# ---------------------------------------------------------------- plan and folder


@pytest.mark.long
def test_a_participant_meets_the_same_way_in_all_conditions(study: SimulatedStudy) -> None:
    for person in study.plan.participants:
        assert len({trial.spots for trial in person.trials}) == 1
        assert {trial.condition for trial in person.trials} == set(study.plan.letters)
    planned = study.participant_plan(0)
    assert [call.spot for call in planned.calls] == list(study.plan.participants[0].trials[0].spots)
    wait_s = 30.0 + longest_way_m(study.plan.spots) / CREATE3_SPEED_M_S
    ends = [*(call.t_s for call in planned.calls[1:]), planned.seconds]
    assert all(end - call.t_s >= wait_s - 0.1 for call, end in zip(planned.calls, ends, strict=True))


@pytest.mark.long
def test_spots_and_standing_places_are_on_free_floor(study: SimulatedStudy) -> None:
    floor = study.ground.floor
    assert floor.clearance_at(np.array(study.plan.spots)).min() > 0.4
    planned = study.participant_plan(1)
    assert floor.clearance_at(np.array([place[:2] for place in planned.places])).min() > 0.25
    for call, place in zip(planned.calls, planned.places[-len(planned.calls) :], strict=True):
        assert 0.7 < math.dist((call.x, call.y), place[:2]) < 1.4


@pytest.mark.long
def test_a_study_goes_on_as_it_began(study: SimulatedStudy) -> None:
    again = begin_study(study.folder, SETTINGS)
    assert again.plan == study.plan and again.key == study.key
    assert again.recipe(1) == study.recipe(1) and again.recipe(0) != study.recipe(1)
    with pytest.raises(UsageError, match="was begun with seed 8101, not 8102; give another --out"):
        begin_study(study.folder, replace(SETTINGS, seed=8102))
    with pytest.raises(UsageError, match=r"is no simulated study"):
        open_study(study.folder.parent)


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="is not empty and has no simulation"):
        begin_study(tmp_path, SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "other-key.json").write_text("mine")
    with pytest.raises(UsageError, match="exists and is not overwritten"):
        begin_study(tmp_path / "other", SETTINGS)
    assert not (tmp_path / "other").exists()


def test_other_agents_follow_each_other_and_every_third_is_a_robot() -> None:
    drive = Drive([], seconds=3.0)
    drive.base.advance(1_000_000_000)
    frames = [drive.agent.frame(k) for k in range(3)]
    members = replayed_members(drive.agent.hello.rig, frames, 4, drive.ann_link)
    assert [hello.kind.value for hello, *_ in members] == ["ar", "ar", "robot", "ar"]
    begins = [next(iter(arriving)).arrival_ns for _, arriving, _ in members]
    assert np.diff(begins).tolist() == [1_700_000_000] * 3


# ---------------------------------------------------------------- a participant in the loop


class StudyDrive(Drive):
    """The robot and ann in the empty room, without pictures; ann is a participant."""

    loop_type = StudyLoop

    def __init__(self, calls: list[PlannedCall], end_s: float) -> None:
        super().__init__([], seconds=end_s + 1.0)
        draw = drawn_goals(self.grid, np.random.default_rng(4))
        self.participant = SimulatedParticipant(self.loop, "ann", self.ann_pose, calls, end_s, draw)

    def ann_pose(self, now_ns: int) -> Any:
        return self.ann.T_world_body[now_ns // (5 * PERIOD_NS)]


def recorded(tmp_path: Path, drive: StudyDrive) -> Any:
    """The trial as `share study analyze` reads it."""
    plan, _ = small_plan(1)
    condition = plan.participants[0].trials[0].condition
    begin = {"t_s": 0.0, "event": "begin", "participant": "p01", "place": 1}
    begin |= {"condition": condition, "plan": plan.digest, "judge": JUDGE}
    lines = [begin, *sorted(drive.participant.events, key=lambda line: float(line["t_s"]))]
    (tmp_path / EVENTS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    return read_trial(tmp_path / EVENTS, plan, "p01", 1, condition)


@pytest.mark.long
def test_a_robot_comes_to_a_simulated_participant(tmp_path: Path) -> None:
    calls = [PlannedCall(10.0, 1, 4.0, 3.0, 1.0), PlannedCall(26.0, 2, 2.0, 4.5, -2.0)]
    drive = StudyDrive(calls, 42.0)
    drive.loop.run(42.5)
    record = recorded(tmp_path, drive)
    assert record.is_complete and record.judge == "simulation"
    rule = SuccessRule()
    for goal in record.goals.values():
        assert goal.status == "succeeded"
        assert 2.0 < goal.reached_s(rule) < 15.0
        assert 0.0 < goal.first_motion_s < 2.0
        assert goal.stops[-1].distance_m < 0.35 and goal.planned_m >= goal.straight_m
    assert drive.participant.presses == 2 and drive.participant.shared_s < 10.0
    by_map = [line["by_map_m"] for line in drive.participant.events if line["event"] == "stands"]
    assert by_map and all(one < 0.3 for one in by_map)


@pytest.mark.long
def test_a_participant_presses_again_and_a_robot_that_does_not_come_is_not_reached(tmp_path: Path) -> None:
    calls = [PlannedCall(10.0, 1, 4.0, 3.0, 1.0), PlannedCall(13.0, 2, 2.0, 4.5, -2.0)]
    drive = StudyDrive(calls, 19.5)
    drive.loop.run(10.5)
    drive.loop.kill_bridge()
    drive.loop.run(20.0)
    record = recorded(tmp_path, drive)
    assert all(math.isnan(goal.reached_s(SuccessRule(), longer=True)) for goal in record.goals.values())
    assert record.goals[2].status != "succeeded"
    assert drive.participant.presses > 2


# ---------------------------------------------------------------- runs and figures


@pytest.mark.long
def test_only_missing_trials_are_carried_out(study: SimulatedStudy, monkeypatch: Any) -> None:
    done: list[tuple[int, int]] = []

    def carry_out(job: Any) -> TrialDone:
        if len(done) == 3:
            raise KeyboardInterrupt
        person = study.plan.participants[job.index]
        condition = person.trials[job.place - 1].condition
        write_trial(study, job.index, job.place, reached=study.key.policies[condition] == "share")
        done.append((job.index, job.place))
        return TrialDone(person.name, job.place, "", 1.0, 1.0)

    monkeypatch.setattr("share.lab.study.simulated_run.carry_out", carry_out)
    monkeypatch.setattr("share.lab.study.simulated_run.make_cached_session", lambda *_, **__: None)
    with pytest.raises(KeyboardInterrupt):
        list(run_missing(study, 1, None, no_progress))
    assert study.missing() == [(0, 4), (1, 1), (1, 2), (1, 3), (1, 4)]
    done.clear()
    with pytest.raises(KeyboardInterrupt):
        list(run_missing(study, 1, None, no_progress))
    assert done == [(0, 4), (1, 1), (1, 2)]
    done.clear()
    assert len(list(run_missing(study, 1, None, no_progress))) == 2 and study.missing() == []
    rows = {row[0]: row for row in result_rows(study)}
    assert rows["share"][:3] == ["share", "2", "6 of 6, 100 % [61, 100]"]
    assert {row[2] for name, row in rows.items() if name in ("equal", "linear")} == {"0 of 6, 0 % [0, 39]"}
    key = study.folder.with_name("study-key.json")
    analysed = CliRunner().invoke(cli, ["study", "analyze", str(study.folder), "--key", str(key)])
    assert analysed.exit_code == 0, analysed.output
    assert "participants are simulated, not people" in analysed.output


def write_trial(study: SimulatedStudy, index: int, place: int, reached: bool) -> None:
    person = study.plan.participants[index]
    trial = person.trials[place - 1]
    begin = {"t_s": 0.0, "event": "begin", "participant": person.name, "place": place}
    lines: list[dict[str, Any]] = [
        begin | {"condition": trial.condition, "plan": study.plan.digest, "judge": JUDGE}
    ]
    for goal, spot in enumerate(trial.spots, 1):
        x, y = study.plan.spots[spot - 1]
        at = {"goal": goal, "t_s": 50.0 * goal}
        lines.append(at | {"event": "call", "spot": spot, "cube_m": [x, y], "robot_m": [x + 2, y]})
        stands = {"robot_m": [x + (0.2 if reached else 2.0), y], "path_m": 2.0, "by_map_m": 0.1}
        lines.append(at | {"event": "stands", "t_s": 50.0 * goal + 9.0} | stands)
    lines.append({"event": "end", "t_s": 500.0, "presses": 3, "place_error_m": 0.02})
    path = trial_folder(study.folder, person.name, place) / EVENTS
    path.parent.mkdir(parents=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_the_interval_of_a_share_is_wilsons() -> None:
    """Of 49 of 50: Brown, Cai & DasGupta, Statistical Science 16, 2001, formula 4."""
    low, high = wilson_interval(49, 50)
    assert (low, high) == pytest.approx((0.8950, 0.9965), abs=5e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert (wilson_interval(0, 20)[0], wilson_interval(20, 20)[1]) == pytest.approx((0.0, 1.0))


def test_time_left_is_by_what_trials_took() -> None:
    left = TimeLeft(4, now_s=100.0)
    assert left.after_one(now_s=110.0) == pytest.approx(30.0)
    assert left.after_one(now_s=140.0) == pytest.approx(40.0)


def simulate(out: Path, *more: str) -> Result:
    return CliRunner().invoke(cli, ["study", "simulate", "--out", str(out), *more])


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--link", "5g"), "network '5g' is not known; known: wifi5"),
        (("--air", "5", "--link", "wifi5"), "give one of them"),
        (("--agents", "2"), "2 is not in the range"),
        (("--air", "0"), "0 is not in the range"),
        (("--mode", "small"), "--mode small: expected WxH@HZ"),
        (("--scene", "castle"), "castle"),
    ],
)
def test_wrong_options_are_named(more: tuple[str, ...], said: str, tmp_path: Path) -> None:
    result = simulate(tmp_path / "study", *more)
    assert result.exit_code != 0 and said in f"{result.output}{result.exception}"
    assert not (tmp_path / "study").exists()


@pytest.fixture
def small_cache(tmp_path: Path, monkeypatch: Any) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


@pytest.mark.slow
def test_a_simulated_study_from_the_command_to_its_statistics(small_cache: Path) -> None:
    """One participant, four conditions, one call each: real pixels, trackers, edge and bridge."""
    study = small_cache / "study"
    options = ("--participants", "1", "--goals", "1", "--timeout", "10", "--seed", "8001")
    result = simulate(study, *options)
    assert result.exit_code == 0, result.output
    assert "4 of 4 trials; simulated participants, not people" in result.output
    again = simulate(study, *options)
    assert again.exit_code == 0 and "to simulate" not in again.output
    plain = json.loads(simulate(study, *options, "--table", "--json").stdout)
    assert {row["policy"] for row in plain["results"]} == {"share", "covins-g", "linear", "equal"}
    key = study.with_name("study-key.json")
    analysed = CliRunner().invoke(cli, ["study", "analyze", str(study), "--key", str(key)])
    assert analysed.exit_code == 0, analysed.output
    assert "judged by the simulation's truth" in analysed.output
