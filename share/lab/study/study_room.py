"""The edge of one trial as a process, started by letter, and a client of it: it shows spots, sees cubes and
sends the robot."""

from __future__ import annotations

import base64
import re
import time
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from share.errors import ShareError, UsageError
from share.files.json_file import parse_json
from share.files.line_file import GrowingFile
from share.geometry.se3 import from_rt, so3_exp
from share.lab.evaluate.real_time import running_child
from share.lab.study.floor import SPOT_ID, STUDY_NAME, StudyFloor
from share.net.http_guard import read_token
from share.net.keys import agent_keys, default_folder, has_pair
from share.net.transport import parse_address
from share.protocol.room_events import ClientEffect, MessageWanted
from share.runtime.room_link import RoomLink
from share.wire.room_messages import Cancel, Goto, ObjectKind, PutObject, RemoveObject, RoomObject

_START_S = 120.0  # for the edge, on a busy machine
_HTTP_S = 1.0
SILENT_S = 10.0  # an edge that does not answer for so long is gone
_LISTENING, _STATUS, _KEY = r"listening on (tcp://\S+?),", r"status at http://(\S+?)/", r"public key '(\S+)';"
_OWN_OPTIONS = ("--policy", "--blind", "--out", "--json")


@dataclass(frozen=True)
class EdgeOptions:
    """Options of `share edge`, as the researcher gives them after `--`. Raises UsageError for ones that the
    study sets."""

    given: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for one in self.given:
            if (name := one.partition("=")[0]) in _OWN_OPTIONS:
                raise UsageError(f"{name}: the study sets it; leave it out behind --")

    def value(self, name: str) -> str | None:
        """Return the last value of an option, None where it is not given."""
        found = None
        for k, one in enumerate(self.given):
            if one == name and k + 1 < len(self.given):
                found = self.given[k + 1]
            elif one.startswith(f"{name}="):
                found = one.partition("=")[2]
        return found

    @property
    def keys_folder(self) -> Path | None:
        """Where the edge's keys are; None: it uses none."""
        folder = self.value("--keys")
        if folder is not None:
            return Path(folder)
        is_local = parse_address(self.value("--bind") or "tcp://127.0.0.1:0", bind=True).local
        return None if is_local or not has_pair(default_folder()) else default_folder()

    def complete(self, key: Path, letter: str, out: Path) -> list[str]:
        """Return all options of the edge of a trial."""
        more = [] if self.keys_folder else ["--allow", "commands", "--allow", "objects"]
        status = [] if self.value("--http") else ["--http", "0"]
        return [*self.given, *more, *status, "--blind", f"{key}:{letter}", "--out", str(out)]


