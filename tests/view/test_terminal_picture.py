"""The room as text: what is said of agents, and where they are on the plan."""

from __future__ import annotations

from typing import Any

import click
import pytest

from share.colours import agent_colour
from share.view.terminal_picture import _MAX_STEPS, TerminalPicture, _Canvas

COLUMNS, ROWS = 100, 24


def agent(kind: str = "ar", pose_ms: float | None = 6.0, **more: Any) -> dict[str, Any]:
    return {
        **{"kind": kind, "state": "OK", "pose_ms": pose_ms, "qoe": 0.8, "qoe_target": 0.75},
        **{"rate_hz": 3.2, "keyframes": 12, "gone": False, "trouble": []},
        **more,
    }


def place(
    path: list[list[float]], map_id: str = "a", kind: str = "ar", heading: float = 0.0
) -> dict[str, Any]:
    parts = [{"map_id": map_id, "path": path}]
    return {"kind": kind, "map_id": map_id, "parts": parts, "position": path[-1], "heading": heading}


EAST = [[0.1 * k, 0.0] for k in range(50)]
NORTH = [[0.0, 0.1 * k] for k in range(30)]


def drawn(
    report: dict[str, Any], plan: dict[str, Any], columns: int = COLUMNS, rows: int = ROWS
) -> list[str]:
    return [click.unstyle(line) for line in TerminalPicture().lines(report, plan, columns, rows)]


def test_a_line_says_how_an_agent_fares() -> None:
    (line,) = drawn({"agents": {"ann": agent()}}, {"agents": {}})
    for text in ("ann", "ar", "OK", "6.0 of  20 ms", "QoE 0.80 (0.75)", "3.2 Hz", "12 key"):
        assert text in line
    (robot,) = drawn({"agents": {"tom": agent("robot", None, qoe=None)}}, {"agents": {}})
    assert "of 200 ms" in robot and "QoE    – (0.75)" in robot


def test_late_poses_are_red_and_what_is_gone_is_left_out() -> None:
    picture = TerminalPicture()
    late = picture.lines({"agents": {"ann": agent(pose_ms=31.0)}}, {"agents": {}}, COLUMNS, ROWS)[0]
    soon = TerminalPicture().lines({"agents": {"ann": agent()}}, {"agents": {}}, COLUMNS, ROWS)[0]
    red = "\x1b[38;2;229;72;77m"
    assert late.count(red) == 2 and red not in soon  # the figure, and the mark in its history
    assert drawn({"agents": {"ann": agent(gone=True)}}, {"agents": {}}) == []


def test_who_is_silent_stays_in_sight_and_who_has_left_does_not() -> None:
    plan = {"agents": {"ann": place(EAST)}}
    missed = agent(gone=True, state="SILENT", trouble=["SILENT: silent for 9.0 s"])
    lines = drawn({"agents": {"ann": missed}}, plan)
    assert "✕ ann" in "".join(lines) and "→" not in "".join(lines)
    assert "SILENT" in lines[-2] and "silent for 9.0 s" in lines[-1]
    left = drawn({"agents": {"ann": agent(gone=True)}}, plan)
    assert "ann" not in "".join(left) and "map of no agent now" in left[-1]


def test_paths_and_agents_are_where_they_are() -> None:
    plan = {"agents": {"ann": place(EAST), "tom": place(NORTH, kind="robot")}}
    lines = drawn({"agents": {"ann": agent(), "tom": agent("robot")}}, plan)
    top = next(k for k, line in enumerate(lines) if "● tom" in line)
    right = next(k for k, line in enumerate(lines) if "→ ann" in line)
    assert top < right  # north is up
    assert lines[right].index("→ ann") > lines[top].index("● tom")
    assert any("map of ann, tom" in line for line in lines)


def test_maps_that_are_apart_stand_beside_each_other() -> None:
    plan = {"agents": {"ann": place(EAST), "bob": place(NORTH, map_id="b")}}
    lines = drawn({"agents": {"ann": agent(), "bob": agent()}}, plan)
    caption = next(line for line in lines if "map of ann" in line)
    assert caption.index("map of bob") >= COLUMNS // 2 - 1


