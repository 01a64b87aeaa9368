"""How soon an agent that is carried lost through a building is found in its room, and how often in a wrong
one.

    python tools/experiments/measure_rooms.py [--rooms 50] [--twins 10] [--seed 7100] [--seconds 24]

Emulated rooms, warehouses and fire stations in turn, each mapped by one person: real mappers, their places in
one directory. --twins of them are earlier ones on another day: other light, loose things moved, a third of
the cartons gone. A second person walks through each. From every tenth of its keyframes on it is lost: in a
room that nobody has mapped, until directory, searches and decision, as in `share site`, find it. They answer
before its next keyframe. Prints a Markdown table: starts; of those *in view*, within 1.5 m and 40 degrees of
a keyframe of the room's map; keyframes until it was found; how often in its twin, and in a wrong room.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from keyframe_set import AgentKeyframes, Spacing, keyframe_set  # noqa: E402
from tool_main import exit_code, line  # noqa: E402

from share.config import Config  # noqa: E402
from share.earlier_poses import EarlierPoses  # noqa: E402
from share.errors import UsageError  # noqa: E402
from share.geometry import se3  # noqa: E402
from share.lab.emulate.recipe import SessionRecipe  # noqa: E402
from share.mapping.graph.solver import PoseGraphSolver  # noqa: E402
from share.mapping.mapper import Mapper  # noqa: E402
from share.mapping.places import FindKeyframe, PlaceNewsLog  # noqa: E402
from share.site.directory import PlaceDirectory, RoomRanking  # noqa: E402
from share.site.room_finder import RoomFinder, RoomFound  # noqa: E402
from share.types import Keyframe  # noqa: E402

SCENES = ("warehouse", "firestation")
SPACING = Spacing(0.3, 0.35, 0.33)
EVERY, MOST = 10, 15  # keyframes between starts, and until a search is given up
IN_VIEW_M, IN_VIEW_RAD = 1.5, np.radians(40.0)
HEAD = (
    "rooms",
    "starts",
    "in view",
    "found",
    "keyframes: median, 90 %",
    "in 3 %",
    "in its twin",
    "in a wrong room",
    "never",
)


@dataclass(frozen=True)
class Carried:
    """One start. keyframes: until it was found, in room `found`; None: it was not."""

    room: str
    is_twin: bool
    in_view: bool
    keyframes: int | None
    found: str | None

    @property
    def is_in_twin(self) -> bool:
        """Whether it was found in its room of the other day. Rooms are named SEED-DAY."""
        return self.found not in (None, self.room) and self.found.split("-")[0] == self.room.split("-")[0]


class Room:
    """One room's mapper, which answers at once."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.mapper = Mapper(Config(), news=PlaceNewsLog())
        self._solver = PoseGraphSolver()

    def add_run(self, run: str, agent: AgentKeyframes) -> None:
        self.mapper.add_run(run, replace(agent.hello, name=run))

    def add(self, run: str, keyframe: Keyframe) -> None:
        self.mapper.add_keyframe(run, keyframe)
        self.work()

    def work(self) -> None:
        while (step := self.mapper.next_lookup()) is not None:
            self.mapper.finish_step(step, step.run(), 1.0)
            while (solve := self.mapper.next_solve()) is not None:
                self.mapper.finish_step(solve, solve.run(self._solver), 1.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rooms", type=int, default=50)
    parser.add_argument("--twins", type=int, default=10)
    parser.add_argument("--seed", type=int, default=7100)
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return exit_code("measure_rooms", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    if not 0 <= 2 * options.twins <= options.rooms:
        raise UsageError("--twins: at most half of the rooms")
    originals = options.rooms - options.twins
    directory, rooms = PlaceDirectory(), dict[str, Room]()
    walks = dict[str, tuple[AgentKeyframes, AgentKeyframes]]()
    for k in range(options.rooms):
        seed, day = (options.seed + k, 0) if k < originals else (options.seed + k - originals, 1)
        recipe = SessionRecipe(SCENES[seed % 2], ("walk:", "walk:"), options.seconds, seed, day=day)
        first, second = keyframe_set(recipe, SPACING, workers=options.workers).agents.values()
        name = f"{seed}-{day}"
        rooms[name], walks[name] = Room(name), (first, second)
        rooms[name].add_run(f"{name}-first", first)
        for keyframe in first.keyframes:
            rooms[name].add(f"{name}-first", keyframe)
        for news in rooms[name].mapper.take_place_news():
            directory.update(name, news)
        print(f"{name}: {len(first.keyframes)} and {len(second.keyframes)} keyframes", flush=True)
    names = list(rooms)
    twins = {*names[: options.twins], *names[originals:]}
    carried = [
        _carry(directory, rooms, name, walks[name], start, name in twins)
        for name in names
        for start in range(0, len(walks[name][1].keyframes) - 3, EVERY)
    ]
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))))
    for kind, some in (
        ("of their own", [one for one in carried if not one.is_twin]),
        ("with a twin", [one for one in carried if one.is_twin]),
    ):
        print(
            line(_row(kind, some)), line(_row(f"{kind}, in view", [x for x in some if x.in_view])), sep="\n"
        )
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(one) for one in carried]) + "\n")


