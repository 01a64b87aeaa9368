"""Opening a recording by the SOURCE of the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from share.cameras.realsense.devices import is_camera
from share.errors import UsageError
from share.recordings.bags import METADATA
from share.recordings.calibration import Calibration, read_calibration
from share.recordings.folders import is_euroc, is_tum, open_euroc, open_tum
from share.recordings.recording import Source
from share.recordings.session import is_session, read_session

__all__ = ["READERS", "Source", "open_source"]


class Reader(NamedTuple):
    """One kind of recording: how to recognise and open it."""

    description: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Calibration | None, slice | None], Source]


def _open_mcap(path: Path, calibration: Calibration | None, frames: slice | None) -> Source:
    from share.recordings.mcap.reader import open_mcap  # imports rosbags and mcap only when needed

    return open_mcap(path, calibration, frames)


def _is_bag(path: Path) -> bool:
    if not (path.suffix in (".db3", ".bag") or (path / METADATA).is_file()):
        return False
    from share.recordings.bags.opening import is_bag

    return is_bag(path)


def _is_mcap(path: Path) -> bool:
    return path.suffix == ".mcap" and path.is_file()


def _is_session_agent(path: Path) -> bool:
    return is_session(path.parent) and path.suffix != ".mcap" and not path.is_dir()


def _open_session_agent(path: Path, calibration: Calibration | None, frames: slice | None) -> Source:
    session = read_session(path.parent)
    recording = session.recording(path.name)
    return _open_mcap(recording, calibration or session.agents[path.name].calibration, frames)


def _open_db3(path: Path, calibration: Calibration | None, frames: slice | None) -> Source:
    from share.recordings.realsense import open_db3  # imports rosbags only when needed

    return open_db3(path, calibration, frames)


def _is_db3(path: Path) -> bool:
    return path.suffix == ".db3" and path.is_file()


READERS = (
    Reader("SESSION/NAME (a folder with session.yaml)", _is_session_agent, _open_session_agent),
    Reader("an MCAP recording (.mcap)", _is_mcap, _open_mcap),
    Reader("a ROS 2 bag (a folder with metadata.yaml, or .db3) or a ROS 1 bag (.bag)", _is_bag, _open_mcap),
    Reader("a recording of the RealSense SDK (.db3)", _is_db3, _open_db3),
    Reader("an EuRoC/ASL folder (mav0/)", is_euroc, open_euroc),
    Reader("a TUM RGB-D folder (rgb.txt, depth.txt, camera.yaml)", is_tum, open_tum),
)


def open_source(spec: str, calib: str | None = None, frames: slice | None = None) -> Source:
    """Open the recording `spec`, with the calibration `calib` in place of its own.

    frames: read only these cam0 images (by number, no step) and the IMU samples since the image before.
    Raises UsageError, ConfigError or DataError.
    """
    if is_camera(spec):
        raise UsageError(f"{spec}: record a live camera with `share capture`, then give the recording")
    path = Path(spec)
    calibration = read_given_calibration(calib)
    for reader in READERS:
        if reader.matches(path):
            return reader.open(path, calibration, frames)
    _check_exists(path, "SOURCE")
    if path.name.endswith(".mcap.part"):
        raise _unclosed_error(path)
    if is_session(path):
        agents = ", ".join(str(path / name) for name in read_session(path).agents)
        raise UsageError(f"{spec}: is a session; name one of its agents: {agents}")
    known = "; ".join(reader.description for reader in READERS)
    raise UsageError(f"{spec}: not a recording that SHARE reads: {known}")


def read_given_calibration(calib: str | None) -> Calibration | None:
    """Read the calibration that --calib names; None without one. Raises UsageError, ConfigError."""
    return None if calib is None else read_calibration(_check_exists(Path(calib), "--calib"))


def _check_exists(path: Path, what: str) -> Path:
    if not path.exists():
        part = path.with_name(path.name + ".part")
        if part.exists():
            raise _unclosed_error(part)
        raise UsageError(f"{what} {path}: no such file or folder")
    return path


def _unclosed_error(part: Path) -> UsageError:
    saves = f"`share dataset recover {part} --out {part.with_suffix('')}` saves its contents"
    return UsageError(f"{part}: was not closed, or is still being recorded; {saves}")
