"""Follows docs/start/first-room.md word by word, with cameras of software, and can write back what was shown.

PYTHONPATH=tests python tests/tutorial/follow.py --at DIR --write
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from share import startup

startup.prepare_process()  # before numpy: walkers are planned as `share emulate` would, to the last digit

import click  # noqa: E402
import field_trip  # noqa: E402
from machines import Machine  # noqa: E402
from page import MACHINES, Block, Step, blocks, renewed  # noqa: E402

from share.cli.terminal import Stages  # noqa: E402

PAGE = Path(__file__).parents[2] / "docs" / "start" / "first-room.md"
LIMIT_S = 1500.0  # of one command
ADDRESS = ("192.168.1.10", "127.0.0.1")  # the laptop's, on the page and here
PERSON_S = 3.0  # what comes after a server was started is not typed sooner
FAILS_HERE = ("share doctor",)  # without USB, a camera on it, and clocks that somebody corrects

Walked = list[tuple[Block, list[Step]]]


class OffTrackError(Exception):
    """Something that the page tells to type does not do what it should."""


def follow(
    text: str, folder: Path, say: Callable[[str], None], first: int = 0, last: int | None = None
) -> Walked:
    """Types what the page says, from block `first` to before block `last`. Raises OffTrackError.

    folder: of the machines; what they had from blocks before `first` must be there."""
    machines = {name: Machine(name, folder) for name in MACHINES}
    field_trip.exports(folder / "laptop")
    walked: Walked = []
    try:
        for block in blocks(text)[first:last]:
            walked.append((block, _together(block.steps, machines, say, folder)))
    finally:
        for machine in machines.values():
            machine.close()
    return walked


def _together(
    steps: Sequence[Step], machines: dict[str, Machine], say: Callable[[str], None], folder: Path
) -> list[Step]:
    """The steps of a block as they went. Each machine goes on by itself."""

    def one(name: str) -> list[tuple[int, Step]]:
        own = [(k, step) for k, step in enumerate(steps) if step.machine == name]
        return [(k, _typed(step, machines[name], say, folder)) for k, step in own]

    with ThreadPoolExecutor() as pool:
        done = [pair for pairs in pool.map(one, {step.machine for step in steps}) for pair in pairs]
    return [step for _, step in sorted(done, key=lambda pair: pair[0])]


def _typed(step: Step, machine: Machine, say: Callable[[str], None], folder: Path) -> Step:
    code, shown = machine.run(step.command.replace(*ADDRESS), LIMIT_S)
    if step.command.endswith("&"):
        time.sleep(PERSON_S)
    went = replace(step, shown=tuple(_elsewhere(line, folder) for line in shown))
    say("\n".join(went.lines))
    if code and not step.command.startswith(FAILS_HERE):
        raise OffTrackError("\n".join([*went.lines, f"exit code {code}"]))
    return went


def _elsewhere(line: str, folder: Path) -> str:
    """As it would be on the machines of the page. The edge's own page is for the laptop alone there too."""
    line = line if "http://" in line else line.replace(*reversed(ADDRESS))
    return line.replace(str(folder), "/home").rstrip()


@click.command()
@click.option("--write", is_flag=True, help="Put what was shown into the page.")
@click.option("--at", "folder", type=click.Path(path_type=Path), required=True, help="Of the machines.")
@click.option("--first", default=0, help="The block to begin with, counted from 0.")
@click.option("--last", type=int, help="The block to end before.")
def main(write: bool, folder: Path, first: int, last: int | None) -> None:
    with Stages() as stages:
        for name in field_trip.RECIPES:
            field_trip.session(name, stages)
    text = PAGE.read_text()
    walked = follow(text, folder.resolve(), click.echo, first, last)
    if write:
        PAGE.write_text(renewed(text, walked))


if __name__ == "__main__":
    try:
        main()
    except OffTrackError as error:
        sys.exit(f"follow: off the track:\n{error}")
