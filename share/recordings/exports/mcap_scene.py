"""A scene as MCAP of ROS 2 messages, so that a 3D panel of Foxglove or RViz shows the room moving.

/tf                                 where each agent's body is: map -> NAME/body
/tf_static                          its cameras: NAME/body -> NAME/cam0 -> NAME/cam1, NAME/depth
/NAME/pose                          geometry_msgs/PoseStamped
/points                             sensor_msgs/PointCloud2, all points, a colour an agent
/NAME/cam0/image_raw/compressed     pictures, a camera_info with each; of a recording all streams
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.colours import agent_colour
from share.errors import DataError
from share.files.writing import new_file, write_errors
from share.geometry import se3
from share.geometry.camera import Rig
from share.recordings.convert import intact_measurements
from share.recordings.exports.names import plain_names
from share.recordings.exports.scene import Progress, Scene, SceneAgent
from share.recordings.images import EncodedImage
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.message_writer import MessageWriter
from share.recordings.mcap.rig import rig_to_json, to_camera_info, to_tf, to_transform
from share.recordings.recording import Source
from share.sensors.measurement import CAM0, DEPTH, IMU, Measurement
from share.types import F64

_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
_FLOAT32 = 7  # sensor_msgs/PointField, also of packed colours, by PCL's custom


class _Message(NamedTuple):
    """A message to write. is_latched: for late subscribers too."""

    log_ns: int
    topic: str
    message: Any
    is_latched: bool = False


def write_mcap(scenes: Sequence[Scene], out: Path, progress: Progress) -> None:
    """Write scenes to the new file `out`, by time. With several, each has a frame of its own name.

    progress: called with 1 for each keyframe, or image of cam0 of a recording. Raises UsageError if `out`
    exists, DataError for stamps that ROS cannot hold, ShareError.
    """
    names = plain_names([name for scene in scenes for name in scene.agents])
    frames = plain_names([scene.name for scene in scenes])
    streams: list[Iterable[_Message]] = []
    for scene in scenes:
        frame = scene.frame if len(scenes) == 1 else frames[scene.name]
        points_topic = "/points" if len(scenes) == 1 else f"/{frame}/points"
        streams.append(_beginning(scene, frame, points_topic, names))
        for name, agent in scene.agents.items():
            streams.append(_poses(agent, names[name], frame))
            if agent.rig is not None and agent.source is not None:
                streams.append(_recorded(agent.source, agent.rig, names[name], progress))
            elif agent.rig is not None:
                streams.append(_pictures(scene, name, agent.rig, names[name], progress))
    with write_errors(out), new_file(out) as file:
        writer = MessageWriter(file)
        recorded = [a for scene in scenes for a in scene.agents.values() if a.source is not None]
        if len(recorded) == 1 and recorded[0].rig is not None:  # then the export is a SOURCE too
            writer.add_metadata(ros.RIG_RECORD, {"rig": rig_to_json(recorded[0].rig), "schema": "1"})
        for log_ns, topic, message, is_latched in heapq.merge(*streams, key=lambda one: one.log_ns):
            if not 0 <= log_ns < 2**31 * 10**9:
                raise DataError(f"{out}: stamp {log_ns} ns does not fit a ROS 2 message")
            writer.write(topic, message, log_ns, is_latched)
        writer.finish()


def _beginning(scene: Scene, frame: str, points_topic: str, names: dict[str, str]) -> Iterator[_Message]:
    """Yield what holds for the whole scene: where cameras sit on bodies, and all points."""
    stamps = [agent.trajectory.stamps_ns for agent in scene.agents.values()]
    start_ns = min((int(one[0]) for one in stamps if len(one)), default=0)
    rigs = {names[name]: agent.rig for name, agent in scene.agents.items() if agent.rig is not None}
    static = [t for name, rig in rigs.items() for t in to_tf(rig, start_ns, f"{name}/").transforms]
    if static:
        yield _Message(start_ns, ros.TF_STATIC, ros.make_message(ros.TF, transforms=static), True)
    if scene.views:
        yield _Message(start_ns, points_topic, _point_cloud(scene, frame, start_ns), True)


def _poses(agent: SceneAgent, name: str, frame: str) -> Iterator[_Message]:
    for stamp_ns, T in zip(agent.trajectory.stamps_ns.tolist(), agent.trajectory.T, strict=True):
        transform = to_transform(frame, f"{name}/{ros.BODY}", T, stamp_ns)
        yield _Message(stamp_ns, "/tf", ros.make_message(ros.TF, transforms=[transform]))
        yield _Message(stamp_ns, f"/{name}/pose", _pose_stamped(frame, T, stamp_ns))


def _pictures(scene: Scene, agent: str, rig: Rig, name: str, progress: Progress) -> Iterator[_Message]:
    """Yield the pictures of an agent's keyframes."""
    own = [view for view in scene.views if view.agent == agent]
    for view in sorted(own, key=lambda view: view.stamp_ns):
        progress(1)
        if jpeg := view.jpeg():
            header = ros.make_header(view.stamp_ns, f"{name}/{CAM0}")
            image = ros.encode_compressed(header, jpeg, is_depth=False)
            yield from _with_camera_info(image, rig, name, CAM0, view.stamp_ns)


