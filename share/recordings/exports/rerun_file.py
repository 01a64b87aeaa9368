"""A scene as a file for the Rerun viewer (`rerun X.rrd`): paths, bodies, cameras with their pictures, points.

Needs the extra `rerun`. The viewer is a program of its own; SHARE writes the file and starts nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from share.colours import agent_colour
from share.errors import ShareError, install_hint
from share.files.writing import check_replaceable
from share.geometry import se3
from share.geometry.camera import Camera
from share.recordings.exports.names import plain_names
from share.recordings.exports.scene import Progress, Scene, SceneAgent, SceneView
from share.types import F64

_TIMELINE = "stamp"


def write_rerun(scenes: Sequence[Scene], out: Path, progress: Progress) -> None:
    """Write scenes to `out`. progress: called with 1 for each keyframe. Raises ShareError without the
    package."""
    try:
        import rerun as rr
    except ImportError:
        raise ShareError(install_hint("rerun-sdk", "rerun")) from None
    check_replaceable(out)
    recording = rr.RecordingStream("share", recording_id=out.stem)
    part = out.with_name(out.name + ".part")
    try:
        recording.save(part)
        frames = plain_names([scene.name for scene in scenes])
        for scene in scenes:
            _log_scene(rr, recording, scene, frames[scene.name], progress)
        recording.flush()
        recording.disconnect()
        part.replace(out)
    except OSError as error:
        raise ShareError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        part.unlink(missing_ok=True)


def _log_scene(rr: Any, recording: Any, scene: Scene, root: str, progress: Progress) -> None:
    recording.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    names = plain_names(list(scene.agents))
    colours = {name: agent_colour(k) for k, name in enumerate(scene.agents)}
    for name, agent in scene.agents.items():
        entity = f"{root}/{names[name]}"
        _log_agent(rr, recording, agent, entity, colours[name])
        if agent.rig is not None:
            recording.log(f"{entity}/body/cam0", _transform(rr, agent.rig.T_body_cam0), static=True)
            recording.log(f"{entity}/body/cam0/image", _pinhole(rr, agent.rig.cam0), static=True)
    for view in sorted(scene.views, key=lambda view: view.stamp_ns):
        progress(1)
        _log_view(rr, recording, scene, view, f"{root}/{names[view.agent]}", colours[view.agent])


def _log_agent(rr: Any, recording: Any, agent: SceneAgent, entity: str, colour: tuple[int, int, int]) -> None:
    stamps, T = agent.trajectory.stamps_ns, agent.trajectory.T
    if not len(stamps):
        return
    recording.log(f"{entity}/path", rr.LineStrips3D([T[:, :3, 3]], colors=[colour]), static=True)
    for stamp_ns, pose in zip(stamps.tolist(), T, strict=True):
        recording.set_time(_TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        recording.log(f"{entity}/body", _transform(rr, pose))


def _log_view(
    rr: Any, recording: Any, scene: Scene, view: SceneView, entity: str, colour: tuple[int, int, int]
) -> None:
    recording.set_time(_TIMELINE, timestamp=np.datetime64(view.stamp_ns, "ns"))
    if (jpeg := view.jpeg()) and scene.camera(view) is not None:
        recording.log(
            f"{entity}/body/cam0/image/picture", rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
        )
    points = rr.Points3D(scene.world_points(view), colors=[colour], radii=[0.005])
    recording.log(f"{entity}/points/{view.number}", points)


def _transform(rr: Any, T: F64) -> Any:
    return rr.Transform3D(
        translation=T[:3, 3], quaternion=rr.Quaternion(xyzw=se3.quat_from_matrix(T[:3, :3]))
    )


def _pinhole(rr: Any, camera: Camera) -> Any:
    return rr.Pinhole(
        image_from_camera=camera.K,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.2,
    )
