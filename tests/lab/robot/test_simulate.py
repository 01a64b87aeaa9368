"""`share robot simulate` from the command line, in the plain room, which needs no OpenGL."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner, Result

from share.cli.main import cli
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.session import make_session
from share.sensors.profile import shipped_profiles


def simulate(session: Path, out: Path, *more: str) -> Result:
    return CliRunner().invoke(cli, ["robot", "simulate", str(session), "--out", str(out), *more])


def report_of(out: Path) -> dict[str, Any]:
    assert (out / "plan.png").read_bytes().startswith(b"\x89PNG")
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    return report


@pytest.mark.long
def test_a_robot_that_knows_where_it_is_arrives(plain_session: Path, tmp_path: Path) -> None:
    options = ("--goals", "1", "--seed", "3", "--localisation", "truth", "--seconds", "60")
    result = simulate(plain_session, tmp_path / "drive", *options)
    assert result.exit_code == 0, result.output
    assert "1 of 1 goals reached within 0.35 m by the truth" in result.output
    report = report_of(tmp_path / "drive")
    assert report["reached"] == report["ended"] == 1 and report["place_error_m"] < 0.02
    again = simulate(plain_session, tmp_path / "again", *options, "--json")
    assert json.loads(again.stdout)["goals"] == report["goals"]


@pytest.mark.slow
@pytest.mark.long
def test_a_robot_on_its_wheels_is_elsewhere_than_it_believes(plain_session: Path, tmp_path: Path) -> None:
    goals = tmp_path / "goals.txt"
    goals.write_text("2 2\n7 4 90\n2 4\n")
    options = ("--goals", str(goals), "--seed", "3", "--localisation", "wheels", "--seconds", "120")
    result = simulate(plain_session, tmp_path / "drive", *options)
    assert result.exit_code == 0, result.output
    report = report_of(tmp_path / "drive")
    assert [goal["goal"][:2] for goal in report["goals"]] == [[2.0, 2.0], [7.0, 4.0], [2.0, 4.0]]
    assert report["place_error_p95_m"] > 0.05


@pytest.mark.slow
def test_a_robot_arrives_by_what_its_camera_sees(tmp_path: Path) -> None:
    """320 x 240 at 15 Hz, its own map: pictures, tracker, edge and bridge are the real ones."""
    profile = yaml.safe_load(shipped_profiles()["d435i"].read_text())
    lens = {"intrinsics": [192.5, 192.5, 159.95, 119.55]}
    mode = {"width": 320, "height": 240, "rates_hz": [15], "cam0": lens, "cam1": lens}
    profile["device"] |= {"modes": [mode], "default_mode": "320x240@15"}
    small = tmp_path / "small.yaml"
    small.write_text(yaml.safe_dump(profile))
    recipe = SessionRecipe("plain", ("bot=robot:",), 3.0, 5, profiles={"": str(small)})
    session = make_session(recipe, tmp_path / "room", workers=1)
    options = ("--goals", "1", "--seed", "3", "--seconds", "60", "--profile", str(small))
    result = simulate(session, tmp_path / "drive", *options)
    assert result.exit_code == 0, result.output
    report = report_of(tmp_path / "drive")
    assert report["reached"] == 1, result.output
    assert report["place_error_p95_m"] < 0.05


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--goals", "0"), "give 1 to 1000"),
        (("--goals", "nowhere.txt"), "is neither a number nor a file"),
        (("--fault", "fire@3"), "kinds: edge, agent, network, bare-wall, bridge, rival"),
        (("--policy", "streamed"), "would not track"),
    ],
)
def test_bad_options_are_refused_in_a_line(tmp_path: Path, more: tuple[str, ...], said: str) -> None:
    result = simulate(tmp_path, tmp_path / "drive", *more)
    assert result.exit_code != 0 and said in f"{result.output}{result.exception}"
    assert not (tmp_path / "drive").exists()


def test_a_session_from_elsewhere_is_refused(tmp_path: Path) -> None:
    session = tmp_path / "field"
    session.mkdir()
    agents = "{ann: {kind: ar, sensors: stereo, rate_hz: 30, clock_offset_ns: 0}}"
    (session / "session.yaml").write_text(f"schema: 1\nprovenance: {{}}\nagents: {agents}\n")
    result = simulate(session, tmp_path / "drive")
    assert result.exit_code != 0 and "its room is not known" in f"{result.output}{result.exception}"
    assert not (tmp_path / "drive").exists()
