"""Convert a source to MCAP or to an EuRoC/ASL folder. Encoded images are copied, not re-encoded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from share.errors import CalibrationMismatchError, DataError, UsageError
from share.files.writing import atomic_write, check_replaceable, new_folder
from share.geometry import se3
from share.recordings.calibration import asl_camera_text, asl_imu_text
from share.recordings.images import EncodedImage
from share.recordings.mcap.recorder import Recorder
from share.recordings.recording import Source
from share.recordings.trajectory import Trajectory, format_tum
from share.sensors.measurement import CAM0, CAM1, IMU, LazyImage, Measurement
from share.vision.image_codec import encode_png, image_format

Progress = Callable[[int], None]
StageProgress = Callable[[str, int, int], None]  # stage, done, total


def stage_progress(report: StageProgress, stage: str, total: int) -> Progress:
    """Return a `Progress` that adds up increments and reports them as a stage of `total`."""
    done = 0

    def more(count: int) -> None:
        nonlocal done
        done += count
        report(stage, done, total)

    return more


def to_mcap(source: Source, out: Path, jpeg: int | None, progress: Progress) -> None:
    """Write `out`, and the ground truth, if known, as NAME.truth.tum beside it. On error, nothing is left.

    jpeg: quality for compressing gray images, None to keep them. progress: called with 1 per cam0 image.
    """
    write_recording(source, out, jpeg, progress)
    truth = source.truth()
    if truth is not None:
        atomic_write(out.with_name(out.stem + ".truth.tum"), format_tum(truth))


def write_recording(source: Source, out: Path, jpeg: int | None, progress: Progress) -> None:
    """Write `out` without the ground truth; else as `to_mcap`."""
    check_replaceable(out)
    try:
        with Recorder(out, source.rig, jpeg, serial=source.serial) as recorder:
            for measurement in intact_measurements(source, progress):
                recorder.write(measurement)
    except BaseException:  # also Ctrl-C
        out.with_name(out.name + ".part").unlink(missing_ok=True)
        raise


def to_euroc(source: Source, out: Path, progress: Progress) -> None:
    """Write a stereo or mono source as `out`/mav0. On error, nothing is left. Raises UsageError."""
    if source.rig.depth:
        raise UsageError("--format euroc: an ASL folder cannot hold depth images; use --format mcap")
    if source.rig.timeshift_s:
        raise UsageError(
            "--format euroc: an ASL folder cannot hold the cameras' timeshift; use --format mcap"
        )
    with new_folder(out) as work:
        _write_asl(source, work / "mav0", progress)


def intact_measurements(source: Source, progress: Progress) -> Iterator[Measurement]:
    """Yield all measurements except damaged images. The first images of each camera are decoded until one is
    intact, to find a wrong size early."""
    verified = set()
    for measurement in source.measurements():
        stream, image = measurement.stream, measurement.payload
        try:
            if stream != IMU and stream not in verified:
                image.load()
                verified.add(stream)
            elif isinstance(image, EncodedImage):
                image.check()
        except CalibrationMismatchError:
            raise
        except DataError as error:
            source.losses.add(kind := f"images of {stream}", str(measurement.stamp_ns), str(error))
            source.losses.check(kind, source.images_count)
            continue
        yield measurement
        if measurement.stream == CAM0:
            progress(1)


def _write_asl(source: Source, root: Path, progress: Progress) -> None:
    rig, listings = source.rig, {}
    T_imu = {CAM0: rig.T_body_cam0}
    if rig.T_cam1_cam0 is not None:
        T_imu[CAM1] = rig.T_body_cam0 @ se3.inverse(rig.T_cam1_cam0)
    for stream, camera in rig.cameras.items():
        (root / stream / "data").mkdir(parents=True)
        (root / stream / "sensor.yaml").write_text(asl_camera_text(camera, T_imu[stream], source.rate_hz))
        listings[stream] = ["#timestamp [ns],filename"]
    if rig.imu:
        (root / "imu0").mkdir()
        (root / "imu0" / "sensor.yaml").write_text(asl_imu_text(rig.imu))
        listings["imu0"] = ["#timestamp [ns],w_x,w_y,w_z [rad s^-1],a_x,a_y,a_z [m s^-2]"]
    for m in intact_measurements(source, progress):
        if m.stream == IMU:
            listings["imu0"].append(f"{m.stamp_ns},{_numbers(m.payload)}")
        else:
            name = _write_image(root / m.stream / "data", m.stamp_ns, m.payload)
            listings[m.stream].append(f"{m.stamp_ns},{name}")
    for stream, lines in listings.items():
        (root / stream / "data.csv").write_text("\n".join(lines) + "\n")
    truth = source.truth()
    if truth is not None:
        _write_truth(root / "state_groundtruth_estimate0", truth)


def _numbers(values: Iterable[float]) -> str:
    return ",".join(repr(float(value)) for value in values)


def _write_image(folder: Path, stamp: int, image: LazyImage) -> str:
    """Write an image, as it is if encoded, else as PNG; return its name."""
    data = image.read() if isinstance(image, EncodedImage) else encode_png(image.load())
    name = f"{stamp}.{image_format(data)}"
    (folder / name).write_bytes(data)
    return name


def _write_truth(folder: Path, truth: Trajectory) -> None:
    folder.mkdir()
    q = se3.quat_from_matrix(truth.T[:, :3, :3])[:, [3, 0, 1, 2]]
    values = np.concatenate([truth.T[:, :3, 3], q], axis=1)
    lines = [f"{t},{_numbers(row)}\n" for t, row in zip(truth.stamps_ns.tolist(), values, strict=True)]
    (folder / "data.csv").write_text("#timestamp [ns],p_x,p_y,p_z [m],q_w,q_x,q_y,q_z\n" + "".join(lines))