def test_a_path_of_long_lines_takes_no_longer_than_one_of_many_points() -> None:
    """240,000 lines across the plan, as only a liar sends them: without a limit 30 million dots."""
    steps: list[tuple[float, float]] = []
    canvas = _Canvas([[0.0, 0.0], [1e5, 1e5]], COLUMNS, ROWS)
    canvas._dot = lambda x, y, colour: steps.append((x, y))  # type: ignore[method-assign]
    canvas.draw_path([[0.0, 0.0], [1e5, 1e5]] * 5_000, (0, 0, 0))
    assert len(steps) <= _MAX_STEPS + 2 * 10_000
    assert steps[-2:] == [(0.0, 0.0), (1e5, 1e5)]  # the ends are drawn


def test_a_caption_has_no_control_characters() -> None:
    lines = drawn({"agents": {}}, {"agents": {"\x1b]0;owned\x07": place(EAST)}})
    assert not any(character in line for line in lines for character in "\x1b\x07")


@pytest.mark.parametrize(("columns", "rows"), [(40, 12), (72, 18), (100, 24), (200, 60), (72, 8)])
def test_it_fits_the_terminal(columns: int, rows: int) -> None:
    names = [f"agent-with-a-long-name-{k}" for k in range(9)]
    report = {"agents": {name: agent(trouble=["pose 3 s late \x1b[2J"]) for name in names}}
    plan = {"agents": {name: place(EAST, map_id=str(k)) for k, name in enumerate(names)}}
    picture = TerminalPicture()
    for _ in range(30):
        coloured = picture.lines(report, plan, columns, rows)
    lines = [click.unstyle(line) for line in coloured]
    assert len(lines) <= rows
    assert max(map(len, lines)) <= columns
    assert not any("\x1b[2J" in line for line in coloured)  # of a peer's text


def test_a_standing_agent_is_drawn() -> None:
    lines = drawn({"agents": {"ann": agent()}}, {"agents": {"ann": place([[0.0, 0.0]])}})
    assert any("→ ann" in line for line in lines)


def test_what_is_wrong_stands_below_the_figures() -> None:
    report = {"agents": {"ann": agent(trouble=["LOST: dark", "no clock"]), "tom": agent()}}
    lines = drawn(report, {"agents": {}})
    assert [line[:5] for line in lines[:2]] == ["■ ann", "■ tom"]
    assert [line.strip() for line in lines[2:]] == ["ann: LOST: dark; no clock"]


def test_an_agent_keeps_the_colour_of_its_coming_however_late_one_looks() -> None:
    """As in the live room: those who have gone, and earlier runs, have their place in the order."""
    agents = {"tom/3": agent(gone=True), "ann": agent(), "tom": agent()}
    lines = TerminalPicture().lines({"agents": agents}, {"agents": {}}, COLUMNS, 24)
    swatches = [click.style("■ ", fg=agent_colour(number)) for number in (1, 0)]
    assert [line[: len(swatch)] for line, swatch in zip(lines, swatches, strict=True)] == swatches


def test_names_of_many_agents_stay_whole_and_in_their_order() -> None:
    names = [f"agent{k}" for k in range(12)]
    report = {"agents": {name: agent() for name in names}}
    plan = {"agents": {name: place(EAST, map_id=name) for name in names}}
    lines = drawn(report, plan, columns=72, rows=40)
    assert [line.split()[1] for line in lines if line.startswith("■")] == names  # agent2 before agent10
    caption = next(line for line in lines if line.startswith("map of"))
    assert caption.count("map of agent") == caption.count("m wide") == 3 and len(caption) <= 72
    assert "and 9 more maps" in lines
    long = "headset-of-the-third-floor-"
    both = {"agents": {f"{long}{k}": agent() for k in (1, 2)}}
    assert len({line.split()[1] for line in drawn(both, {"agents": {}})}) == 2


def test_of_agents_that_do_not_fit_the_troubled_are_shown_and_the_others_counted() -> None:
    agents = {f"agent{k}": agent() for k in range(30)}
    agents["agent27"] = agent(state="OK", trouble=["its clock is not synchronised"])
    lines = drawn({"agents": agents}, {"agents": {}}, rows=18)
    assert "agent27" in lines[0] and "its clock" in lines[1]
    assert lines[-1] == "and 20 more of 30 agents, 0 of them in trouble" and len(lines) <= 18


def test_a_good_state_is_not_red_for_another_trouble() -> None:
    report = {"agents": {"ann": agent(trouble=["its clock is not synchronised"])}}
    line = TerminalPicture().lines(report, {"agents": {}}, COLUMNS, ROWS)[0]
    assert "\x1b[38;2;229;72;77m" not in line