def _carry(
    directory: PlaceDirectory,
    rooms: dict[str, Room],
    name: str,
    walks: tuple[AgentKeyframes, AgentKeyframes],
    start: int,
    is_twin: bool,
) -> Carried:
    """Let the second agent of a room begin lost at one of its keyframes, and search it."""
    first, second = walks
    (metres,), (angles,) = se3.pairwise_distances(second.T_world_body[start][None], first.T_world_body)
    in_view = bool(((metres < IN_VIEW_M) & (angles < IN_VIEW_RAD)).any())
    lost, finder, run = Room("lost"), RoomFinder(), f"{name}-second-{start}"
    lost.add_run(run, second)
    found: tuple[int, str] | None = None
    for count, keyframe in enumerate(second.keyframes[start : start + MOST], 1):
        if count == 1:
            keyframe = replace(
                keyframe, reference=-1, T_ref_body=keyframe.T_odom_body, earlier=EarlierPoses.empty()
            )
        lost.add(run, keyframe)
        for news in lost.mapper.take_place_news():
            ranking = directory.update("lost", news)
            if ranking is not None and found is None:
                place = _search(ranking, finder, rooms, second)
                found = None if place is None else (count, place.room)
        if found is not None:
            break
    directory.remove_room("lost")
    return Carried(name, is_twin, in_view, *(found or (None, None)))


def _search(
    ranking: RoomRanking, finder: RoomFinder, rooms: dict[str, Room], agent: AgentKeyframes
) -> RoomFound | None:
    """Let the rooms that look like a keyframe search it, at once."""
    keyframe = agent.keyframes[ranking.key.id]
    now_ns, found = keyframe.stamp_ns, None
    for room in finder.choose_rooms(ranking, keyframe.T_odom_body, now_ns):
        mapper = rooms[room].mapper
        mapper.search.add(FindKeyframe(ranking.key, keyframe, agent.hello.rig))
        rooms[room].work()
        for answer in mapper.search.take_answers():
            found = finder.add_answer(room, answer.key, answer.place, now_ns) or found
    return found


def _row(kind: str, carried: list[Carried]) -> list[str]:
    found = [one for one in carried if one.found == one.room]
    counts = [one.keyframes for one in found if one.keyframes is not None]
    most = f"{np.median(counts):.0f}, {np.quantile(counts, 0.9):.0f}" if counts else "–"
    soon = sum(count <= 3 for count in counts) / max(1, len(carried))
    twin = sum(one.is_in_twin for one in carried)
    never = sum(one.found is None for one in carried)
    in_view = sum(one.in_view for one in carried)
    return [
        kind,
        *map(str, (len(carried), in_view, len(found))),
        most,
        f"{100 * soon:.0f}",
        str(twin),
        str(len(carried) - len(found) - twin - never),
        str(never),
    ]


if __name__ == "__main__":
    raise SystemExit(main())
