"""Pictures of a calibration target with their stamps, from a recording whose cameras are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.calibration.bundle import View
from share.core.measurement import CAM0, CAM1
from share.errors import DataError, UsageError
from share.geometry import trackable
from share.geometry.camera import Camera, Rig
from share.geometry.target import Target
from share.io.board_views import Pictures, find_views, open_pictures
from share.io.calibration import CAMCHAIN
from share.io.rig_doubt import UNTOLD, RigDoubt, rig_doubt
from share.types import F64, I64

_ALONE = "for one camera, give --camera a camchain without cam1"


@dataclass(frozen=True, eq=False)
class RigPictures:
    """rig: the cameras; before: T_imu_cam0 (4, 4) as it was given, if it was; doubt: how well the cameras are
    known."""

    name: str
    pictures: Pictures
    rig: Rig
    before: F64 | None
    doubt: RigDoubt = UNTOLD


def open_rig_pictures(source: str, camera: str | None) -> RigPictures:
    """Of a recording, or a folder with cam0/STAMP.png. camera: a camchain or a folder with one, in place
    of the source's own. Raises UsageError, ConfigError or DataError."""
    path = None if camera is None else _chain(camera)
    chain = None if path is None else str(path)
    first = open_pictures(source, (CAM0,), chain)
    if first.rig is None:
        raise UsageError(f"{source}: does not say what its cameras are like; give --camera FILE")
    for name, eye in (("cam0", first.rig.cam0), ("cam1", first.rig.cam1)):
        if eye is not None and (why := trackable.lens_objection(eye)) is not None:
            raise UsageError(f"{source if chain is None else chain}: {name}: {why}")
    two = first.rig.cam1 is not None
    pictures = open_pictures(source, (CAM0, CAM1), chain, _ALONE) if two else first
    own = first.rig.T_body_cam0 if first.rig.imu is not None else None
    before = own if first.said is None else first.said.T_imu_cam0
    doubt = UNTOLD if path is None else rig_doubt(path, first.rig)
    return RigPictures(source, pictures, first.rig, before, doubt)


def _chain(camera: str) -> Path:
    """The file alone: with the IMU's beside it, a reader asks for extrinsics that are yet to be found."""
    path = Path(camera) / CAMCHAIN if Path(camera).is_dir() else Path(camera)
    if not path.is_file():
        raise UsageError(f"--camera {camera}: no such file, or no {CAMCHAIN} in it")
    return path


class Stamped(NamedTuple):
    """stamps (F,) ns, rising, and views with at least one corner; looked: how many pictures were looked at;
    dropped: how many show the board, but their stamps are not later than the one before."""

    stamps: I64
    views: list[View]
    looked: int
    dropped: int

    @property
    def with_target(self) -> int:
        return len(self.views) + self.dropped


def find_stamped(
    source: RigPictures, target: Target, every: int, told: Callable[[int, int], None], workers: int = 1
) -> Stamped:
    """told: how many are done, of how many. Raises DataError."""
    views, sizes = find_views(source.pictures, target, every, told, workers, source.rig.cam0.fisheye)
    cameras = [camera for camera in (source.rig.cam0, source.rig.cam1) if camera is not None]
    for eye, (size, camera) in enumerate(zip(sizes, cameras, strict=False)):
        _same_size(source.name, eye, size, camera)
    seen = [view for view in views if any(len(one) for one in view.seen)]
    if not seen:
        raise DataError(
            f"{source.name}: no board in {len(views)} pictures; is --target the board that was shown?"
        )
    if not all(view.name.isdecimal() and int(view.name) < 2**63 for view in seen):
        raise DataError(f"{source.name}: pictures without stamps; name them cam0/STAMP.png, STAMP in ns")
    stamps = np.array([int(view.name) for view in seen], np.int64)
    later = stamps > np.maximum.accumulate(np.concatenate([[-(2**62)], stamps[:-1]]))
    kept = [view for view, keep in zip(seen, later, strict=True) if keep]
    return Stamped(stamps[later], kept, len(views), len(seen) - len(kept))


def _same_size(name: str, eye: int, size: tuple[int, int], camera: Camera) -> None:
    if size != (camera.width, camera.height):
        raise DataError(
            f"{name}: cam{eye}'s pictures are {size[0]}x{size[1]}, its calibration is of "
            f"{camera.width}x{camera.height}; calibrate it as it records"
        )
