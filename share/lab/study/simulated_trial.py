"""One trial of a simulated study: people's headsets as recorded, the robot as it drives, an edge with the
condition's policy. In virtual time, with real pixels, trackers, agents, mapper and bridge."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from share.config import Config, with_policy
from share.files.writing import atomic_write, writable_dir
from share.geometry.camera import Rig
from share.geometry.se3 import inverse
from share.lab.emulate.recipe import SessionRecipe, no_progress
from share.lab.emulate.session import make_cached_session
from share.lab.emulate.small_pictures import profile_of_mode
from share.lab.evaluate.emulated_network import load_network
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.evaluate.virtual_time import track_session
from share.lab.robot.base import RobotBase
from share.lab.robot.drive import DriveModel
from share.lab.robot.goals import drawn_goals, start_pose
from share.lab.robot.loop import Member
from share.lab.robot.room import EmulatedRoom, open_room
from share.lab.robot.simulate import (
    ROBOT_RUN,
    EmulatedRobotAgent,
    robot_sensors,
    tracked_people,
    usual_robot,
)
from share.lab.study.simulated_loop import StudyLoop, replayed_members
from share.lab.study.simulated_participant import Event, SimulatedParticipant
from share.lab.study.simulated_room import ParticipantPlan
from share.lab.study.simulated_study import OWN_AGENTS, SimulatedStudy, open_study
from share.lab.study.trials import EVENTS, trial_folder
from share.recordings.session import Session, read_session

JUDGE = "simulation"
_TAIL_S = 0.5  # after the last wait, for its end to be written
_STEP_S = 0.5


@dataclass(frozen=True)
class TrialJob:
    """A trial: number of the participant from 0, place from 1."""

    folder: Path
    index: int
    place: int


@dataclass(frozen=True)
class TrialDone:
    """policy: the condition's. seconds: simulated. cpu_s: what it took, with opening and tracking."""

    participant: str
    place: int
    policy: str
    seconds: float
    cpu_s: float


def carry_out(job: TrialJob) -> TrialDone:
    """Simulate a trial and write its events, all at once. Raises ShareError."""
    began_s, study = time.process_time(), open_study(job.folder)
    person = study.plan.participants[job.index]
    policy = study.key.policies[person.trials[job.place - 1].condition]
    simulated = SimulatedTrial(study, job.index, policy)
    for _ in simulated.drive():
        pass
    cpu_s = round(time.process_time() - began_s, 1)
    lines = simulated.events(job.place, cpu_s)
    folder = writable_dir(trial_folder(study.folder, person.name, job.place))
    atomic_write(folder / EVENTS, "".join(json.dumps(line) + "\n" for line in lines))
    return TrialDone(person.name, job.place, policy, simulated.planned.seconds, cpu_s)


class SimulatedTrial:
    """A trial of participant number `index` with a policy, before or after its drive. planned: its way."""

    def __init__(self, study: SimulatedStudy, index: int, policy: str) -> None:
        self._study, self._index = study, index
        room, session, self.planned = _participant(study.folder, index)
        settings, name = study.settings, study.plan.participants[index].name
        config = with_policy(Config(), policy)
        seed, seconds = settings.seed * 1000 + index, self.planned.seconds + _TAIL_S
        rngs = [np.random.default_rng((seed, stream)) for stream in range(3)]
        robot, network = usual_robot(), load_network(settings.network)
        start = start_pose(room.grid, room.people_at(0), rngs[0])
        base = RobotBase(DriveModel(), room.grid, start, inverse(robot.T_body_base), seconds, rngs[1])
        replayed: list[Member] = []
        if settings.agents > OWN_AGENTS:  # first: what is tracked last is kept for the next condition
            replayed = replayed_members(*_others(study.folder), settings.agents - OWN_AGENTS, network)
        members = [*tracked_people(session, room, config, network, no_progress), *replayed]
        sensors = robot_sensors(room, base, profile_of_mode(settings.mode), seed, seconds)
        agent = EmulatedRobotAgent(sensors, config, ROBOT_RUN, lambda text: self.loop.note(f"agent: {text}"))
        self.loop = StudyLoop(
            *(config, members, seed, base, room.grid, room.people_at, robot, agent, network),
            delays=ProcessingDelays(),
        )
        path = next(one.path for one in room.people if one.name == name)
        self.participant = SimulatedParticipant(
            self.loop,
            name,
            lambda now_ns: path.poses(np.array([now_ns + path.start_ns]))[0],
            self.planned.calls,
            self.planned.seconds,
            drawn_goals(room.grid, rngs[2]),
        )

    def drive(self) -> Iterator[float]:
        """Go on, and yield the session time, s, every so often, until the trial's end."""
        now_s, end_s = 0.0, self.planned.seconds + _TAIL_S
        while now_s < end_s:
            now_s = min(now_s + _STEP_S, end_s)
            self.loop.run(now_s)
            yield now_s

    def events(self, place: int, cpu_s: float) -> list[Event]:
        """Return the lines of the trial's file, in order of time; with the last what else was measured."""
        plan = self._study.plan
        person, happened = plan.participants[self._index], self.participant.events
        begin = {"t_s": 0.0, "event": "begin", "participant": person.name, "place": place}
        begin |= {"condition": person.trials[place - 1].condition, "plan": plan.digest, "judge": JUDGE}
        lines = [begin, *sorted(happened, key=lambda line: float(line["t_s"]))]
        lines[-1] = lines[-1] | self._figures() | {"cpu_s": cpu_s}
        return lines

    def _figures(self) -> dict[str, Any]:
        loop, participant = self.loop, self.participant
        errors, reports = participant.place_errors_m, loop.reports()
        airs = sum(air.busy_ns for air in loop.airs.values()) / loop.now_ns
        return {
            "presses": participant.presses,
            "shared_s": None if np.isnan(participant.shared_s) else participant.shared_s,
            "place_error_m": round(median(errors), 4) if errors else None,
            "place_error_p95_m": round(float(np.percentile(errors, 95)), 4) if errors else None,
            "air_busy": round(airs, 4),
            "keyframes_sent": {name: one["sent"] for name, one in reports.items()},
            "kb_up": {name: round(one["bytes_up"] / 1000) for name, one in reports.items()},
            "mapper_busy": round(loop.mapper_busy_ns / loop.now_ns, 4),
            "nearest_person_m": round(float(loop.nearest_person_m), 3),
            "lines": [[round(t, 2), text] for t, text in loop.lines],
        }


@lru_cache(maxsize=1)  # conditions of a participant follow each other
def _participant(folder: Path, index: int) -> tuple[EmulatedRoom, Session, ParticipantPlan]:
    study = open_study(folder)
    recipe = study.recipe(index)
    room = open_room(recipe, no_progress)
    return room, read_session(make_cached_session(recipe, workers=1)), study.participant_plan(index)


@lru_cache(maxsize=1)
def _others(folder: Path) -> tuple[Rig, list[TrackedFrame]]:
    recipe = open_study(folder).others_recipe
    assert recipe is not None
    session, config = make_cached_session(recipe, workers=1), Config()
    settings = config.tracker, config.inertial, config.sequencer
    [tracked] = track_session(session.resolve(), *settings, config.agent.error_model).values()
    return tracked


def sessions_of(study: SimulatedStudy, indices: list[int]) -> list[SessionRecipe]:
    """Return the recipes of what has to be drawn for these participants."""
    others = study.others_recipe
    return [study.recipe(k) for k in indices] + ([] if others is None else [others])
