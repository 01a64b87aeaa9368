"""A recording, a run or a map as a scene to export. A recording is tracked for that, as by `share track`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from share.config import Config
from share.errors import DataError, UsageError
from share.mapping.map_changes import StoredKeyframe, StoredMap, map_poses
from share.recordings.exports.scene import Progress, Scene, SceneAgent, SceneView, known_points
from share.recordings.trajectory import Trajectory, read_tum
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.offline_tracking import track_frames
from share.runtime.pipeline import check_trackable, read_frames
from share.runtime.source import Source
from share.sensors.sequencer import SequencerCounters
from share.store.export import file_names
from share.store.keyframe_archive import KeyframeArchive
from share.vision.image_codec import encode_jpeg

_JPEG_QUALITY = 95  # of a keyframe's picture
_RUN_FILES = ("map.tum", "odom.tum")  # that an agent leaves, the better first


def recording_scene(
    source: Source, config: Config, progress: Progress, notify: Callable[[str], None] = lambda text: None
) -> Scene:
    """Track a recording; return its causal poses in odom, and its keyframes with their points.

    progress: called with 1 for each frame. Raises UsageError where no tracker fits the rig, DataError where
    no frame can be tracked. Poses after a loss of tracking are those of the newest segment alone.
    """
    check_trackable(source.name, source.rig)
    tracker = GuardedTracker(source.rig, config, FaultGuard(notify))
    stamps: list[int] = []
    poses: list[np.ndarray] = []
    views: list[SceneView] = []
    frames = read_frames(source, config, SequencerCounters(), notify=notify)
    for step in track_frames(frames, tracker):
        progress(1)
        result, candidate = step.result, step.candidate
        if result.new_segment and poses:
            notify("tracking was lost: what comes before is in a frame of its own, and left out")
            stamps, poses, views = [], [], []
        if result.T_odom_body is not None:
            stamps.append(step.frame.stamp_ns)
            poses.append(result.T_odom_body)
        if candidate is not None:
            views.append(
                SceneView(
                    source.name,
                    len(views),
                    step.frame.stamp_ns,
                    candidate.T_odom_body,
                    known_points(candidate.points),
                    partial(bytes, encode_jpeg(step.frame.image0, _JPEG_QUALITY)),
                )
            )
    if not poses:
        raise DataError(f"{source.name}: none of its frames could be tracked (see `share track`)")
    trajectory = Trajectory(np.array(stamps, np.int64), np.array(poses))
    return Scene(source.name, "odom", {source.name: SceneAgent(trajectory, source.rig, source)}, views)


def is_run(folder: Path) -> bool:
    """Return whether an agent, or `share evaluate run`, has left its trajectories in `folder`."""
    return folder.is_dir() and bool(_run_files(folder))


def run_scene(folder: Path) -> Scene:
    """Return the trajectories of a run's agents: `map.tum` where there is one with poses, else `odom.tum`.
    Raises UsageError if only some agents are in a map, DataError."""
    agents: dict[str, SceneAgent] = {}
    kinds = set()
    for name, file in _run_files(folder).items():
        agents[name] = SceneAgent(read_tum(file))
        kinds.add(file.stem)
    if kinds == set(_file_kinds()):
        raise UsageError(
            f"{folder}: some of its agents have no pose in the map; name the folder of one agent"
        )
    return Scene(folder.resolve().name, kinds.pop(), agents)


def _file_kinds() -> tuple[str, ...]:
    return tuple(Path(name).stem for name in _RUN_FILES)


def _run_files(folder: Path) -> dict[str, Path]:
    """Return the trajectory of each agent, by name: of the folder itself, or of those in it."""
    own = {folder.resolve().name: folder}
    inside = {one.name: one for one in sorted(folder.iterdir()) if one.is_dir()}
    for folders in (own, inside):
        found = {name: file for name, one in folders.items() if (file := _trajectory_file(one)) is not None}
        if found:
            return found
    return {}


def _trajectory_file(folder: Path) -> Path | None:
    files = (folder / name for name in _RUN_FILES)
    return next((file for file in files if file.is_file() and file.stat().st_size), None)


def map_scenes(stored_map: StoredMap, path: Path) -> list[Scene]:
    """Return a scene for each map of the file `path`, the largest first. Raises UsageError if it is empty."""
    if not stored_map.keyframes:
        raise UsageError("the map is empty: there is nothing to export")
    poses, archive = map_poses(stored_map), KeyframeArchive(path)
    by_map: dict[str, dict[str, list[StoredKeyframe]]] = {}
    for keyframe in stored_map.keyframes:
        runs = by_map.setdefault(poses[keyframe.keyframe_key][0], {})
        runs.setdefault(keyframe.run_key, []).append(keyframe)
    names, rigs = file_names(stored_map), {run.run_key: run.hello.rig for run in stored_map.runs}
    scenes = []
    for map_name, runs in by_map.items():
        agents, views = {}, []
        for run_key, keyframes in runs.items():
            keyframes.sort(key=lambda one: one.keyframe.stamp_ns)
            T = np.array([poses[one.keyframe_key][1] for one in keyframes])
            stamps = np.array([one.keyframe.stamp_ns for one in keyframes], np.int64)
            agents[names[run_key]] = SceneAgent(Trajectory(stamps, T), rigs[run_key])
            views += [
                _view(names[run_key], one, pose, archive) for one, pose in zip(keyframes, T, strict=True)
            ]
        scenes.append(Scene(map_name, "map", agents, views))
    return sorted(scenes, key=lambda scene: -len(scene.views))


def _view(agent: str, stored: StoredKeyframe, T_map_body: np.ndarray, archive: KeyframeArchive) -> SceneView:
    keyframe = stored.keyframe
    return SceneView(
        agent,
        keyframe.id,
        keyframe.stamp_ns,
        T_map_body,
        known_points(keyframe.points),
        partial(_jpeg, archive, stored),
    )


def _jpeg(archive: KeyframeArchive, stored: StoredKeyframe) -> bytes:
    found = archive.jpeg(stored.keyframe_key)
    return b"" if found is None else found.tobytes()