def _recorded(source: Source, rig: Rig, name: str, progress: Progress) -> Iterator[_Message]:
    """Yield all images and samples of a recording."""
    for m in intact_measurements(source, progress):
        if m.stream == IMU:
            message = ros.imu_message(m.stamp_ns, m.payload, f"{name}/{ros.BODY}")
            yield _Message(m.stamp_ns, f"/{name}/imu0", message)
        else:
            yield from _with_camera_info(_recorded_image(m, name), rig, name, m.stream, m.stamp_ns)


def _recorded_image(m: Measurement, name: str) -> Any:
    header, image, is_depth = ros.make_header(m.stamp_ns, f"{name}/{m.stream}"), m.payload, m.stream == DEPTH
    if isinstance(image, EncodedImage) and (not is_depth or image.depth_scale == ros.MILLIMETRES):
        return ros.encode_compressed(header, image.read(), is_depth)
    return ros.encode_raw(header, image.load())


def _with_camera_info(image: Any, rig: Rig, name: str, stream: str, stamp_ns: int) -> Iterator[_Message]:
    """Yield a CameraInfo and its image: image_proc and RTAB-Map wait for one with each."""
    info = to_camera_info(rig.cameras[stream], image.header)
    suffix = ros.SUFFIXES[stream == DEPTH] if image.__msgtype__ == ros.COMPRESSED else ""
    yield _Message(stamp_ns, f"/{name}{ros.INFO_TOPICS[stream]}", info)
    yield _Message(stamp_ns, f"/{name}{ros.TOPICS[stream]}{suffix}", image)


def _pose_stamped(frame: str, T: F64, stamp_ns: int) -> Any:
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = se3.quat_from_matrix(T[:3, :3]).tolist()
    pose = ros.make_message(
        "geometry_msgs/msg/Pose",
        position=ros.make_message("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=ros.make_message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    header = ros.make_header(stamp_ns, frame)
    return ros.make_message("geometry_msgs/msg/PoseStamped", header=header, pose=pose)


def _point_cloud(scene: Scene, frame: str, stamp_ns: int) -> Any:
    """Return the points of all views as a PointCloud2: x, y, z, rgb."""
    colours = {name: agent_colour(k) for k, name in enumerate(scene.agents)}
    clouds = []
    for view in scene.views:
        cloud = np.zeros(len(view.points), _POINT)
        for axis, values in zip("xyz", scene.world_points(view).T, strict=True):
            cloud[axis] = values
        red, green, blue = colours[view.agent]
        cloud["rgb"] = red << 16 | green << 8 | blue
        clouds.append(cloud)
    points = np.concatenate(clouds)
    fields = [
        ros.make_message("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=_FLOAT32, count=1)
        for k, name in enumerate(_POINT.names or ())
    ]
    return ros.make_message(
        "sensor_msgs/msg/PointCloud2",
        header=ros.make_header(stamp_ns, frame),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )
