"""Pictures of a calibration target, from a recording or from a folder of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import rig_check
from share.geometry.camera import Camera, Rig
from share.lab.calibrate.camera_bundle import View
from share.lab.calibrate.camera_report import UNTOLD, RigDoubt, rig_doubt
from share.lab.calibrate.corners import Detection, detector
from share.lab.calibrate.target import Target
from share.recordings.calibration import CAMCHAIN, Calibration
from share.recordings.images import decode_gray, read_picture
from share.runtime.pool import Pool
from share.runtime.source import READERS, calibration_of, open_source
from share.sensors.measurement import CAM0, CAM1
from share.types import F64, I64, U8

_PICTURES = (".png", ".jpg", ".jpeg")
_TOGETHER_NS = 2_000_000  # stamps of two pictures taken at once


@dataclass(frozen=True, eq=False)
class Pictures:
    """count: of cam0's; rig: the calibration so far, if the source has one; read: name and images of each,
    which of a recording is the stamp of the first camera's, ns; said: the calibration that was given; serial:
    of the device that took them, else of the one that the calibration is of."""

    count: int
    rig: Rig | None
    read: Callable[[], Iterator[tuple[str, tuple[U8, ...]]]]
    said: Calibration | None = None
    serial: str | None = None


def open_pictures(
    source: str, eyes: Sequence[str], calib: str | None = None, alone: str = "give --camera cam0"
) -> Pictures:
    """A recording, or a folder with cam0/*.png and, for stereo, cam1/*.png of the same names (.jpg too).

    eyes: which cameras; alone: how a person may ask for cam0 alone. Raises UsageError, ConfigError or
    DataError.
    """
    folder, said = Path(source), calibration_of(calib)
    if any((folder / CAM0).glob("*")) and not (folder / CAM0 / "data.csv").exists():
        return _folder(folder, eyes, said, alone)
    if _pictures(folder) and not any(reader.knows(folder) for reader in READERS):
        raise UsageError(f"{source}: has pictures, but no cam0 with them; give a folder with cam0/*.png")
    opened = open_source(source, calib)
    if CAM1 in eyes and opened.rig.cam1 is None:
        raise UsageError(f"{source}: has no cam1; {alone}")

    def read() -> Iterator[tuple[str, tuple[U8, ...]]]:
        waiting: dict[str, tuple[int, object]] = {}
        for m in opened.measurements():
            if m.stream not in eyes:
                continue
            waiting[m.stream] = (m.stamp_ns, m.payload)
            stamps = [stamp for stamp, _ in waiting.values()]
            if len(waiting) == len(eyes) and max(stamps) - min(stamps) <= _TOGETHER_NS:
                first = waiting[eyes[0]][0]
                pair = tuple(waiting.pop(eye)[1].load() for eye in eyes)  # type: ignore[attr-defined]
                yield str(first), pair

    return Pictures(opened.images_count, opened.rig, read, said, opened.serial or _only(said))


def _folder(folder: Path, eyes: Sequence[str], said: Calibration | None, alone: str) -> Pictures:
    found = [_pictures(folder / eye) for eye in eyes]
    names = [name for name in found[0] if all(name in others for others in found)]
    if not names:
        wanted = f"of the same name in {' and '.join(eyes)}; {alone}" if len(eyes) > 1 else f"in {eyes[0]}"
        raise DataError(f"{folder}: has no pictures {wanted}")

    def read() -> Iterator[tuple[str, tuple[U8, ...]]]:
        for name in names:
            yield name, tuple(decode_gray(read_picture(one[name]), str(one[name])) for one in found)

    return Pictures(len(names), None if said is None else said.rig, read, said, _only(said))


def _only(said: Calibration | None) -> str | None:
    """The device that a calibration is of, where it names just one."""
    return said.serials[0] if said is not None and len(said.serials) == 1 else None


def _pictures(folder: Path) -> dict[str, Path]:
    """By their names, in the order of numbers: 99 goes before 100."""
    paths = [path for path in folder.glob("*") if path.suffix.lower() in _PICTURES]
    return {path.stem: path for path in sorted(paths, key=lambda path: (len(path.stem), path.stem))}


def find_views(
    pictures: Pictures,
    target: Target,
    every: int,
    told: Callable[[int, int], None],
    workers: int = 1,
    fisheye: bool = False,
) -> tuple[list[View], list[tuple[int, int]]]:
    """Views of every `every`-th picture, also empty ones, and each camera's size. Finding a board takes
    some hundredths of a second: `workers` processes share that.

    told: how many are done, of how many. fisheye: what the lenses are. Raises DataError where pictures of a
    camera differ in size.
    """
    sizes: list[tuple[int, int]] = []
    views: dict[int, View] = {}
    count = -(-pictures.count // every)
    for job, seen in _looked(_jobs(pictures, every, sizes), (target, fisheye), max(1, min(workers, count))):
        views[job.number] = View(job.name, seen)
        told(len(views), count)
    return [views[k] for k in sorted(views)], sizes


@dataclass(frozen=True, eq=False)
class _Job:
    number: int
    name: str
    images: tuple[U8, ...]


def _jobs(pictures: Pictures, every: int, sizes: list[tuple[int, int]]) -> Iterator[_Job]:
    """Fills `sizes`. Raises DataError."""
    for k, (name, images) in enumerate(pictures.read()):
        if k % every:
            continue
        here = [(image.shape[1], image.shape[0]) for image in images]
        sizes.extend(here[len(sizes) :])
        if here != sizes:
            raise DataError(f"picture {name}: is {here}, the first was {sizes}; give pictures of one size")
        yield _Job(k, name, images)


def _looked(
    jobs: Iterator[_Job], what: tuple[Target, bool], workers: int
) -> Iterator[tuple[_Job, tuple[Detection, ...]]]:
    """Every job and what its images show, as they are done."""
    if workers == 1:  # a process of its own takes a second to begin
        _begin(*what)
        yield from ((job, _seen(job)) for job in jobs)
        return
    with Pool(workers, _begin, what) as pool:
        yield from pool.run(_seen, jobs)


_find: Callable[[U8], Detection] | None = None  # of a process


def _begin(target: Target, fisheye: bool) -> None:
    global _find
    _find = detector(target, fisheye)


def _seen(job: _Job) -> tuple[Detection, ...]:
    assert _find is not None
    return tuple(_find(image) for image in job.images)


# ---- Pictures of a calibration target with their stamps, from a recording whose cameras are known.

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
        if eye is not None and (why := rig_check.lens_objection(eye)) is not None:
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
