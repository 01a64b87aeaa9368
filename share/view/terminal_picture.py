"""The room as text: a plan of paths in braille dots and a line for each agent, for where no browser is.

Pure: from the edge's report and plan (`/snapshot.json`, `/plan.json`) to lines with ANSI colours.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import click

from share.agent_names import natural_order
from share.colours import Colour, agent_colour
from share.errors import printable
from share.protocol.agent_health import LIMITS, has_left, is_lost
from share.types import AgentKind

MIN_COLUMNS, MIN_ROWS = 72, 18  # of a terminal in which it is worth while
_MOST_PLAN_ROWS = 16
_MARGIN_M, _LEAST_M = 0.5, 3.0  # around paths; least extent of a plan
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))  # of a braille cell, by row and column
_BRAILLE = 0x2800
_ARROWS = "→↗↑↖←↙↓↘"
_BLOCKS = "▁▂▃▄▅▆▇█"
_MAX_NAME = 20  # characters
_LEAST_PLAN_COLUMNS = 24  # in which names fit
_HISTORY = 16  # poses in a sparkline
_MAX_STEPS = 100_000  # dots between the ends of all lines of a plan; it has some ten thousand dots
_BAD: Colour = (229, 72, 77)
_GOOD: Colour = (48, 164, 108)
Report = Mapping[str, Any]


def _name_of(label: str) -> str:
    """Return the name of an agent without the tag that an earlier run has."""
    return label.partition("/")[0]


class TerminalPicture:
    """Remembers agents' colours and pose ages between pictures."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._ages_ms: dict[str, deque[float]] = {}

    def lines(self, report: Report, plan: Report, columns: int, rows: int) -> list[str]:
        """Return the picture, at most `rows` lines of at most `columns` characters."""
        agents = {name: one for name, one in report.get("agents", {}).items() if not has_left(one)}
        for label in (*report.get("agents", {}), *plan.get("agents", {})):  # in the order in which they came
            self._numbers.setdefault(_name_of(label), len(self._numbers))
        for name, one in agents.items():
            if one.get("pose_ms") is not None:
                self._ages_ms.setdefault(name, deque(maxlen=_HISTORY)).append(one["pose_ms"])
        text = self._agent_lines(agents, columns, max(1, rows - 6))
        height = min(_MOST_PLAN_ROWS, rows - len(text) - 1)
        return [*self._plans(report, plan, columns, height), *text]

    def _colour(self, name: str) -> Colour:
        return agent_colour(self._numbers.get(_name_of(name), 0))

    # ------------------------------------------------------------------ a line for each agent

    def _agent_lines(self, agents: Report, columns: int, rows: int) -> list[str]:
        """Return a line for each agent and one for its trouble; if not all fit, agents in trouble first, and
        the number left out."""
        names = sorted(agents, key=natural_order)
        width = min(_MAX_NAME, max([10, *map(len, names)]))
        troubled = [name for name in names if agents[name].get("trouble")]
        needed = len(names) + len(troubled)
        if needed <= rows:
            lines = [self._figures_line(name, agents[name], width, columns) for name in names]
            return [*lines, *(_trouble_line(name, agents[name], columns) for name in troubled)]
        lines, shown = [], 0
        for name in (*troubled, *(name for name in names if name not in troubled)):
            block = [self._figures_line(name, agents[name], width, columns)]
            if name in troubled:
                block.append(_trouble_line(name, agents[name], columns))
            if len(lines) + len(block) > rows - 1:
                break
            lines, shown = [*lines, *block], shown + 1
        left_troubled = max(0, len(troubled) - shown)
        line = _Line(columns)
        line.add(f"and {len(names) - shown} more of {len(names)} agents, {left_troubled} of them in trouble")
        return [*lines, line.text()]

    def _figures_line(self, name: str, agent: Report, width: int, columns: int) -> str:
        """Return how an agent fares. width: of its name, characters."""
        limit_ms = LIMITS[AgentKind(agent["kind"])].pose_ms
        state = str(agent.get("state") or "–")
        line = _Line(columns)
        line.add("■ ", self._colour(name))
        line.add(f"{_shortened(name, width):{width}} {agent['kind']:5} ")
        is_good = not agent.get("trouble")
        line.add(f"{state[:12]:12} ", _BAD if is_lost(agent) else _GOOD if is_good else None)
        pose_ms, ages_ms = agent.get("pose_ms"), self._ages_ms.get(name, ())
        line.add(f"{_fixed(pose_ms, 1):>6} ", _BAD if (pose_ms or 0) > limit_ms else None)
        line.add(f"of {limit_ms:3.0f} ms  ")
        line.add(f"QoE {_fixed(agent.get('qoe'), 2):>4} ({_fixed(agent.get('qoe_target'), 2)})  ")
        line.add(f"{_fixed(agent.get('rate_hz'), 1):>4} Hz  ")
        for age_ms in ages_ms:
            block = _BLOCKS[min(len(_BLOCKS) - 1, int(4 * age_ms / limit_ms))]
            line.add(block, _BAD if age_ms > limit_ms else self._colour(name))
        line.add(f"{'':{_HISTORY - len(ages_ms)}}  {agent.get('keyframes') or 0} keyframes")
        return line.text()

    # ------------------------------------------------------------------ plans

    def _plans(self, report: Report, plan: Report, columns: int, rows: int) -> list[str]:
        """Return plans of maps beside each other, each under its own scale, and a line of captions. Of more
        than there is room for, those in which the most agents are."""
        agents = _with_presence(plan.get("agents", {}), report.get("agents", {}))
        ids = list(dict.fromkeys(part["map_id"] for one in agents.values() for part in one["parts"]))
        if not ids or rows < 3:
            return []
        members = Counter(one["map_id"] for one in agents.values() if one.get("position"))
        shown = sorted(ids, key=lambda map_id: -members[map_id])[: max(1, columns // _LEAST_PLAN_COLUMNS)]
        more = [f"and {len(ids) - len(shown)} more maps"] if len(shown) < len(ids) else []
        width = columns // len(shown) - 1
        drawn = [self._plan(map_id, agents, width, rows - 1 - len(more)) for map_id in shown]
        return [*(" ".join(parts) for parts in zip(*drawn, strict=True)), *more]

    def _plan(self, map_id: str, agents: Report, width: int, rows: int) -> list[str]:
        """Return `rows` lines and a caption, each `width` characters wide."""
        paths = {
            name: [part["path"] for part in one["parts"] if part["map_id"] == map_id]
            for name, one in agents.items()
        }
        here = {name: one for name, one in agents.items() if one["map_id"] == map_id and one.get("position")}
        points = [p for parts in paths.values() for path in parts for p in path]
        points += [one["position"] for one in here.values()]
        if not points:
            return [" " * width] * (rows + 1)
        canvas = _Canvas(points, width, rows)
        for name, parts in paths.items():
            for path in parts:
                canvas.draw_path(path, self._colour(name))
        for name, one in here.items():
            canvas.draw_agent(name, one, _BAD if one["is_lost"] else self._colour(name))
        caption = _map_caption(sorted(here, key=natural_order), f", {canvas.metres_wide:.0f} m wide", width)
        return [*canvas.lines(), f"{printable(caption[:width]):{width}}"]


def _with_presence(plans: Report, agents: Report) -> dict[str, Any]:
    """Return the plan's agents, with `is_lost`; without a place where they have left."""
    out = {}
    for name, one in plans.items():
        agent = agents.get(name, {})
        where = None if has_left(agent) else one.get("position")
        out[name] = {**one, "position": where, "is_lost": is_lost(agent)}
    return out


def _map_caption(names: Sequence[str], scale: str, width: int) -> str:
    """Return who is in a map and how wide it is; of more names than fit, how many there are."""
    for count in range(len(names), 0, -1):
        more = f" and {len(names) - count} more" if count < len(names) else ""
        if len(caption := f"map of {', '.join(names[:count])}{more}{scale}") <= width:
            return caption
    return f"map of {len(names)} agents{scale}" if names else f"map of no agent now{scale}"


def _trouble_line(name: str, agent: Report, columns: int) -> str:
    """Return what is wrong with an agent."""
    line = _Line(columns)
    line.add(f"  {_shortened(name, _MAX_NAME)}: {'; '.join(agent['trouble'])}", _BAD)
    return line.text()


def _shortened(name: str, width: int) -> str:
    """Return a name that is no wider; a cut one says so, and keeps its end, in which names differ."""
    return name if len(name) <= width else f"{name[: width - 7]}…{name[-6:]}"


class _Line:
    """Coloured text, cut at a number of characters."""

    def __init__(self, columns: int) -> None:
        self._left, self._parts = columns, list[str]()

    def add(self, text: str, colour: Colour | None = None) -> None:
        text = printable(text[: self._left])
        self._left -= len(text)
        self._parts.append(text if colour is None else click.style(text, fg=colour))

    def text(self) -> str:
        return "".join(self._parts)


class _Canvas:
    """A plan of width x rows characters, 2 x 4 dots each."""

    def __init__(self, points: Sequence[Sequence[float]], width: int, rows: int) -> None:
        low, high = [[of(p[k] for p in points) for k in (0, 1)] for of in (min, max)]
        size = [max(_LEAST_M, high[k] - low[k] + 2 * _MARGIN_M) for k in (0, 1)]
        self._width, self._rows = width, rows
        self._m = max(size[0] / (2 * width), size[1] / (4 * rows))  # of a dot
        self._left = (low[0] + high[0]) / 2 - self._m * width
        self._top = (low[1] + high[1]) / 2 + self._m * 2 * rows
        self._dots: dict[tuple[int, int], int] = {}  # by row and column
        self._marks: dict[tuple[int, int], str] = {}
        self._colours: dict[tuple[int, int], Colour] = {}
        self._most_steps = _MAX_STEPS

    @property
    def metres_wide(self) -> float:
        return self._m * 2 * self._width

    def draw_path(self, path: Sequence[Sequence[float]], colour: Colour) -> None:
        for (x0, y0), (x1, y1) in pairwise(path):
            steps = 1 + min(int(math.hypot(x1 - x0, y1 - y0) / self._m), self._most_steps)
            self._most_steps -= steps - 1  # where all are spent only the ends are drawn
            for k in range(steps + 1):
                self._dot(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps, colour)

    def draw_agent(self, name: str, agent: Report, colour: Colour) -> None:
        """Draw a disc for a robot, an arrow for others, a cross for who is lost, and the name."""
        row, column = self._cell(*agent["position"])
        turn = round(4 * (agent.get("heading") or 0.0) / math.pi) % 8
        mark = "●" if agent["kind"] == AgentKind.ROBOT else _ARROWS[turn]
        mark = "✕" if agent["is_lost"] else mark
        text = f"{mark} {_shortened(name, self._width - 2)}"
        column = min(column, max(0, self._width - len(text)))
        for k, letter in enumerate(text[: self._width]):
            self._marks[row, column + k] = letter if letter.isprintable() else "?"
            self._colours[row, column + k] = colour

    def lines(self) -> list[str]:
        return [self._row(row) for row in range(self._rows)]

    def _row(self, row: int) -> str:
        parts = []
        cells = [(row, column) for column in range(self._width)]
        for colour, group in groupby(cells, self._colours.get):
            text = "".join(map(self._character, group))
            parts.append(text if colour is None else click.style(text, fg=colour))
        return "".join(parts)

    def _character(self, cell: tuple[int, int]) -> str:
        return self._marks.get(cell) or (chr(_BRAILLE + self._dots[cell]) if cell in self._dots else " ")

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        column, row = self._dot_at(x, y)
        return min(self._rows - 1, max(0, row // 4)), min(self._width - 1, max(0, column // 2))

    def _dot_at(self, x: float, y: float) -> tuple[int, int]:
        return int((x - self._left) / self._m), int((self._top - y) / self._m)

    def _dot(self, x: float, y: float, colour: Colour) -> None:
        column, row = self._dot_at(x, y)
        cell = self._cell(x, y)
        self._dots[cell] = self._dots.get(cell, 0) | _DOTS[row % 4][column % 2]
        self._colours[cell] = colour


def _fixed(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