@dataclass(eq=False)
class StudyRoom:
    """A running edge and the study's client of it, from `__enter__` to `__exit__`.

    out: a new folder of the edge's; its log is beside it. say: takes the edge's lines for the researcher."""

    options: EdgeOptions
    key: Path
    letter: str
    out: Path
    say: Callable[[str], None]
    _stack: ExitStack = field(default_factory=ExitStack)
    _silent_since_s: float | None = None

    def __enter__(self) -> StudyRoom:
        log = self.out.with_name(f"{self.out.name}.log")
        log.parent.mkdir(parents=True, exist_ok=True)
        arguments = self.options.complete(self.key, self.letter, self.out)
        with ExitStack() as stack:
            self._process = stack.enter_context(running_child(log, "edge", *arguments))
            self._log, self._said = GrowingFile(log), list[str]()
            address, status = self._wait_for(_LISTENING), self._wait_for(_STATUS)
            folder = self.options.keys_folder
            keys = None if folder is None else agent_keys(folder, self._wait_for(_KEY))
            self._link = RoomLink(
                _on_this_machine(address), STUDY_NAME, keys, wants_objects=True, wants_robots=True
            )
            stack.callback(self._link.close)
            self._status = f"http://{_on_this_machine(status)}/snapshot.json"
            self._headers = self._token_header()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _wait_for(self, pattern: str) -> str:
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s:
            self.show_log()
            for line in self._said:
                if match := re.search(pattern, line):
                    return match[1]
            if self._process.poll() is not None:
                break
            time.sleep(0.02)
        raise ShareError(f"the edge did not start: {self._last_line}")

    def show_log(self) -> None:
        """Show the researcher what the edge has said since, but of the study's own doings."""
        for line in self._log.new_lines():
            self._said.append(line)
            if f"'{STUDY_NAME}'" not in line:
                self.say(f"edge: {line}")

    @property
    def _last_line(self) -> str:
        self.show_log()
        return self._said[-1].removeprefix("share: ") if self._said else "it said nothing"

    def _token_header(self) -> dict[str, str]:
        token_file = self.options.value("--http-token")
        if token_file is None:
            return {}
        basic = base64.b64encode(f"share:{read_token(Path(token_file))}".encode()).decode()
        return {"Authorization": f"Basic {basic}"}

    # ------------------------------------------------------------ what it tells

    @property
    def objects(self) -> dict[int, RoomObject]:
        return self._link.client.objects

    @property
    def knows_objects(self) -> bool:
        """Whether all objects of the room have come."""
        return self._link.client.has_all_objects

    def step(self, timeout_ms: int) -> list[ClientEffect]:
        """Wait for news of the room for at most this time. Raises ShareError if the edge refuses us."""
        self.show_log()
        return self._link.step(timeout_ms)

    def broken(self) -> str | None:
        """Return why the edge is gone; None while it is not."""
        if (code := self._process.poll()) is not None:
            return f"the edge ended (exit code {code}): {self._last_line}"
        now_s = time.monotonic()
        if self._link.client.is_connected:
            self._silent_since_s = None
        elif self._silent_since_s is None:
            self._silent_since_s = now_s
        elif now_s - self._silent_since_s > SILENT_S:
            return f"the edge has not answered for {SILENT_S:g} s: {self._link.trouble}"
        return None

    def report(self) -> tuple[dict[str, Any] | None, str]:
        """Return the edge's report (/snapshot.json), or None and why there is none."""
        request = urllib.request.Request(self._status, headers=self._headers)
        try:
            with urllib.request.urlopen(request, timeout=_HTTP_S) as answer:
                report = parse_json(answer.read())
        except (OSError, ValueError) as error:
            return None, str(error)
        return (report, "") if isinstance(report, dict) and "agents" in report else (None, "it starts")

    # ------------------------------------------------------------ what is done in the room

    def show_spot(self, floor: StudyFloor, place: tuple[float, float]) -> None:
        T = floor.in_map(*place)
        pose = from_rt(so3_exp(np.array([0.0, 0.0, T.yaw])), np.array([T.x, T.y, floor.z]))
        message = PutObject(next(self._link.numbers), SPOT_ID, ObjectKind.MARKER, floor.map_id, pose)
        self._link.handle(MessageWanted(message))

    def remove(self, object_id: int) -> None:
        if object_id in self.objects:
            self._link.handle(MessageWanted(RemoveObject(next(self._link.numbers), object_id)))

    def send_robot(self, floor: StudyFloor, place: tuple[float, float], robot: str | None) -> int:
        """Return the number of the command. robot: None: the only one."""
        T, number = floor.in_map(*place), next(self._link.numbers)
        self._link.handle(MessageWanted(Goto(number, robot, "", floor.map_id, T.x, T.y)))
        return number

    def stop_robot(self) -> None:
        self._link.handle(MessageWanted(Cancel(next(self._link.numbers), None)))

    @property
    def is_idle(self) -> bool:
        """Whether nothing that was asked for waits for an answer."""
        return self._link.client.is_idle


def _on_this_machine(address: str) -> str:
    """Return how an address that the edge is bound to is reached from here."""
    return address.replace("0.0.0.0", "127.0.0.1").replace("[::]", "[::1]")
