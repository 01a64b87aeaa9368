"""Two honest agents in a process of their own: the product's agent, with keyframes from a room of points.

    python honest.py ADDRESS FRAMES ACKS [AGENT_KEYS SERVER_KEY] < (a line when to finish)

A line of ACKS is an acknowledgement as it came: name, run id, keyframe. Prints JSON: of each
agent when each keyframe was sent, acknowledged and corrected (CLOCK_MONOTONIC, s).
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(Path(__file__).parent)]

from share import startup  # noqa: E402

startup.prepare_process()

import numpy as np  # noqa: E402
from helpers import crowd  # noqa: E402
from helpers.edge_sim import Person, walls  # noqa: E402
from raw_wire import unpack  # noqa: E402

from share.geometry import se3  # noqa: E402
from share.net.transport import AgentLink, connect  # noqa: E402
from share.protocol import agent_events as ev  # noqa: E402
from share.types import F64  # noqa: E402
from share.wire.messages import public_tag  # noqa: E402

NAMES = ("hope", "faith")
NEWEST = 10  # keyframes of each, whose places in the map are compared with the truth
CHUNK = 300  # frames made ahead


class Endless(crowd.Script):
    """A script that is made as it is played."""

    def __init__(self, person: Person, frames: int) -> None:
        object.__setattr__(self, "T_odom_body", _Poses(person, frames))
        object.__setattr__(self, "views", self.T_odom_body.views)


class _Poses(Sequence[Any]):
    def __init__(self, person: Person, frames: int) -> None:
        self._person, self._frames, self.views = person, frames, _Views()
        self._last = (-1, np.eye(4))

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, k: Any) -> Any:
        if k != self._last[0] and k % crowd.EVERY == 0:
            T, view = self._person.step()
            self._last = (k, T)
            self.views.at = (k, view)
        return self._last[1]


class _Views(dict[int, Any]):
    at: tuple[int, Any] = (-1, None)

    def get(self, k: int, default: Any = None) -> Any:
        return self.at[1] if k == self.at[0] else default


class Watched:
    """A link that notes when keyframes go and their acknowledgements and corrections come."""

    def __init__(self, link: AgentLink, note: Callable[[int], None]) -> None:
        self._link, self._note = link, note
        self.sent: dict[int, float] = {}
        self.acked: dict[int, float] = {}
        self.corrected: dict[int, float] = {}
        self._below = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def send(self, frames: Sequence[Any]) -> bool:
        fields: Any = unpack(bytes(frames[0]))
        if fields[1] == 3:
            self.sent.setdefault(fields[2][0], time.monotonic())
        return self._link.send(frames)

    def receive(self, timeout_ms: int) -> list[bytes] | None:
        frames = self._link.receive(timeout_ms)
        if frames is not None:
            with contextlib.suppress(ValueError, LookupError, TypeError):
                self._hear(unpack(frames[0]))
        return frames

    def _hear(self, fields: Any) -> None:
        now, code, scalars = time.monotonic(), fields[1], fields[2]
        if code == 18:
            for k in range(self._below, min(scalars[0], len(self.sent) + self._below + 1000)):
                self.acked.setdefault(k, now)
                self._note(k)
            self._below = max(self._below, min(scalars[0], 10**7))
        elif code == 19:
            self.corrected.setdefault(scalars[3], now)


class Honest(crowd.Walker):
    """As `Walker`; and it can be asked what it met with.

    placed: of its newest keyframes, the map, and where they are there and in truth."""

    def __init__(self, person: Person, script: crowd.Script, address: str) -> None:
        super().__init__(person.hello, script, address)
        self._person = person
        self.placed: deque[tuple[str, F64, F64]] = deque(maxlen=NEWEST)
        handle = self.machine.handle

        def watched(event: ev.AgentEvent, now_ns: int) -> list[ev.AgentEffect]:
            effects = handle(event, now_ns)
            if isinstance(event, ev.FrameTracked) and event.is_keyframe:
                for effect in effects:
                    if isinstance(effect, ev.LocalisedPose) and effect.T_map_odom is not None:
                        self._place(str(effect.map_id), effect.T_map_odom @ effect.T_odom_body)
            return effects

        self.machine.handle = watched  # type: ignore[method-assign]

    def _place(self, map_id: str, T_map_body: F64) -> None:
        self.placed.append((map_id, T_map_body[:3, 3], self._person.T_world_body[-1][:3, 3]))

    def figures(self) -> dict[str, Any]:
        link = self.link
        report = self.machine.report()
        return {
            "name": self.name,
            "tag": public_tag(self._run_id),
            "keyframes": report["keyframes"],
            "open": report["pending"],
            "drop_oldest": report["drop_oldest"],
            "sent": sorted(link.sent.items()),
            "acked": sorted(link.acked.items()),
            "corrected": sorted(link.corrected.items()),
            "map": self.maps[-1][1] if self.maps else None,
            "sessions": len(self.lives),
            "said": self.said[-20:],
            "error": None if self.error is None else f"{type(self.error).__name__}: {self.error}",
            "running": self.is_alive(),
        }


def joint_error_m(agents: list[Honest]) -> float:
    """RMSE of where both were told to be, in one alignment with the truth; inf unless that is one map."""
    placed = [row for agent in agents for row in list(agent.placed)]
    if len({row[0] for row in placed}) != 1 or not all(agent.placed for agent in agents):
        return float("inf")
    found, true = (np.array([row[k] for row in placed]) for k in (1, 2))
    off = se3.transform(se3.umeyama(found, true), found) - true
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def main() -> None:
    address, frames = sys.argv[1], int(sys.argv[2])
    keys = None
    if len(sys.argv) > 4:
        from share.net.keys import agent_keys

        keys = agent_keys(Path(sys.argv[4]), sys.argv[5])
    acks = open(sys.argv[3], "a", buffering=1)  # noqa: SIM115 (as long as the process)
    place = walls(1)
    agents = []
    for i, name in enumerate(NAMES):
        person = Person(name, place, 0.5 * i, int(time.time_ns() % 2**40) + i)
        agents.append(Honest(person, Endless(person, frames), address))

    def watched(to: str, run_id: int) -> Watched:
        (agent,) = [a for a in agents if a._run_id == run_id]
        line = f"{agent.name} {run_id} "
        agent.link = Watched(connect(to, run_id, keys), lambda k: _note(acks, line, k))  # type: ignore[attr-defined]
        return agent.link  # type: ignore[attr-defined, no-any-return]

    crowd.connect = watched  # type: ignore[assignment]
    for agent in agents:
        agent.start()
    threading.Thread(target=_finish_when_told, args=(agents,), daemon=True).start()
    while any(agent.is_alive() and not agent.lives for agent in agents):
        time.sleep(0.02)
    print("welcomed", file=sys.stderr, flush=True)
    for agent in agents:
        agent.join()
    print(_told(agents))


def _told(agents: list[Honest]) -> str:
    error_m = joint_error_m(agents)
    return json.dumps([{**agent.figures(), "joint_error_m": error_m} for agent in agents])


def _note(acks: TextIO, line: str, number: int) -> None:
    acks.write(f"{line}{number}\n")


def _finish_when_told(agents: list[Honest]) -> None:
    sys.stdin.readline()
    for agent in agents:
        agent.finish()
    deadline = time.monotonic() + 25
    for agent in agents:
        agent.join(max(0.0, deadline - time.monotonic()))
    if any(agent.is_alive() for agent in agents):
        print(_told(agents), flush=True)
        import os

        os._exit(0)


if __name__ == "__main__":
    main()
