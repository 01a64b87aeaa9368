"""A differential drive: commands in, true motion and wheel odometry out.

Each wheel follows its commanded speed after a latency, within the robot's limits. What it moves on the floor
is what its encoder counts, times an unequal diameter and a slowly changing slip; odometry knows neither
(systematic and other errors as in Borenstein & Feng, *Measurement and Correction of Systematic Odometry
Errors in Mobile Robots*, IEEE Trans. Robotics and Automation 12(6), 1996).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from share.robot.planar import PlanarPose
from share.robot.settings import CREATE3_SPEED_M_S
from share.timing import seconds_to_ns

STEP_S = 0.005  # of integration: the knots of the emulator's paths
STEP_NS = seconds_to_ns(STEP_S)


@dataclass(frozen=True)
class DriveModel:
    """Parameters of a robot's base; the defaults are a Create 3.

    max_speed_m_s, acceleration_m_s2 (of a wheel), max_turn_rad_s, wheel_base_m, silence_s (after which it
    stops): iRobot's documentation of the Create 3. latency_s: from a command to the wheels, by DDS and the
    base's own loop of 40 Hz; response_s: time constant of the motors. Both are argued, not measured.

    Errors, 1 sigma: diameter of each wheel and wheel base relative to what odometry takes them for, a few
    times those of the robot that Borenstein & Feng measured (0.15 %, 0.8 %), since a Create 3 has soft tyres;
    slip: of each wheel, relative, a Gauss-Markov process of slip_s.
    """

    max_speed_m_s: float = CREATE3_SPEED_M_S
    acceleration_m_s2: float = 0.9
    max_turn_rad_s: float = 1.9
    wheel_base_m: float = 0.233
    silence_s: float = 0.5
    latency_s: float = 0.06
    response_s: float = 0.08
    diameter_error: float = 0.005
    wheel_base_error: float = 0.015
    slip: float = 0.02
    slip_s: float = 0.5


@dataclass(frozen=True)
class DriveStep:
    """The base after a step. T_world_base: true; T_odom_base: by its wheels. speed_m_s, acceleration_m_s2:
    true, along its x; odom_speed_m_s: by its wheels."""

    T_world_base: PlanarPose
    T_odom_base: PlanarPose
    speed_m_s: float
    acceleration_m_s2: float
    odom_speed_m_s: float


class DifferentialDrive:
    """One base from a pose at rest; odometry begins at its origin. Deterministic for a given generator
    state."""

    def __init__(self, model: DriveModel, T_world_base: PlanarPose, rng: np.random.Generator) -> None:
        self._model, self._rng = model, rng
        self._diameters = 1 + model.diameter_error * rng.standard_normal(2)
        self._wheel_base_m = model.wheel_base_m * (1 + model.wheel_base_error * rng.standard_normal())
        self._slip = model.slip * rng.standard_normal(2)
        self._ramp, self._wheels = np.zeros(2), np.zeros(2)  # speeds m/s, left and right
        self._commands: deque[tuple[int, float, float]] = deque()
        self._command, self._command_ns = (0.0, 0.0), 0
        self.now_ns = 0
        self.last = DriveStep(T_world_base, PlanarPose(0.0, 0.0, 0.0), 0.0, 0.0, 0.0)

    def command(self, now_ns: int, speed_m_s: float, turn_rad_s: float) -> None:
        """Take a cmd_vel at a time that does not decrease."""
        self._commands.append((now_ns + seconds_to_ns(self._model.latency_s), speed_m_s, turn_rad_s))

    def step(self, is_blocked: bool = False) -> DriveStep:
        """Go on by STEP_NS. is_blocked: a bumper is pressed, and the base's own reflex stops it from driving
        on ahead."""
        self.now_ns += STEP_NS
        while self._commands and self._commands[0][0] <= self.now_ns:
            self._command_ns, *self._command = self._commands.popleft()  # type: ignore[assignment]
        self._turn_wheels(is_blocked)
        decay = math.exp(-STEP_S / self._model.slip_s)
        white = self._rng.standard_normal(2)
        self._slip = decay * self._slip + self._model.slip * math.sqrt(1 - decay * decay) * white
        ground = self._wheels * self._diameters * (1 + self._slip)
        speed = float(ground.mean())
        self.last = DriveStep(
            _moved(self.last.T_world_base, ground, self._wheel_base_m),
            _moved(self.last.T_odom_base, self._wheels, self._model.wheel_base_m),
            speed,
            (speed - self.last.speed_m_s) / STEP_S,
            float(self._wheels.mean()),
        )
        return self.last

    def _turn_wheels(self, is_blocked: bool) -> None:
        model = self._model
        is_silent = self.now_ns - self._command_ns > seconds_to_ns(model.silence_s)
        speed, turn = (0.0, 0.0) if is_silent else self._command
        speed = min(max(speed, -model.max_speed_m_s), 0.0 if is_blocked else model.max_speed_m_s)
        turn = min(max(turn, -model.max_turn_rad_s), model.max_turn_rad_s)
        wanted = speed + turn * model.wheel_base_m / 2 * np.array([-1.0, 1.0])
        wanted *= min(1.0, model.max_speed_m_s / max(float(np.abs(wanted).max()), 1e-9))  # the same bend
        most = model.acceleration_m_s2 * STEP_S
        self._ramp += np.clip(wanted - self._ramp, -most, most)
        self._wheels = self._wheels + (self._ramp - self._wheels) * -math.expm1(-STEP_S / model.response_s)
        if is_blocked:
            self._wheels -= max(0.0, float(self._wheels.mean()))  # the base stands; it may turn


def _moved(T: PlanarPose, wheels: np.ndarray, wheel_base_m: float) -> PlanarPose:
    """Return a pose after STEP_S of wheel speeds (2,) m/s, along an arc."""
    way, turned = float(wheels.mean()) * STEP_S, float(wheels[1] - wheels[0]) / wheel_base_m * STEP_S
    return T @ PlanarPose(way * math.cos(turned / 2), way * math.sin(turned / 2), turned)
