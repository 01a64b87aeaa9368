"""`robot:` is a differential-drive robot: straight on, in bends, turning in place, stopping.

It moves as a unicycle without slip, x' = v cos(h), y' = v sin(h), h' = w. The body frame is the IMU of its
camera, over the middle of the axle: x right, y down, z ahead, pitched up a little.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.route import Floor, Rng, Route, arc_length, headings, smooth_route
from share.lab.emulate.motion.schedule import MotionLimits, smooth_schedule
from share.lab.emulate.motion.spline import SplinePath, spline_through
from share.lab.emulate.motion.track import KNOT_S, PlanarTrack, knot_times
from share.lab.emulate.motion.walk import CAMERA_AXES, axis_rotation
from share.types import F64

RADIUS = 0.20  # m; a TurtleBot 4 is 34 cm wide
INITIAL_STILL_S = 1.3
CAMERA_PITCH = 0.10  # rad, upwards
_PIVOT_LEVER_M = 0.25  # path length that counts for a radian of turning in place
_MAX_DRIVEN_CORNER = 0.9  # rad, larger corners are turned in place
_PIVOT_STEP_RAD = 0.02  # rad
_WHEEL_SMOOTHING_S = 0.08  # sigma of the wheels' response
PITCH_PER_ACCEL = 0.010  # rad per m/s^2 of acceleration, by the castors' compliance
# lowest, strongest and highest frequency of vibration by wheels and floor
_RUMBLE_BAND_HZ = (6.0, 17.0, 45.0)


def motion_limits(speed: float) -> MotionLimits:
    """Return the limits of a robot that cruises at `speed` m/s."""
    return MotionLimits(
        max_speed=1.15 * speed, max_rotation_rate=1.3, lateral_acceleration=0.4, acceleration=0.5
    )


def route_from_legs(floor: Floor, legs: Sequence[F64]) -> Route:
    """Return each leg of a tour as a smooth line; between them the robot turns in place, which counts as
    _PIVOT_LEVER_M of path a radian."""
    parts: list[Route] = []
    for leg in _merge_legs(legs):
        xy = smooth_route(floor, leg, RADIUS)
        heading = headings(xy)
        bend = np.gradient(heading) / np.gradient(arc_length(xy))
        if parts:
            parts.append(_pivot_route(xy[0], parts[-1].heading[-1], heading[0]))
            heading = heading + parts[-1].heading[-1] - heading[0]
        bend[[0, -1]] = 1e3  # it stops where it turns
        parts.append(Route(xy, arc_length(xy), heading, bend))
    start, distances = 0.0, []
    for part in parts:
        distances.append(start + part.distance)
        start = distances[-1][-1] + 1e-6
    return Route(
        np.concatenate([p.xy for p in parts]),
        np.concatenate(distances),
        np.concatenate([p.heading for p in parts]),
        np.concatenate([p.curvature for p in parts]),
    )


def track_on_route(route: Route, steps: F64, duration: float) -> PlanarTrack:
    """Return the axle's motion: the wheels follow the schedule, and their motion is integrated."""
    from scipy.ndimage import gaussian_filter1d

    seconds = knot_times(duration)
    distance = smooth_schedule(steps, seconds)
    along = np.interp(distance, route.distance, arc_length(route.xy))
    target = np.stack([along, np.interp(distance, route.distance, route.heading)])
    wheels = gaussian_filter1d(
        np.gradient(target, KNOT_S, axis=1), _WHEEL_SMOOTHING_S / KNOT_S, mode="nearest"
    )
    speed, turning = wheels
    heading = route.heading[0] + _integrate(turning)
    xy = route.xy[0] + np.stack([_integrate(speed * f(heading)) for f in (np.cos, np.sin)], axis=1)
    return PlanarTrack(seconds, xy, heading, speed)


def imu_path(track: PlanarTrack, height: float, vibration: float, start_ns: int, rng: Rng) -> SplinePath:
    """Return the path of the camera's IMU. height: m. vibration: m/s^2, rms of the vertical at 0.3 m/s."""
    rumble = np.stack([rumble_displacement(len(track.seconds), rng) for _ in range(4)])
    up, aside, pitch, roll = base_shake(track.speed, vibration, rumble)
    gain = np.gradient(track.speed, KNOT_S)
    left = np.stack([-np.sin(track.heading), np.cos(track.heading)], axis=1)
    p = np.column_stack([track.xy + aside[:, None] * left, height + up])
    nose = CAMERA_PITCH + pitch + PITCH_PER_ACCEL * gain
    R = axis_rotation(2, track.heading) @ axis_rotation(1, -nose) @ axis_rotation(0, roll)
    return spline_through(start_ns, track.seconds, p, se3.quat_from_matrix(R @ CAMERA_AXES))


def base_shake(speed: F64, vibration: float, rumble: F64) -> tuple[F64, F64, F64, F64]:
    """Return how far the wheels and the floor shake a base up and aside, (M,) m each, and its pitch and roll,
    (M,) rad each, at `speed` (M,) m/s. rumble (4, M): of `rumble_displacement`."""
    strength = (np.abs(speed) / 0.3).clip(0, 3) ** 0.7 + 0.03  # never 0: fans run
    shake = vibration * strength * rumble
    return shake[0], 0.3 * shake[1], 3.0 * shake[2], 2.0 * shake[3]  # rad per m, for a wheel base of 0.3 m


def _merge_legs(legs: Sequence[F64]) -> list[F64]:
    """Merge legs that continue in nearly the same direction; the robot drives through there."""
    out = [legs[0]]
    for leg in legs[1:]:
        before, after = out[-1][-1] - out[-1][-6:][0], leg[:6][-1] - leg[0]
        if abs(np.angle(complex(*after) / complex(*before))) < _MAX_DRIVEN_CORNER:
            out[-1] = np.concatenate([out[-1], leg[1:]])
        else:
            out.append(leg)
    return out


def _pivot_route(xy: F64, before: float, after: float) -> Route:
    """Return a turn in place, the short way round."""
    angle = (after - before + np.pi) % (2 * np.pi) - np.pi
    count = max(3, round(abs(angle) / _PIVOT_STEP_RAD))
    heading = before + angle * np.linspace(0, 1, count)
    bend = np.full(count, 1 / _PIVOT_LEVER_M)
    bend[[0, -1]] = 1e3
    return Route(
        np.tile(xy, (count, 1)),
        _PIVOT_LEVER_M * np.abs(heading - before) + 1e-6 * np.arange(count),
        heading,
        bend,
    )


def rumble_displacement(count: int, rng: Rng) -> F64:
    """Return displacement (M,) m with an acceleration of rms 1 m/s^2, in a band with one soft resonance."""
    hz = np.fft.rfftfreq(count, KNOT_S)
    low, peak, high = _RUMBLE_BAND_HZ
    shape = np.exp(-0.5 * (np.log(np.maximum(hz, 1e-3) / peak) / 0.5) ** 2) * (hz > low) * (hz < high)
    noise = shape * (rng.normal(size=len(hz)) + 1j * rng.normal(size=len(hz)))
    acceleration = np.fft.irfft(noise, count)
    scale = 1 / acceleration.std()
    moved: F64 = np.fft.irfft(-noise * scale / np.maximum(2 * np.pi * hz, 1.0) ** 2, count)
    return moved


def _integrate(values: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)]) * KNOT_S
