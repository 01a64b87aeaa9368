"""Messages of an agent's pose stream (docs/do/integrate.md) as events of the robot bridge."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from share.checks import checked_map_id, checked_pose
from share.errors import WireError, printable
from share.files.json_file import parse_json
from share.geometry.se3 import from_quat
from share.robot.robot_events import AgentPoseReceived
from share.types import F64, TrackState

SCHEMA = 3
_MAX_AGE_MS = 1e7
_VARIANCES = (0, 6)  # of x and y among the 21 numbers of the upper triangle
_COVARIANCE_XY = 1


def parse_pose_message(data: bytes) -> AgentPoseReceived:
    """Return the event. Raises WireError for what no agent sends."""
    try:
        message = parse_json(data)
    except ValueError:
        raise WireError("no JSON") from None
    if not isinstance(message, dict) or message.get("schema") != SCHEMA:
        raise WireError(f"not of schema {SCHEMA}; agent and bridge have to be of one release")
    try:
        return _event(message)
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise WireError(f"{type(error).__name__}: {printable(str(error))[:80]}") from None


def _event(message: dict[str, Any]) -> AgentPoseReceived:
    agent, sequence, age_ms = message["agent"], message["sequence"], message["age_ms"]
    in_map, map_id, has_edge = message["map"], message["map_id"], message.get("edge")
    if not isinstance(agent, str) or not isinstance(sequence, int) or not isinstance(map_id, str | None):
        raise ValueError("agent, sequence or map_id is of another type")
    if age_ms is not None and not 0 <= age_ms <= _MAX_AGE_MS:
        raise ValueError("age_ms is out of bounds")
    return AgentPoseReceived(
        printable(agent)[:64],
        sequence,
        TrackState(message["state"]),
        None if in_map is None else _pose(in_map),
        None if map_id is None else checked_map_id(map_id),
        None if in_map is None else _sigma_m(in_map["covariance"]),
        None if age_ms is None else round(1e6 * age_ms),
        has_edge if isinstance(has_edge, bool) else None,
        None if message["odom"] is None else _pose(message["odom"]),
    )


def _pose(fields: dict[str, Any]) -> F64:
    position, quaternion = np.array(fields["position"], float), np.array(fields["quaternion"], float)
    if position.shape != (3,) or quaternion.shape != (4,) or not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise ValueError("no pose")
    return checked_pose("map", from_quat(position, quaternion))


def _sigma_m(covariance: list[float] | None) -> float | None:
    """Return the standard deviation along the longest axis of x and y, m."""
    if covariance is None:
        return None
    (xx, yy), xy = (covariance[i] for i in _VARIANCES), covariance[_COVARIANCE_XY]
    if len(covariance) != 21 or xx < 0 or yy < 0:
        raise ValueError("no covariance")
    largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
    if not 0 <= largest < 1e12:
        raise ValueError("no covariance")
    return math.sqrt(largest)
