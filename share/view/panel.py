"""The side panel: a block of HTML for each agent. Whatever comes from outside is escaped."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from share.agent_names import natural_order
from share.protocol.agent_health import LIMITS, has_left, is_lost
from share.types import AgentKind
from share.view import events as ev
from share.view.room import DrawnRoom, LastCorrection

_MOST_LIMITS = 5.0  # height of a sparkline, in limits; what is later touches its top
_MAX_SPARKLINE_POSES = 150  # poses in a sparkline: ten seconds at 15 Hz
_WIDTH, _HEIGHT = 240.0, 34.0  # px, of a sparkline
_BAD, _GOOD, _DIM = "#e5484d", "#30a46c", "opacity:.65"
_NAME = f"{_DIM};padding-right:8px;vertical-align:top"
_BODY = "font:12px/1.4 system-ui,sans-serif;padding:2px 10px;overflow-wrap:anywhere"
_SPARKLINE = "width:100%;max-width:320px;display:block;overflow:visible"
_SMALL_SPARKLINE = "width:14%;height:1em;float:right;margin-top:3px"
_MAX_MERGE_LINES = 4  # newest merges
_MAX_FULL = 4  # agents of which all is shown; of more, a line each


@dataclass
class _AgentHistory:
    ages_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_SPARKLINE_POSES))
    decision: str = ""


class SidePanel:
    """Keeps the newest report and decisions of each agent. Times are the viewer's, s."""

    def __init__(self) -> None:
        self._history: dict[str, _AgentHistory] = {}  # by name
        self._names: dict[str, str] = {}  # by run
        self._report = ev.AgentsReported()
        self.loading = ""  # what the room is waiting for
        self._merges: deque[str] = deque(maxlen=_MAX_MERGE_LINES)
        self._merge_count = 0

    @property
    def agents(self) -> dict[str, str]:
        """Names of the agents that are present, by run."""
        return {a["run"]: label for label, a in self._report.agents.items() if not has_left(a)}

    def apply(self, event: ev.RoomEvent) -> None:
        match event:
            case ev.RunArrived():
                self._names[event.run] = event.name
            case ev.PoseArrived() if event.age_ms is not None:
                self._of(self._names.get(event.run, event.run)).ages_ms.append(event.age_ms)
            case ev.DecisionMade():
                if event.agent is not None:
                    self._of(event.agent).decision = f"{event.event}: {event.reason}"
                if event.event in ev.MERGES:
                    name_html = "" if event.agent is None else f" {event.agent}:"
                    self._merge_count += 1
                    self._merges.append(f"{event.t_s:.1f} s {event.event}:{name_html} {event.reason}")
            case ev.AgentsReported():
                self._report = event

    def html(self, room: DrawnRoom, now_s: float) -> str:
        """Return the panel as it is now."""
        parts = [f'<div style="color:{_BAD}">{escape(line)}</div>' for line in self._report.trouble]
        if self._report.left_out:
            text = f"{self._report.left_out} updates were dropped: this view is too slow"
            parts.append(f'<div style="color:{_BAD}">{text}</div>')
        agents = sorted(self._report.agents.items(), key=_by_urgency)
        present_count = sum(not has_left(agent) for _, agent in agents)
        if present_count > _MAX_FULL:
            parts.append(_counts([agent for _, agent in agents]))
        for label, agent in agents:
            run = room.runs.get(agent["run"])
            swatch = "rgb({}, {}, {})".format(*((128, 128, 128) if run is None else room.colour(run)))
            if present_count > _MAX_FULL or has_left(agent):
                parts.append(_line(label, agent, swatch, tuple(self._of(label).ages_ms)))
            else:
                parts.append(self._agent(label, agent, swatch, room.corrections.get(agent["run"]), now_s))
        if self._merges:
            lines = "".join(f"<div>{escape(line)}</div>" for line in reversed(self._merges))
            more = "" if self._merge_count <= len(self._merges) else f", the newest of {self._merge_count}"
            parts.append(f'<div style="margin-top:8px"><b>merges</b>{more}{lines}</div>')
        body = escape(self.loading) + "".join(parts) or "no agent yet"
        return f'<div style="{_BODY}">{body}</div>'

    def _of(self, name: str) -> _AgentHistory:
        return self._history.setdefault(name, _AgentHistory())

    def _agent(
        self, label: str, agent: Any, swatch: str, corrected: LastCorrection | None, now_s: float
    ) -> str:
        history, limit_ms = self._of(label), LIMITS[AgentKind(agent["kind"])].pose_ms
        ages = tuple(history.ages_ms)
        rate = "" if agent["rate_hz"] is None else f", at most {agent['rate_hz']:.1f} Hz"
        rows = [("keyframes", f"{agent['keyframes']}{rate}")]
        if agent["qoe"] is not None:
            rows.insert(0, ("QoE", f"{agent['qoe']:.2f} (target {agent['qoe_target']:.2f})"))
        if agent["delay_ms"] is not None:
            rows.append(("delay", _duration(agent["delay_ms"], 0)))
        if agent["pose_ms"] is not None:
            rows.append(("pose age", f"{_duration(agent['pose_ms'], 1)}, limit {limit_ms:.0f} ms"))
        if corrected is not None:
            how_far = f"{1e3 * corrected.moved_m:.0f} mm, {max(0.0, now_s - corrected.at_s):.0f} s ago"
            rows.append(("correction", how_far))
        if agent["map_id"] is not None:
            rows.append(("map", str(agent["map_id"])))
        cells = "".join(
            f'<tr><td style="{_NAME}">{name}</td><td>{escape(value)}</td></tr>' for name, value in rows
        )
        decision = f'<div style="{_DIM}">{escape(history.decision)}</div>' if history.decision else ""
        return (
            f'<div style="margin:0 0 10px">{_head(label, agent, swatch)}{_faults(agent)}'
            f"{sparkline(ages, limit_ms, swatch)}<table>{cells}</table>{decision}</div>"
        )


