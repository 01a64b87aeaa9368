"""The agent's own small map: keyframes it has been at, and the points it first saw from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.camera import Camera
from share.types import F32, F64, I64, U8, View


@dataclass(frozen=True, eq=False)
class LocalKeyframe:
    """An image the local map holds on to: its patches are what a point looks like.

    view: its ORB features, for relocalisation; None until they are made.
    """

    image: U8
    T_odom_cam: F64
    view: View | None = None


class LocalMap:
    """Points in odom, each hosted by the keyframe that saw it first. Memory is bounded.

    Points have stable ids; a point is gone when its host is dropped.
    """

    def __init__(self, max_keyframes: int) -> None:
        self._max_keyframes = max_keyframes
        self.keyframes: dict[int, LocalKeyframe] = {}
        self._next_keyframe = 0
        self._next_id = 0
        self.ids: I64 = np.zeros(0, np.int64)  # ascending
        self.points: F64 = np.zeros((0, 3))
        self.hosts: I64 = np.zeros(0, np.int64)
        self.host_px: F32 = np.zeros((0, 2), np.float32)

    def add_keyframe(self, image: U8, T_odom_cam: F64) -> int:
        """Its number. Where the map is full, the keyframe nearest to another one makes room."""
        if len(self.keyframes) >= self._max_keyframes:
            self._drop(self._most_redundant())
        number = self._next_keyframe
        self._next_keyframe += 1
        self.keyframes[number] = LocalKeyframe(image, T_odom_cam)
        return number

    def set_view(self, view: View) -> None:
        """The features of the newest keyframe."""
        newest = self._next_keyframe - 1
        self.keyframes[newest] = replace(self.keyframes[newest], view=view)

    def add_points(self, host: int, points: F64, px: F32) -> I64:
        """Ids (N,) of new points (N, 3) m in odom, seen at px (N, 2) in keyframe `host`."""
        ids = np.arange(self._next_id, self._next_id + len(points))
        self._next_id += len(points)
        self.ids = np.concatenate([self.ids, ids])
        self.points = np.concatenate([self.points, points])
        self.hosts = np.concatenate([self.hosts, np.full(len(points), host)])
        self.host_px = np.concatenate([self.host_px, px.astype(np.float32)])
        return ids

    def rows(self, ids: I64) -> I64:
        """Row of each point, -1 where it is gone."""
        row = np.searchsorted(self.ids, ids)
        row = np.minimum(row, max(len(self.ids) - 1, 0))
        known = self.ids[row] == ids if len(self.ids) else np.zeros(len(ids), bool)
        return np.where(known, row, -1)

    def visible(
        self, T_cam_odom: F64, camera: Camera, hosts: list[int], border: float = 12.0
    ) -> tuple[I64, F32]:
        """Rows and predicted px of the points of `hosts` that the camera should see."""
        rows = np.flatnonzero(np.isin(self.hosts, hosts))
        px = camera.project(se3.transform(T_cam_odom, self.points[rows]))
        inside = camera.inside(np.nan_to_num(px, nan=-1e6), border)
        return rows[inside], px[inside].astype(np.float32)

    def hosts_near(self, T_odom_cam: F64, max_m: float, max_rad: float) -> list[int]:
        """Keyframes seen from about here, nearest first; one metre weighs as much as one radian."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        if len(numbers) == 0:
            return []
        (distance,), (angle,) = se3.apart(T_odom_cam[None], self._poses(numbers))
        near = (distance < max_m) & (angle < max_rad)
        cost = distance + angle
        return [int(n) for n in numbers[near][np.argsort(cost[near], kind="stable")]]

    def _poses(self, numbers: I64) -> F64:
        return np.stack([self.keyframes[int(n)].T_odom_cam for n in numbers])

    def _most_redundant(self) -> int:
        """The older keyframe of the closest pair."""
        numbers = np.array(sorted(self.keyframes), np.int64)
        poses = self._poses(numbers)
        distance, angle = se3.apart(poses[:-1], poses)  # the newest is never dropped
        cost = distance + angle
        cost[np.tril_indices_from(cost)] = np.inf
        return int(numbers[np.argmin(cost.min(axis=1))])

    def _drop(self, number: int) -> None:
        del self.keyframes[number]
        keep: NDArray[np.bool_] = self.hosts != number
        self.ids, self.points = self.ids[keep], self.points[keep]
        self.hosts, self.host_px = self.hosts[keep], self.host_px[keep]
