"""A recording as an iterable of frames, and calibrations as rigs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from share.config import Config
from share.geometry.camera import Rig
from share.library.checked_input import checked_config, checked_frames, checked_path
from share.recordings.trajectory import Trajectory
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source, read_given_calibration
from share.sensors.sequencer import SequencerCounters
from share.types import Frame

logger = logging.getLogger("share")


class RecordedFrames:
    """A recording. Each iteration reads its frames from the start, in order, with the IMU samples of each.

    A frame with a damaged image is left out, and its IMU samples go to the next. source: what the
    runtime reads.
    """

    def __init__(self, path: str | Path, calib: str | Path | None, frames: slice | None, config: Config):
        given = None if calib is None else str(checked_path("calib", calib))
        self.source = open_source(str(checked_path("path", path)), given, checked_frames(frames))
        self._config = config

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def rig(self) -> Rig:
        """Cameras and IMU, as calibrated."""
        return self.source.rig

    @property
    def rate_hz(self) -> float:
        """Frame rate, Hz; 0 with fewer than two images."""
        return self.source.rate_hz

    def __len__(self) -> int:
        """Number of cam0's images."""
        return self.source.images_count

    def __iter__(self) -> Iterator[Frame]:
        """Raises DataError, a ShareError, where the recording cannot be read on."""
        return read_frames(self.source, self._config, SequencerCounters(), notify=logger.warning)

    def truth(self) -> Trajectory | None:
        """Return the recording's ground truth, `stamps_ns` (N,) and poses `T` (N, 4, 4) of the body in the
        world; None if it has none."""
        return self.source.truth()


def open_recording(
    path: str | Path,
    calib: str | Path | None = None,
    frames: slice | None = None,
    config: Config | None = None,
) -> RecordedFrames:
    """Open a recording in any form that the command line takes as SOURCE.

    calib: Kalibr's camchain file or a folder with both chains, in place of the recording's own calibration.
    frames: read only these of cam0's images, such as slice(0, 100). Raises ShareError.
    """
    return RecordedFrames(path, calib, frames, checked_config(config))


def load_calibration(path: str | Path) -> Rig:
    """Return the rig of a Kalibr camchain file, of a folder with both of Kalibr's chains, or of a camera.yaml
    (docs/lookup/data.md). Without an IMU chain the rig has no IMU. Raises ShareError."""
    calibration = read_given_calibration(str(checked_path("path", path)))
    assert calibration is not None
    return calibration.rig
