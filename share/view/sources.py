"""Conversion of edge, map-file and tracker values to events of the live room."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from share.geometry.camera import Rig
from share.mapping.corrections import MapEvent
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    MapChange,
    RemoveKeyframes,
    RemoveLoops,
    SaveLoop,
    SavePoses,
    StoredMap,
    map_poses,
)
from share.types import F32, AgentKind, Keyframe, KeyframeImage, View
from share.view import events as ev

_MAX_DEPTH_M, _MAX_DEPTH_SIGMA_M = 10.0, 0.15  # of points that are shown


def run_event(run: str, name: str, kind: AgentKind, rig: Rig) -> ev.RunArrived:
    camera = rig.cam0
    half_angles = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    return ev.RunArrived(run, name, kind, rig.T_body_cam0, half_angles)


def keyframe_event(run: str, keyframe: Keyframe, rig: Rig) -> ev.KeyframeArrived:
    return ev.KeyframeArrived(
        KeyframeKey(run, keyframe.id),
        keyframe.reference < 0,
        keyframe.T_odom_body,
        points_in_body(keyframe.view, keyframe.image, rig),
        keyframe.image.jpeg.tobytes(),
    )


def points_in_body(view: View, image: KeyframeImage, rig: Rig) -> F32:
    """Return the points (n, 3) of a keyframe that are shown, in the body."""
    points = np.concatenate([view.points, _certain_points(image)])
    points, T = points[np.isfinite(points).all(axis=1)], rig.T_body_cam0
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], np.float32)


def _certain_points(image: KeyframeImage) -> F32:
    """Return the points (n, 3) of an image that are near enough and known well enough to be shown."""
    points = image.points
    depth = points[:, 2]
    sigma_m = image.rho_sigma * depth**2
    return points[(depth < _MAX_DEPTH_M) & (sigma_m < _MAX_DEPTH_SIGMA_M)]


def change_event(change: MapChange) -> ev.RoomEvent | None:
    """Return the event for a change of the map; None if it is not drawn."""
    match change:
        case SaveLoop():
            return ev.LoopAccepted(change.loop.a, change.loop.b)
        case RemoveLoops():
            return ev.LoopsRemoved(change.a, change.b)
        case RemoveKeyframes():
            return ev.KeyframesRemoved(change.keys)
        case SavePoses():
            return ev.MapsSolved(change)
    return None


def correction_event(map_event: MapEvent) -> ev.CorrectionArrived | None:
    if map_event.agent is None or (correction := map_event.correction) is None:
        return None
    return ev.CorrectionArrived(
        map_event.agent, correction.map_id, correction.T_map_odom, correction.segment_keyframe
    )


def map_events(stored: StoredMap) -> Iterator[ev.RoomEvent]:
    """Yield the events that lead to the map of an earlier session."""
    rigs = {}
    for run in stored.runs:
        rigs[run.run_key] = run.hello.rig
        yield run_event(run.run_key, run.hello.name, run.hello.kind, run.hello.rig)
    for one in stored.keyframes:
        if one.run_key in rigs:
            yield keyframe_event(one.run_key, one.keyframe, rigs[one.run_key])
    if placed := map_poses(stored):
        map_ids = tuple(map_id for map_id, _ in placed.values())
        yield ev.MapsSolved(SavePoses(tuple(placed), np.array([T for _, T in placed.values()]), map_ids))
    for loop in stored.loops:
        yield ev.LoopAccepted(loop.a, loop.b)


def map_file_events(path: Path) -> Iterator[ev.RoomEvent]:
    """Yield the events that rebuild a map file's content. Raises ShareError."""
    from share.store.loading import decode_map, read_only

    if path.exists() and path.stat().st_size:
        yield from map_events(decode_map(read_only(path).rows))
