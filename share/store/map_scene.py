"""The maps of a map file as scenes to export."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.mapping.map_changes import StoredKeyframe, StoredMap, map_poses
from share.recordings.exports.scene import Scene, SceneAgent, SceneView, known_points
from share.recordings.trajectory import Trajectory
from share.store.export import file_names
from share.store.keyframe_archive import KeyframeArchive


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
