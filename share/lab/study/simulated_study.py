"""A study with simulated participants: its folder, which `share study analyze` reads as that of people.

DIR/plan.json, DIR/trials/ as always; DIR/simulation.json: by what it was made, so that a study which was
interrupted goes on as it began. The key lies beside DIR.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from share import __version__
from share.errors import UsageError
from share.files.json_file import read_json
from share.files.writing import atomic_write, writable_dir, write_private
from share.lab.emulate.motion.crowd import FloorGraphs
from share.lab.emulate.motion.route import floor_from_occupancy
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.small_pictures import profile_of_mode
from share.lab.emulate.stage import make_layout
from share.lab.emulate.world.occupancy import Occupancy
from share.lab.evaluate.emulated_network import NETWORK_PRESETS, load_network
from share.lab.evaluate.provenance import code_digest
from share.lab.study.plan import (
    PAPER_POLICIES,
    PLAN,
    PlanWishes,
    StudyKey,
    StudyPlan,
    SuccessRule,
    draw_plan,
    plan_text,
    read_key,
    read_plan,
)
from share.lab.study.simulated_room import (
    ParticipantPlan,
    draw_clear_spots,
    free_square,
    participant_motion,
    plan_participant,
    researcher_motion,
)
from share.lab.study.spots import loop_path
from share.lab.study.trials import EVENTS, trial_folder
from share.plain_data import from_mapping

SIMULATION, _SCHEMA = "simulation.json", "study simulation 1"
RESEARCHER = "researcher"
LARGE_ROOM_M = (10.0, 8.0, 4.0)
OWN_AGENTS = 3  # participant, researcher, robot
_REPLAYED = ("other=walk:",)
_EYE_HEIGHTS_M = (1.55, 1.75)
MAX_AGENTS = 50


@dataclass(frozen=True)
class SimulationSettings:
    """What a simulated study is made by. agents: on the network; those beyond participant, researcher and
    robot are replayed. mode: of all devices. network: a preset, or `shared-MBIT`. distance_m,
    timeout_s: of the success rule."""

    participants: int = 20
    goals: int = 10
    network: str = "wifi5"
    agents: int = OWN_AGENTS
    seed: int = 0
    scene: str = "warehouse"
    mode: str = "320x240@15"
    distance_m: float = 0.5
    timeout_s: float = 30.0

    def __post_init__(self) -> None:
        try:
            load_network(self.network)
        except UsageError:
            known = ", ".join(NETWORK_PRESETS)
            raise ValueError(f"network '{self.network}' is not known; known: {known}") from None
        if not OWN_AGENTS <= self.agents <= MAX_AGENTS:
            raise ValueError(f"agents {self.agents}: expected {OWN_AGENTS} to {MAX_AGENTS}")

    @property
    def rule(self) -> SuccessRule:
        return SuccessRule(self.distance_m, self.timeout_s)


@dataclass(frozen=True, eq=False)
class SimulatedStudy:
    """A study that is under way. code: digest of the code by which it was begun."""

    folder: Path
    settings: SimulationSettings
    plan: StudyPlan
    key: StudyKey
    code: str

    @cached_property
    def ground(self) -> FloorGraphs:
        layout = make_layout(_room_recipe(self.settings))
        return FloorGraphs(floor_from_occupancy(Occupancy.from_layout(layout)))

    def participant_plan(self, index: int) -> ParticipantPlan:
        """Return when participant number `index`, from 0, walks where and calls."""
        person, settings = self.plan.participants[index], self.settings
        rng = np.random.default_rng([settings.seed, 3, index])
        space = free_square(self.ground.floor)
        order = person.trials[0].spots
        return plan_participant(self.ground, space, self.plan.spots, order, settings.rule, rng)

    def recipe(self, index: int) -> SessionRecipe:
        """Return the session of the headsets of participant number `index` and of the researcher."""
        planned, name = self.participant_plan(index), self.plan.participants[index].name
        height_m = float(np.random.default_rng([self.settings.seed, 4, index]).uniform(*_EYE_HEIGHTS_M))
        motions = (
            participant_motion(name, planned, height_m),
            researcher_motion(RESEARCHER, self.plan.path, self.plan.walk_m_s),
        )
        room, seconds = _room_recipe(self.settings), float(np.ceil(planned.seconds)) + 1.0
        return replace(room, motions=motions, seconds=seconds)

    @property
    def others_recipe(self) -> SessionRecipe | None:
        """Return the session in another room whose agents are replayed; None where nobody is."""
        if self.settings.agents == OWN_AGENTS:
            return None
        longest_s = max(self.participant_plan(k).seconds for k in range(len(self.plan.participants)))
        room = _room_recipe(self.settings)
        return replace(
            room,
            motions=_REPLAYED,
            seconds=10.0 * float(np.ceil(longest_s / 10)),  # one recording for studies of about a length
            seed=room.seed + 1,
        )

    def missing(self) -> list[tuple[int, int]]:
        """Return the trials that are not done: number of the participant from 0, and place from 1."""
        return [
            (k, place)
            for k, person in enumerate(self.plan.participants)
            for place in range(1, len(person.trials) + 1)
            if not (trial_folder(self.folder, person.name, place) / EVENTS).exists()
        ]


def key_path(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}-key.json")


def begin_study(folder: Path, settings: SimulationSettings) -> SimulatedStudy:
    """Draw a plan into a folder, or go on with the study in it. Raises UsageError where that was made by
    other settings."""
    if (folder / SIMULATION).exists():
        study = open_study(folder)
        if study.settings != settings:
            raise UsageError(f"{folder}: {_difference(study.settings, settings)}; give another --out")
        return study
    if key_path(folder).exists():
        raise UsageError(f"{key_path(folder)}: exists and is not overwritten; give another --out")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"{folder}: is not empty and has no {SIMULATION}; give a new --out")
    ground = FloorGraphs(floor_from_occupancy(Occupancy.from_layout(make_layout(_room_recipe(settings)))))
    space = free_square(ground.floor)
    spots = draw_clear_spots(ground, space, settings.goals, np.random.default_rng([settings.seed, 1]))
    wishes = PlanWishes(
        settings.participants, PAPER_POLICIES, spots, loop_path(space, 0.0), settings.rule, questions=()
    )
    drawn, key = draw_plan(wishes, settings.seed, f"{settings.seed:032x}")
    people = tuple(
        replace(one, trials=tuple(replace(trial, spots=one.trials[0].spots) for trial in one.trials))
        for one in drawn.participants
    )
    plan = replace(drawn, participants=people)
    writable_dir(folder)
    write_private(key_path(folder), key.text())
    atomic_write(folder / PLAN, plan_text(plan))
    made = {"schema": _SCHEMA, **asdict(settings), "version": __version__, "code": code_digest()}
    atomic_write(folder / SIMULATION, json.dumps(made, indent=1) + "\n")
    return SimulatedStudy(folder, settings, plan, key, made["code"])


@lru_cache(maxsize=2)
def open_study(folder: Path) -> SimulatedStudy:
    """Return a study that was begun. Raises UsageError, ConfigError."""
    path = folder / SIMULATION
    if not path.is_file():
        raise UsageError(f"{folder}: is no simulated study: it has no {SIMULATION}")
    data = read_json(path)
    if data.pop("schema", None) != _SCHEMA:
        raise UsageError(f"{path}: is not a file of this kind and version ('{_SCHEMA}')")
    data.pop("version", None)
    plan, code = read_plan(folder), str(data.pop("code", ""))
    settings = from_mapping(SimulationSettings, data, str(path))
    return SimulatedStudy(folder, settings, plan, read_key(key_path(folder), plan), code)


def _difference(was: SimulationSettings, wanted: SimulationSettings) -> str:
    old, new = asdict(was), asdict(wanted)
    parts = [f"{name} {old[name]}, not {new[name]}" for name in old if old[name] != new[name]]
    return f"was begun with {', '.join(parts)}"


def _room_recipe(settings: SimulationSettings) -> SessionRecipe:
    size = LARGE_ROOM_M if settings.scene == "warehouse" else None
    profiles = {"": profile_of_mode(settings.mode)}
    return SessionRecipe(settings.scene, (), 30.0, settings.seed, size=size, profiles=profiles)
