"""`share train labels`: run the tracker over sessions with ground truth and label each keyframe with its
error."""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from share import __version__
from share.config import Config
from share.errors import DataError, UsageError
from share.files.arrays import read_arrays
from share.files.json_file import parse_json
from share.files.writing import atomic_write
from share.lab.evaluate.campaign import check_unique_names
from share.lab.pool import Pool
from share.lab.train.fault_injection import FAULT_KINDS, FaultInterval, draw_faults, inject_faults
from share.metrics.local_error import WINDOW_S, LocalError
from share.odometry.error_model.history import MotionHistory
from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput, error_model_input, input_dtype
from share.recordings.session import Session, read_session
from share.runtime.error_estimators import frame_outcome
from share.runtime.pipeline import check_trackable, make_tracker, read_frames
from share.runtime.source import Source, open_source
from share.sensors.sequencer import SequencerCounters
from share.startup import prepare_process
from share.types import F32, I64, U8, ImuBatch

_MAX_FAULT_KINDS = 3  # fault kinds in one run, at most
_IMU_SUFFIX = {True: "", False: "-without-imu"}


@dataclass(frozen=True)
class LabelRun:
    """One run of one agent. number: 0 is the recording as it is, others have faults of their own. imu: False
    ignores the IMU."""

    session: Path
    agent: str
    number: int
    seed: int
    imu: bool
    out: Path


def plan_label_runs(
    sessions: Sequence[Session], runs: int, seed: int, imu: bool, out: Path
) -> list[LabelRun]:
    """Return all runs, whether or not their labels exist. Raises UsageError where a session has no ground
    truth or two sessions have the same name."""
    check_unique_names(sessions)
    jobs = []
    for session in sessions:
        name = session.folder.resolve().name
        for agent in session.agents:
            if not (session.folder / "truth" / f"{agent}.tum").is_file():
                raise UsageError(
                    f"{session.folder}: has no ground truth truth/{agent}.tum, which labels need"
                )
            jobs += [
                LabelRun(
                    session.folder,
                    agent,
                    number,
                    seed,
                    imu,
                    out / f"{name}-{agent}{_IMU_SUFFIX[imu]}-{number}.npz",
                )
                for number in range(runs)
            ]
    return jobs


def make_labels(jobs: Sequence[LabelRun], config: Config, workers: int) -> Iterator[tuple[LabelRun, Labels]]:
    """Make missing labels; yield each of `jobs` with its labels as they become available. Raises UsageError
    where existing labels have another seed."""
    pending = [job for job in jobs if not job.out.exists()]
    for job in jobs:
        if job.out.exists():
            run_labels = read_labels(job.out)
            if (seed := run_labels.about.get("seed")) != job.seed:
                raise UsageError(f"{job.out}: has labels of seed {seed}; give another --out")
            yield job, run_labels
    if workers == 1:
        for job in pending:
            _make_run((job, config))
            yield job, read_labels(job.out)
        return
    with Pool(min(workers, max(1, len(pending))), prepare_process, ()) as pool:
        for (job, _), _ in pool.run(_make_run, [(job, config) for job in pending]):
            yield job, read_labels(job.out)


def _make_run(work: tuple[LabelRun, Config]) -> None:
    job, config = work
    session = read_session(job.session)
    source = open_source(f"{job.session}/{job.agent}")
    truth = source.truth()
    assert truth is not None
    rng = np.random.default_rng((job.seed, job.number, zlib.crc32(job.out.name.encode())))
    allowed_kinds = [kind for kind in FAULT_KINDS if job.imu or kind != "imu_missing"]
    kinds = (
        rng.permutation(allowed_kinds)[: rng.integers(1, _MAX_FAULT_KINDS + 1)].tolist() if job.number else []
    )
    faults = draw_faults(rng, int(truth.stamps_ns[0]), int(truth.stamps_ns[-1]), kinds)
    about = {
        "session": job.session.resolve().name,
        "agent": job.agent,
        "kind": str(session.agents[job.agent].kind),
        "sensors": session.agents[job.agent].sensors,
        "provenance": session.provenance,
        "number": job.number,
        "seed": job.seed,
        "imu": job.imu and source.rig.imu is not None,
        "faults": [asdict(fault) for fault in faults],
        "window_s": WINDOW_S,
        "version": __version__,
    }
    rows = list(labelled_keyframes(source, config, faults, job.seed, job.imu))
    write_labels(job.out, Labels.from_rows(about, rows))


