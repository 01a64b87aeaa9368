"""Views of a calibration target, from a recording or from a folder of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.errors import DataError, UsageError
from share.geometry import rig_check
from share.geometry.camera import Camera, Rig
from share.lab.calibrate.camera_report import UNKNOWN_UNCERTAINTY, RigUncertainty, read_rig_uncertainty
from share.lab.calibrate.corner_observations import BoardView
from share.lab.calibrate.corners import Detection, detector
from share.lab.calibrate.imu_table import rising_mask
from share.lab.calibrate.target import Target
from share.lab.pool import Pool
from share.recordings.calibration import CAMCHAIN, Calibration
from share.recordings.images import read_picture
from share.runtime.source import READERS, open_source, read_given_calibration
from share.sensors.measurement import CAM0, CAM1
from share.types import F64, I64, U8
from share.vision.image_codec import decode_gray

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_MAX_PAIR_GAP_NS = 2_000_000  # between stamps of one stereo pair


@dataclass(frozen=True, eq=False)
class BoardImages:
    """Images of a target. count: of cam0's. rig: the calibration so far, if the source has one.

    read_images: yields name and images of each set; in a recording the name is the first camera's stamp, ns.
    given_calibration: as given. serial: of the recording device, else of the calibration.
    """

    count: int
    rig: Rig | None
    read_images: Callable[[], Iterator[tuple[str, tuple[U8, ...]]]]
    given_calibration: Calibration | None = None
    serial: str | None = None


def open_board_images(
    source: str, cameras: Sequence[str], calib: str | None = None, mono_hint: str = "give --camera cam0"
) -> BoardImages:
    """Open a recording, or a folder with cam0/*.png and, for stereo, cam1/*.png of equal names (.jpg too).

    mono_hint: how to ask for cam0 alone. Raises UsageError, ConfigError or DataError.
    """
    folder, given = Path(source), read_given_calibration(calib)
    if any((folder / CAM0).glob("*")) and not (folder / CAM0 / "data.csv").exists():
        return _folder_images(folder, cameras, given, mono_hint)
    if _image_files(folder) and not any(reader.matches(folder) for reader in READERS):
        raise UsageError(f"{source}: has images, but no folder cam0; give a folder with cam0/*.png")
    opened = open_source(source, calib)
    if CAM1 in cameras and opened.rig.cam1 is None:
        raise UsageError(f"{source}: has no cam1; {mono_hint}")

    def read() -> Iterator[tuple[str, tuple[U8, ...]]]:
        waiting: dict[str, tuple[int, object]] = {}
        for m in opened.measurements():
            if m.stream not in cameras:
                continue
            waiting[m.stream] = (m.stamp_ns, m.payload)
            stamps = [stamp for stamp, _ in waiting.values()]
            if len(waiting) == len(cameras) and max(stamps) - min(stamps) <= _MAX_PAIR_GAP_NS:
                first = waiting[cameras[0]][0]
                pair = tuple(waiting.pop(eye)[1].load() for eye in cameras)  # type: ignore[attr-defined]
                yield str(first), pair

    return BoardImages(opened.images_count, opened.rig, read, given, opened.serial or _only_serial(given))


def _folder_images(
    folder: Path, cameras: Sequence[str], given: Calibration | None, mono_hint: str
) -> BoardImages:
    files = [_image_files(folder / cam) for cam in cameras]
    names = [name for name in files[0] if all(name in others for others in files)]
    if not names:
        requirement = (
            f"of the same name in {' and '.join(cameras)}; {mono_hint}"
            if len(cameras) > 1
            else f"in {cameras[0]}"
        )
        raise DataError(f"{folder}: has no images {requirement}")

    def read() -> Iterator[tuple[str, tuple[U8, ...]]]:
        for name in names:
            yield name, tuple(decode_gray(read_picture(one[name]), str(one[name])) for one in files)

    return BoardImages(len(names), None if given is None else given.rig, read, given, _only_serial(given))


def _only_serial(calibration: Calibration | None) -> str | None:
    """Return the device of a calibration, if it names exactly one."""
    return calibration.serials[0] if calibration is not None and len(calibration.serials) == 1 else None


def _image_files(folder: Path) -> dict[str, Path]:
    """Return image files by name, in numeric order: 99 before 100."""
    paths = [path for path in folder.glob("*") if path.suffix.lower() in _IMAGE_SUFFIXES]
    return {path.stem: path for path in sorted(paths, key=lambda path: (len(path.stem), path.stem))}


def find_views(
    images: BoardImages,
    target: Target,
    every: int,
    on_progress: Callable[[int, int], None],
    workers: int = 1,
    fisheye: bool = False,
) -> tuple[list[BoardView], list[tuple[int, int]]]:
    """Return the views of every `every`-th image, empty ones included, and each camera's image size.

    Detecting a board takes some hundredths of a second, in `workers` processes. on_progress(done, total):
    images. Raises DataError where images of a camera differ in size.
    """
    sizes: list[tuple[int, int]] = []
    views: dict[int, BoardView] = {}
    count = -(-images.count // every)
    for job, detections in _detect_all(
        _image_jobs(images, every, sizes), (target, fisheye), max(1, min(workers, count))
    ):
        views[job.number] = BoardView(job.name, detections)
        on_progress(len(views), count)
    return [views[k] for k in sorted(views)], sizes


@dataclass(frozen=True, eq=False)
class _ImageJob:
    number: int
    name: str
    images: tuple[U8, ...]


def _image_jobs(board_images: BoardImages, every: int, sizes: list[tuple[int, int]]) -> Iterator[_ImageJob]:
    """Yield jobs, and fill `sizes`. Raises DataError."""
    for k, (name, images) in enumerate(board_images.read_images()):
        if k % every:
            continue
        image_sizes = [(image.shape[1], image.shape[0]) for image in images]
        sizes.extend(image_sizes[len(sizes) :])
        if image_sizes != sizes:
            raise DataError(f"image {name}: is {image_sizes}, the first was {sizes}; give images of one size")
        yield _ImageJob(k, name, images)


def _detect_all(
    jobs: Iterator[_ImageJob], detector_arguments: tuple[Target, bool], workers: int
) -> Iterator[tuple[_ImageJob, tuple[Detection, ...]]]:
    """Yield every job with its detections, in order of completion."""
    if workers == 1:  # starting a process takes a second
        _start_worker(*detector_arguments)
        yield from ((job, _detections(job)) for job in jobs)
        return
    with Pool(workers, _start_worker, detector_arguments) as pool:
        yield from pool.run(_detections, jobs)


_detect_in_worker: Callable[[U8], Detection] | None = None  # one per process


def _start_worker(target: Target, fisheye: bool) -> None:
    global _detect_in_worker
    _detect_in_worker = detector(target, fisheye)


def _detections(job: _ImageJob) -> tuple[Detection, ...]:
    assert _detect_in_worker is not None
    return tuple(_detect_in_worker(image) for image in job.images)


# Views with stamps, from a rig with calibrated cameras.

_MONO_HINT = "for one camera, give --camera a camchain without cam1"


@dataclass(frozen=True, eq=False)
class RigImages:
    """Images from a calibrated rig. given_T_imu_cam0 (4, 4): as given, if it was. uncertainty: of the
    cameras."""

    name: str
    images: BoardImages
    rig: Rig
    given_T_imu_cam0: F64 | None
    uncertainty: RigUncertainty = UNKNOWN_UNCERTAINTY


def open_rig_images(source: str, camera: str | None) -> RigImages:
    """Open a recording, or a folder with cam0/STAMP.png. camera: a camchain, or a folder with one, in place
    of the source's own.

    Raises UsageError, ConfigError or DataError.
    """
    path = None if camera is None else _camchain_file(camera)
    chain = None if path is None else str(path)
    first = open_board_images(source, (CAM0,), chain)
    if first.rig is None:
        raise UsageError(f"{source}: has no camera calibration; give --camera FILE")
    for name, cam in (("cam0", first.rig.cam0), ("cam1", first.rig.cam1)):
        if cam is not None and (why := rig_check.lens_problem(cam)) is not None:
            raise UsageError(f"{source if chain is None else chain}: {name}: {why}")
    has_two = first.rig.cam1 is not None
    images = open_board_images(source, (CAM0, CAM1), chain, _MONO_HINT) if has_two else first
    own = first.rig.T_body_cam0 if first.rig.imu is not None else None
    given_T_imu_cam0 = own if first.given_calibration is None else first.given_calibration.T_imu_cam0
    uncertainty = UNKNOWN_UNCERTAINTY if path is None else read_rig_uncertainty(path, first.rig)
    return RigImages(source, images, first.rig, given_T_imu_cam0, uncertainty)


def _camchain_file(camera: str) -> Path:
    """Return the camchain alone: with the IMU chain beside it, a reader would need extrinsics, which are
    yet unknown."""
    path = Path(camera) / CAMCHAIN if Path(camera).is_dir() else Path(camera)
    if not path.is_file():
        raise UsageError(f"--camera {camera}: no such file, or no {CAMCHAIN} in it")
    return path


class StampedViews(NamedTuple):
    """stamps (F,) ns, rising, and views with at least one corner. images_searched: their number. dropped:
    images that show the board, with stamps not later than the one before."""

    stamps: I64
    views: list[BoardView]
    images_searched: int
    dropped: int

    @property
    def with_target(self) -> int:
        return len(self.views) + self.dropped


def find_stamped_views(
    source: RigImages, target: Target, every: int, on_progress: Callable[[int, int], None], workers: int = 1
) -> StampedViews:
    """Return the views with stamps. on_progress(done, total): images. Raises DataError."""
    views, sizes = find_views(source.images, target, every, on_progress, workers, source.rig.cam0.is_fisheye)
    cameras = [camera for camera in (source.rig.cam0, source.rig.cam1) if camera is not None]
    for cam, (size, camera) in enumerate(zip(sizes, cameras, strict=False)):
        _check_size(source.name, cam, size, camera)
    with_target = [view for view in views if any(len(one) for one in view.detections)]
    if not with_target:
        raise DataError(
            f"{source.name}: no board in {len(views)} images; is --target the board that was shown?"
        )
    if not all(view.name.isdecimal() and int(view.name) < 2**63 for view in with_target):
        raise DataError(f"{source.name}: images have no stamps; name them cam0/STAMP.png, STAMP in ns")
    stamps = np.array([int(view.name) for view in with_target], np.int64)
    later = rising_mask(stamps)
    kept_views = [view for view, keep in zip(with_target, later, strict=True) if keep]
    return StampedViews(stamps[later], kept_views, len(views), len(with_target) - len(kept_views))


def _check_size(name: str, cam: int, size: tuple[int, int], camera: Camera) -> None:
    if size != (camera.width, camera.height):
        raise DataError(
            f"{name}: cam{cam}'s images are {size[0]}x{size[1]}, its calibration is for "
            f"{camera.width}x{camera.height}; calibrate it at the recorded size"
        )
