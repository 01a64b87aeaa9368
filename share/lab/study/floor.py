"""The study's floor in the shared map: a marker lies where the plan has 0, 0, and faces along its x.

Everything of a trial is told in the floor's frame, so a map that joins another moves nothing: the marker goes
with it, as cubes do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from share.lab.study.standstill import RobotSample
from share.robot.planar import PlanarPose, flattened
from share.wire.room_messages import ObjectKind, RobotPlace, RoomObject

STUDY_NAME = "study"  # of the client that shows spots and sends the robot
SPOT_ID = 2_047_430_043  # of the object that shows the next spot


@dataclass(frozen=True)
class StudyFloor:
    """Where the floor is in a map. z: of its marker, m."""

    map_id: str
    T_map_floor: PlanarPose
    z: float

    def in_map(self, x: float, y: float) -> PlanarPose:
        """Return a place of the floor in the map."""
        return self.T_map_floor @ PlanarPose(x, y, 0.0)

    def robot(self, place: RobotPlace, t_s: float) -> RobotSample | None:
        """Return where a robot is on the floor; None if it is not known there."""
        if place.map_id != self.map_id:
            return None
        T = self.T_map_floor.inverse() @ PlanarPose(place.x, place.y, place.yaw)
        return RobotSample(t_s, T.x, T.y, T.yaw)

    def cube(self, one: RoomObject) -> tuple[float, float] | None:
        """Return where an object is on the floor; None in another map."""
        if one.map_id != self.map_id:
            return None
        T = self.T_map_floor.inverse() @ flattened(one.T_map_object)
        return T.x, T.y


def find_markers(objects: Mapping[int, RoomObject]) -> list[RoomObject]:
    """Return the markers of the room that are not the study's own."""
    return [
        one
        for number, one in sorted(objects.items())
        if one.kind is ObjectKind.MARKER and one.owner != STUDY_NAME
    ]


def floor_of(objects: Mapping[int, RoomObject], marker_id: int | None) -> StudyFloor | None:
    """Return the floor by its marker; None without that."""
    marker = None if marker_id is None else objects.get(marker_id)
    if marker is None:
        return None
    T = marker.T_map_object
    return StudyFloor(marker.map_id, flattened(T), float(T[2, 3]))