def _by_urgency(item: tuple[str, Any]) -> tuple[Any, ...]:
    """Return a key that puts agents in trouble first, and who is gone last."""
    label, agent = item
    return has_left(agent), not agent["trouble"], natural_order(label)


def _counts(agents: Sequence[Any]) -> str:
    present = [agent for agent in agents if not has_left(agent)]
    troubled = sum(bool(agent["trouble"]) for agent in present)
    trouble = f'<span style="color:{_BAD}">{troubled} in trouble</span>' if troubled else ""
    parts = [f"{len(present)} agents", trouble]
    parts.append(f"{len(agents) - len(present)} gone" * (len(present) < len(agents)))
    return f'<div style="margin:0 0 6px"><b>{", ".join(filter(None, parts))}</b></div>'


def _head(label: str, agent: Any, swatch: str, more: str = "") -> str:
    """Return an agent's name, kind and state. The state alone is not bad where something else is wrong."""
    is_gone = has_left(agent)
    state = "gone" if is_gone else agent["state"]
    is_bad, is_good = is_lost(agent) and not is_gone, not is_gone and not agent["trouble"]
    colour = _BAD if is_bad else _GOOD if is_good else "inherit"
    return (
        f'<div><span style="color:{swatch}">&#9632;</span> <b>{escape(label)}</b> {escape(agent["kind"])} '
        f'<b style="color:{colour}">{escape(state)}</b>{more}</div>'
    )


def _faults(agent: Any) -> str:
    return "".join(f'<div style="color:{_BAD}">{escape(line)}</div>' for line in agent["trouble"] or ())


def _line(label: str, agent: Any, swatch: str, ages_ms: tuple[float, ...]) -> str:
    """Return an agent on one line, and what is wrong with it below."""
    if has_left(agent):
        return f'<div style="opacity:.5">{_head(label, agent, swatch)}</div>'
    figures = [] if agent["pose_ms"] is None else [_duration(agent["pose_ms"], 0)]
    figures += [] if agent["qoe"] is None else [f"QoE {agent['qoe']:.2f}"]
    more = f' <span style="{_DIM}">{" · ".join(figures)}</span>'
    line = sparkline(ages_ms, LIMITS[AgentKind(agent["kind"])].pose_ms, swatch, is_small=True)
    return f"<div>{line}{_head(label, agent, swatch, more)}{_faults(agent)}</div>"


def _duration(ms: float, digits: int) -> str:
    return f"{ms:.{digits}f} ms" if ms < 1000 else f"{ms / 1000:.1f} s"


def sparkline(values: tuple[float, ...], limit: float, colour: str, is_small: bool = False) -> str:
    """Return an SVG of values over time, with a dashed line at `limit`; "" without values. is_small: for a
    line of text, so without words."""
    if not values:
        return ""
    top = limit * min(_MOST_LIMITS, max(2.0, *(value / limit for value in values)))
    step = _WIDTH / (_MAX_SPARKLINE_POSES - 1)
    y = [_HEIGHT * (1 - min(value, top) / top) for value in values]
    points = " ".join(f"{step * k:.1f},{height:.1f}" for k, height in enumerate(y))
    limit_y = _HEIGHT * (1 - limit / top)
    line = f'<line x1="0" x2="{_WIDTH:.0f}" y1="{limit_y:.1f}" y2="{limit_y:.1f}"'
    plain = 'fill="none" vector-effect="non-scaling-stroke"'
    lines = (
        f'{line} stroke="{_BAD}" stroke-dasharray="4 3" {plain}/>'
        f'<polyline points="{points}" stroke="{colour}" stroke-width="1.3" {plain}/>'
    )
    if is_small:
        box = f'viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" preserveAspectRatio="none"'
        return f'<svg {box} style="{_SMALL_SPARKLINE}">{lines}</svg>'
    text = (
        f'<text x="{_WIDTH + 3:.0f}" y="{limit_y + 3:.1f}" font-size="9" fill="{_BAD}">{limit:.0f} ms</text>'
    )
    box = f'viewBox="0 0 {_WIDTH + 34:.0f} {_HEIGHT:.0f}"'
    return f'<svg {box} style="{_SPARKLINE}">{lines}{text}</svg>'
