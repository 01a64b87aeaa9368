"""Convert a finished session to EuRoC/ASL folders, for other programs."""

from __future__ import annotations

from pathlib import Path

from share.errors import UsageError
from share.lab.emulate.progress import Progress
from share.lab.emulate.stage import RoomStage
from share.recordings.convert import stage_progress, to_euroc
from share.recordings.session import SESSION_FILE
from share.runtime.source import open_source


def check_asl(stage: RoomStage) -> None:
    """Raise UsageError where an agent has data that such a folder cannot hold."""
    for actor in stage.actors:
        if actor.device.clock.period_ns:
            raise UsageError("ASL folders cannot hold stamps that wrap; leave out --effect wrap=on")
        if actor.rig.depth is not None:
            raise UsageError(
                f"{actor.name}: an ASL folder has no place for depth; give --sensors {actor.name}=stereo"
            )


def to_asl(folder: Path, names: list[str], progress: Progress) -> None:
    """Convert each NAME.mcap of the session in `folder` to NAME/mav0, with the ground truth."""
    for name in names:
        source = open_source(str(folder / name))
        count = stage_progress(progress, f"writing {name}/mav0", source.images_count)
        to_euroc(source, folder / f"{name}.asl", count)
        (folder / f"{name}.asl").rename(folder / name)
        (folder / f"{name}.mcap").unlink()
        (folder / "truth" / f"{name}.tum").unlink()
    (folder / "truth").rmdir()
    (folder / SESSION_FILE).rename(folder / "emulation.yaml")
