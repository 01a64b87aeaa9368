"""`share train labels`: our own tracker over sessions with truth, and how wrong it was at each keyframe."""

from __future__ import annotations

import io
import json
import zlib
from collections import deque
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
from share.lab.train.fault_injection import FAULT_KINDS, FaultInterval, draw_faults, inject_faults
from share.metrics.local_error import WINDOW_S, LocalError
from share.odometry.error_model.history import MOST_AGO, MotionHistory
from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput, error_model_input, input_dtype
from share.recordings.session import Session, read_session
from share.runtime.error_estimators import frame_outcome
from share.runtime.pipeline import check_trackable, make_tracker, read_frames
from share.runtime.pool import Pool
from share.runtime.source import Source, open_source
from share.sensors.sequencer import SequencerCounters
from share.startup import prepare_process
from share.types import F32, I64, U8, Frame, ImuBatch

_MAX_FAULT_KINDS = 3  # that come together in one run
_IMU_SUFFIX = {True: "", False: "-without-imu"}


@dataclass(frozen=True)
class LabelRun:
    """One run of one agent. number: 0 is as recorded, each other one spoiled in its own way. imu: False plays
    it as if there were none."""

    session: Path
    agent: str
    number: int
    seed: int
    imu: bool
    out: Path


def plan_label_runs(
    sessions: Sequence[Session], runs: int, seed: int, imu: bool, out: Path
) -> list[LabelRun]:
    """Everything, done or not. Raises UsageError where there is no truth, or two sessions have one name."""
    check_unique_names(sessions)
    jobs = []
    for session in sessions:
        name = session.folder.resolve().name
        for agent in session.agents:
            if not (session.folder / "truth" / f"{agent}.tum").is_file():
                raise UsageError(f"{session.folder}: has no truth/{agent}.tum to tell how wrong it is")
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
    """Those that are not there yet are made; each of `jobs` with its labels, as they come. Raises UsageError
    where one is there that was spoiled otherwise."""
    pending = [job for job in jobs if not job.out.exists()]
    for job in jobs:
        if job.out.exists():
            run_labels = read_labels(job.out)
            if (seed := run_labels.about.get("seed")) != job.seed:
                raise UsageError(f"{job.out}: is of seed {seed}; give another --out")
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
    allowed_kinds = [kind for kind in FAULT_KINDS if job.imu or kind != "deaf"]
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
        "spells": [asdict(spell) for spell in faults],
        "window_s": WINDOW_S,
        "version": __version__,
    }
    rows = list(labelled_keyframes(source, config, faults, job.seed, job.imu))
    write_labels(job.out, Labels.from_rows(about, rows))


def labelled_keyframes(
    source: Source, config: Config, faults: Sequence[FaultInterval] = (), seed: int = 0, imu: bool = True
) -> Iterator[tuple[int, float, ErrorModelInput]]:
    """Of each keyframe of our own tracker: its stamp, how wrong the tracker was then (cm, NaN unknown),
    and what the error model is told. imu: False plays it as if there were none. Raises UsageError without a
    truth, or where no tracker fits."""
    truth = source.truth()
    if truth is None:
        raise UsageError(f"{source.name}: comes without a truth, so nobody knows how wrong a tracker is")
    # Not `without_imu`, which makes cam0 the body: the truth stays that of the body that was recorded.
    rig = source.rig if imu else replace(source.rig, imu=None)
    check_trackable(source.name, rig)
    tracker, error, odometer = make_tracker(rig, config), LocalError(truth), MotionHistory()
    recent_motion: deque[tuple[Frame, float | None]] = deque(maxlen=MOST_AGO)
    for frame in inject_faults(read_frames(source, config, SequencerCounters()), faults, seed, rig):
        frame = frame if imu else replace(frame, imu=ImuBatch.empty())
        result = tracker.track(frame)
        error_cm = error.update(frame.stamp_ns, result.T_odom_body, result.new_segment)
        odometer.add_frame(frame_outcome(frame, result))
        recent_motion.append((frame, error_cm))
        if result.keyframe_ready:
            statistics, candidate = tracker.feature_statistics(), tracker.make_keyframe(frame)
            own, own_cm = recent_motion[-1 - candidate.frames_ago]
            known_error_cm = float("nan") if own_cm is None else own_cm
            fares = odometer.add_keyframe(own.stamp_ns, candidate)
            yield own.stamp_ns, known_error_cm, error_model_input(own.image0, statistics, fares)


# ---- What a tracker's keyframes looked like and how wrong it was: one file a run, for training.
#
# A NumPy archive (.npz) with a column each and `about`, JSON: of which session and agent, in which room, how
# it moved, what was spoiled, and by which SHARE.

SCHEMA = 4


@dataclass(frozen=True, eq=False)
class Labels:
    """Keyframes of one run, in order: stamps_ns (N,); error_cm (N,), NaN unknown; picture (N, 128, 128), psd
    (N, 3, 12, 16), scalars (N, 8), recent (N, 14) as in `ErrorModelInput`. about: plain data."""

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
        """rows: stamp_ns, error_cm and features of each keyframe."""
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
    """Whole or not at all."""
    data = io.BytesIO()
    about = json.dumps({"schema": SCHEMA, **labels.about})
    np.savez_compressed(data, about=np.array(about), **{name: getattr(labels, name) for name in _COLUMNS})
    atomic_write(path, data.getvalue())


def read_labels(path: Path) -> Labels:
    """Raises DataError that names it."""
    arrays = read_arrays(path, "is no file of labels")
    try:
        about = parse_json(str(arrays["about"]))
        columns = [arrays[name] for name in _COLUMNS]
        if about.pop("schema", None) != SCHEMA:
            raise DataError(
                f"{path}: is of another schema than {SCHEMA}; make it anew with `share train labels`"
            )
        count = len(columns[0])
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: is no file of labels, or damaged: {error!r:.200}") from None
    for name, column in zip(_COLUMNS, columns, strict=True):
        shape, kind = _COLUMN_TYPES[name]
        if column.shape != (count, *shape) or column.dtype != kind:
            raise DataError(f"{path}: is damaged: {name} is {column.shape} of {column.dtype}")
    return Labels(about, *columns)