def labelled_keyframes(
    source: Source, config: Config, faults: Sequence[FaultInterval] = (), seed: int = 0, imu: bool = True
) -> Iterator[tuple[int, float, ErrorModelInput]]:
    """Yield, for each keyframe of the tracker, its stamp, the tracker's error then (cm, NaN if unknown) and
    the error model's input. imu: False ignores the IMU. Raises UsageError without ground truth, or where no
    tracker supports the sensors."""
    truth = source.truth()
    if truth is None:
        raise UsageError(f"{source.name}: has no ground truth, which labels need")
    # `without_imu` would make cam0 the body; the ground truth is that of the recorded body.
    rig = source.rig if imu else replace(source.rig, imu=None)
    check_trackable(source.name, rig)
    tracker, error, odometer = make_tracker(rig, config), LocalError(truth), MotionHistory()
    for frame in inject_faults(read_frames(source, config, SequencerCounters()), faults, seed, rig):
        frame = frame if imu else replace(frame, imu=ImuBatch.empty())
        result = tracker.track(frame)
        error_cm = error.update(frame.stamp_ns, result.T_odom_body, result.new_segment)
        odometer.add_frame(frame_outcome(frame, result))
        if result.keyframe_ready:
            statistics, candidate = tracker.feature_statistics(), tracker.make_keyframe(frame)
            known_error_cm = float("nan") if error_cm is None else error_cm
            recent_motion = odometer.add_keyframe(frame.stamp_ns, candidate)
            model_input = error_model_input(frame.image0, statistics, recent_motion)
            yield frame.stamp_ns, known_error_cm, model_input


# ---- Label files: one NumPy archive (.npz) a run, with an array for each column of `Labels` and `about` as
# JSON: session, agent, room, motion, faults, version of SHARE.

SCHEMA = 4


@dataclass(frozen=True, eq=False)
class Labels:
    """Keyframes of one run, in order: stamps_ns (N,); error_cm (N,), NaN if unknown; picture (N, 128, 128),
    psd (N, 3, 12, 16), scalars (N, 8), recent (N, 14) as in `ErrorModelInput`. about: plain metadata."""

    about: dict[str, Any]
    stamps_ns: I64
    error_cm: F32
    picture: U8
    psd: F32
    scalars: F32
    recent: F32

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def from_rows(cls, about: dict[str, Any], rows: Sequence[tuple[int, float, ErrorModelInput]]) -> Labels:
        """Build the columns from `rows`: stamp_ns, error_cm and inputs of each keyframe."""
        return cls(
            about,
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.float32),
            *(
                np.array([getattr(row[2], name) for row in rows], input_dtype(name)).reshape(-1, *shape)
                for name, shape in INPUT_SHAPES.items()
            ),
        )


_COLUMN_TYPES: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
    "stamps_ns": ((), np.int64),
    "error_cm": ((), np.float32),
    **{name: (shape, input_dtype(name)) for name, shape in INPUT_SHAPES.items()},
}
_COLUMNS = tuple(_COLUMN_TYPES)


def write_labels(path: Path, labels: Labels) -> None:
    """Write the labels atomically."""
    data = io.BytesIO()
    about = json.dumps({"schema": SCHEMA, **labels.about})
    np.savez_compressed(data, about=np.array(about), **{name: getattr(labels, name) for name in _COLUMNS})
    atomic_write(path, data.getvalue())


def read_labels(path: Path) -> Labels:
    """Read labels. Raises DataError that names the file."""
    arrays = read_arrays(path, "not a label file")
    try:
        about = parse_json(str(arrays["about"]))
        columns = [arrays[name] for name in _COLUMNS]
        if about.pop("schema", None) != SCHEMA:
            raise DataError(
                f"{path}: has a label schema other than {SCHEMA}; make it again with `share train labels`"
            )
        count = len(columns[0])
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: not a label file, or damaged: {error!r:.200}") from None
    for name, column in zip(_COLUMNS, columns, strict=True):
        shape, kind = _COLUMN_TYPES[name]
        if column.shape != (count, *shape) or column.dtype != kind:
            raise DataError(f"{path}: is damaged: {name} is {column.shape} of {column.dtype}")
    return Labels(about, *columns)
