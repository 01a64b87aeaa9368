"""`share emulate`: make recordings of agents in a virtual room."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import click

from share.cli import options
from share.cli.completion import complete_profile, complete_scene
from share.cli.terminal import Stages

_WORKERS = 2


class _Size(click.ParamType[tuple[float, ...]]):
    name = "LxWxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        numbers = re.fullmatch(r"([\d.]+)x([\d.]+)x([\d.]+)", str(value))
        try:
            return tuple(float(number) for number in numbers.groups()) if numbers else self._fail(value)
        except ValueError:
            return self._fail(value)

    def _fail(self, value: Any) -> Any:
        self.fail(f"'{value}' is not a size in metres such as 9x6x4")


@click.command()
@click.option(
    "--scene",
    required=True,
    metavar="S",
    shell_complete=complete_scene,
    help="Room that is generated; see above.",
)
@click.option(
    "--motion",
    "motions",
    multiple=True,
    required=True,
    metavar="[NAME=]SPEC",
    help="An agent and its motion; see above. May be repeated.",
)
@click.option("--out", required=True, metavar="SESSION", type=options.PATH, help="A new folder.")
@click.option("--seconds", type=float, default=30, help="Length of the session, s, 3 to 3600.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the room and the noise.")
@click.option(
    "--day",
    type=click.IntRange(0),
    default=0,
    help="The same room on another day: other light, paths and noise; loose things moved, a third of the "
    "cartons gone.",
)
@click.option("--size", type=_Size(), metavar="LxWxH", help="Size of the room, m.  [default: the scene's]")
@click.option(
    "--profile",
    "profiles",
    multiple=True,
    metavar="[NAME=]PROFILE[:MODE]",
    shell_complete=complete_profile,
    help="Device that records: d435i, euroc, tumvi (fisheye) or a YAML file; MODE such as 848x480@30. "
    "May be repeated.  [default: d435i; euroc for euroc:]",
)
@click.option(
    "--sensors",
    multiple=True,
    metavar="[NAME=]stereo|rgbd|mono",
    help="stereo (infrared pair), rgbd (left image and depth) or mono (left image). May be "
    "repeated.  [default: stereo; rgbd for robot:]",
)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="KEY=VALUE",
    help="Sensor errors: none, noise=off, blur=off, drops=0.02, jitter_ms=1, time_offset_ms=5, … "
    "(all: docs/understand/sensors.md). May be repeated.",
)
@click.option(
    "--images",
    type=click.Choice(["jpeg", "png"]),
    help="Image files: jpeg (small) or png (without loss).  [default: jpeg; png for --format euroc]",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["session", "euroc"]),
    default="session",
    help="session (for all commands of SHARE) or euroc (EuRoC/ASL folders, for other programs).",
)
@options.as_json
@click.option("--workers", type=click.IntRange(1, 64), default=_WORKERS, help="Processes to use.")
def emulate(
    scene: str,
    motions: tuple[str, ...],
    out: Path,
    seconds: float,
    seed: int,
    day: int,
    size: tuple[float, float, float] | None,
    profiles: tuple[str, ...],
    sensors: tuple[str, ...],
    effects: tuple[str, ...],
    images: str | None,
    form: str,
    as_json: bool,
    workers: int,
) -> None:
    """Make recordings of agents that move through a virtual room, with ground truth.

    The motion is real or simulated, the room is generated around it, and each agent's device has the noise
    and errors of a real one. The session has the format of one from the field. An interrupted command
    continues when it is run again.

    \b
    Scenes:   warehouse                 much to see: racks, pallets, signs
              firestation               few cues: painted walls, fire engines
              corridor-twins            two corridors that look alike
              whitewall                 next to nothing to see
              board, charuco-board      a calibration board on a stand
              plain                     walls with textures; needs no OpenGL
              FILE.glb                  your own model of a room (glTF)
    \b
    Motions:  walk:[speed=0.9,…]        a person with a headset
              visit:X Y UNTIL;…         a person who walks to places and stands there
              robot:[speed=0.35,…]      a robot with two wheels
              paper:1 .. paper:5        two people and a robot, 60 s, in 9x6x4 m
              board:[vigour=1,…]        a hand-held device before a calibration board
              euroc:FOLDER[,start=S]    real IMU and motion of an EuRoC recording
              tumvi:FOLDER[,start=S]    real IMU and motion of a TUM-VI recording
              tum:FILE                  poses of a file; the IMU is simulated
    \b
    Example:  share emulate --scene warehouse --motion ann=walk: --motion bob=walk: --out room1
              share track room1/ann
    """
    from share.lab.emulate.recipe import SessionRecipe
    from share.lab.emulate.sensor.effects import parse_effects
    from share.lab.emulate.session import make_session

    euroc = form == "euroc"
    recipe = SessionRecipe(
        scene=scene,
        motions=motions,
        seconds=seconds,
        seed=seed,
        size=size,
        sensors=options.values_by_name("--sensors", sensors) or ({"": "stereo"} if euroc else {}),
        profiles=options.values_by_name("--profile", profiles),
        effects=parse_effects(effects),
        images=images or ("png" if euroc else "jpeg"),
        day=day,
    )
    with Stages() as stages:
        folder = make_session(recipe, out, workers, stages, asl=euroc)
    description = _describe_session(folder, euroc)
    click.echo(json.dumps(description) if as_json else _description_text(description))


def _describe_session(folder: Path, euroc: bool) -> dict[str, Any]:
    """Return what the new folder holds, as plain data."""
    from share.files.yaml_file import read_yaml
    from share.recordings.describe import describe_recording
    from share.runtime.source import open_source

    top = read_yaml(folder / ("emulation.yaml" if euroc else "session.yaml"))
    agents = {
        name: describe_recording(open_source(str(folder / name))) for name in top.section("agents").data
    }
    kinds = {name: agent["kind"] for name, agent in top.section("agents").data.items()}
    return {"folder": str(folder), "kinds": kinds, "agents": agents, "provenance": top.get("provenance")}


def _description_text(description: dict[str, Any]) -> str:
    """Return the session's notes and a line per agent."""
    lines = list(description["provenance"]["notes"])
    for name, agent in description["agents"].items():
        frames, truth = agent["streams"]["cam0"], agent["truth"]
        lines.append(
            f"{name:>12}  {description['kinds'][name]:5}  {agent['kind']:10}  {frames['count']} frames at "
            f"{frames['rate_hz']:.4g} Hz  {agent['duration_s']:.1f} s  {truth['length_m']:.2f} m"
        )
    return "\n".join([*lines, f"{description['folder']}: ready"])
