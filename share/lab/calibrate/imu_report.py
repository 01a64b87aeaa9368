"""Output of `share calibrate imu`: Kalibr's IMU chain, a JSON report and an Allan deviation chart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.lab.calibrate.imu import ImuCharacteristics, SensorNoise
from share.lab.calibrate.imu_noise import FLICKER_FACTOR, NoiseEstimate
from share.lab.calibrate.report import AXIS_COLOURS
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.recordings.calibration import DEFAULT_TOPICS, SERIAL
from share.sensors.profile_types import InertialFacts, Profile

GYRO, ACCEL = "gyroscope", "accelerometer"
QUANTITIES = ("density", "instability", "walk")
UNITS = {
    GYRO: dict(zip(QUANTITIES, ("rad/s/sqrt(Hz)", "rad/s", "rad/s^2/sqrt(Hz)"), strict=True)),
    ACCEL: dict(zip(QUANTITIES, ("m/s^2/sqrt(Hz)", "m/s^2", "m/s^3/sqrt(Hz)"), strict=True)),
}


class NoiseRow(NamedTuple):
    """One quantity of one sensor: of each axis, of all axes combined, and of the profile, if it has it."""

    sensor: str
    quantity: str
    unit: str
    axes: tuple[NoiseEstimate, ...]
    combined: NoiseEstimate
    profile_value: float | None

    @property
    def ratio_to_profile(self) -> float | None:
        """Ratio of the estimate to the profile's value; None where one of the two is unknown."""
        return (
            self.combined.value / self.profile_value
            if self.profile_value and self.combined.significant
            else None
        )


def noise_rows(characteristics: ImuCharacteristics, profile: Profile | None) -> list[NoiseRow]:
    """Return rows of N, B and K of the gyroscope and of the accelerometer."""
    out = []
    for name, sensor in ((GYRO, characteristics.gyro), (ACCEL, characteristics.accel)):
        profile_values = profile_noise(profile, name)
        for figure, unit in UNITS[name].items():
            axes = tuple(getattr(axis, figure) for axis in sensor.axes)
            out.append(
                NoiseRow(name, figure, unit, axes, sensor.combined(figure), profile_values.get(figure))
            )
    return out


def profile_noise(profile: Profile | None, sensor: str) -> dict[str, float]:
    """Return a profile's density, with quantisation noise added, and walk; empty without a profile."""
    if profile is None:
        return {}
    imu = profile.device.imu
    spec: InertialFacts = imu.gyro if sensor == GYRO else imu.accel
    digits = spec.step**2 / 12 / spec.rate_hz  # uniform within a digit, white
    return {"density": float(np.sqrt(spec.density**2 + digits)), "walk": spec.kalibr_walk}


def imu_chain_yaml(
    characteristics: ImuCharacteristics, name: str, inflate: float, serial: str | None = None
) -> str:
    """Return kalibr_imu_chain.yaml, as `share.recordings.calibration` and Kalibr read it. inflate: factor
    on the estimates. serial: of the device."""
    lines = [
        "%YAML 1.0",  # for OpenCV's FileStorage
        "---",
        f"# share calibrate imu: {name}, {characteristics.rest_s:.0f} s at rest",
        "# " + ("as measured" if inflate == 1 else f"{inflate:g} times what was measured (--inflate)"),
        "imu0:",
    ]
    for sensor, noise in ((ACCEL, characteristics.accel), (GYRO, characteristics.gyro)):
        for figure, key in (("density", "noise_density"), ("walk", "random_walk")):
            estimate, unit = noise.combined(figure), UNITS[sensor][figure]
            value = estimate.conservative * inflate
            lines.append(f"  {sensor}_{key}: {value:.4e}  # {unit}, {_uncertainty_text(estimate)}")
    # quoted, or YAML reads it as a number
    serial_lines = [f"  {SERIAL}: {json.dumps(serial)}"] if serial else []
    lines += [f"  update_rate: {characteristics.rate_hz:.3f}", f"  rostopic: {DEFAULT_TOPICS['imu0']}"]
    return "\n".join([*lines, *serial_lines, ""])


def _uncertainty_text(figure: NoiseEstimate) -> str:
    if figure.significant:
        return f"+- {100 * figure.sigma / figure.value:.1f} %"
    return "upper bound (95 %): not significant in this recording"


def report_values(
    characteristics: ImuCharacteristics, name: str, profile: Profile | None, inflate: float
) -> dict[str, Any]:
    """Return the report as plain data; estimates are without `inflate`."""
    return {
        "source": name,
        "rate_hz": characteristics.rate_hz,
        "rest_s": characteristics.rest_s,
        "rest_start_s": characteristics.start_s,
        "recording_s": characteristics.total_s,
        "samples": characteristics.samples,
        "missing": characteristics.missing,
        "gaps": characteristics.gaps,
        "unbridged_gaps": characteristics.unbridged_gaps,
        "inflate": inflate,
        "profile": profile.name if profile else None,
        "gravity": gravity_norm(characteristics),
        GYRO: _sensor_values(characteristics.gyro, GYRO, profile),
        ACCEL: _sensor_values(characteristics.accel, ACCEL, profile),
    }


def gravity_norm(characteristics: ImuCharacteristics) -> float:
    """Return the norm of the mean specific force, m/s^2."""
    return float(np.linalg.norm(characteristics.accel.mean))


def _sensor_values(sensor: SensorNoise, name: str, profile: Profile | None) -> dict[str, Any]:
    return {
        "unit": UNITS[name]["instability"],
        "mean": sensor.mean.tolist(),
        **{figure: sensor.combined(figure)._asdict() for figure in QUANTITIES},
        "profile": profile_noise(profile, name) or None,
        "tau_s": sensor.curve.taus.tolist(),
        "clusters": sensor.curve.clusters.tolist(),
        "axes": {
            axis: {name: getattr(noise, name)._asdict() for name in (*QUANTITIES, "quantisation")}
            | {name: getattr(noise, name).tolist() for name in ("low", "high", "modelled")}
            | {"deviation": sensor.curve.deviation[:, k].tolist()}
            for k, (axis, noise) in enumerate(zip("xyz", sensor.axes, strict=True))
        },
    }


def draw_allan(path: Path, characteristics: ImuCharacteristics, profile: Profile | None, title: str) -> None:
    """Write a PNG: gyroscope and accelerometer side by side, three axes each."""
    figure, panels = agg_pyplot().subplots(1, 2, figsize=(13, 5.4), layout="constrained")
    for panel, name, sensor in zip(
        panels, (GYRO, ACCEL), (characteristics.gyro, characteristics.accel), strict=True
    ):
        _draw_sensor(panel, sensor)
        _draw_profile(panel, sensor, profile_noise(profile, name), profile)
        panel.set(
            title=name, xlabel="averaging time [s]", ylabel=f"Allan deviation [{UNITS[name]['instability']}]"
        )
        panel.set_xscale("log")
        panel.set_yscale("log")
        for axis in (panel.xaxis, panel.yaxis):  # plain digits: the frozen program has no fonts for powers
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        panel.grid(which="both", alpha=0.25)
        panel.text(0.03, 0.03, _estimates_text(sensor, UNITS[name]), transform=panel.transAxes, fontsize=9)
        panel.legend(fontsize=8, loc="upper right")
    figure.suptitle(title)
    save_png(figure, path, 85)


def _draw_sensor(panel: Any, sensor: SensorNoise) -> None:
    taus = sensor.curve.taus
    for k, (axis, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
        noise = sensor.axes[k]
        panel.fill_between(taus, noise.low, noise.high, color=colour, alpha=0.15, linewidth=0)
        panel.plot(taus, sensor.curve.deviation[:, k], ".", color=colour, markersize=4, label=f"{axis}, 95 %")
        panel.plot(taus, noise.modelled, color=colour, linewidth=1)


def _draw_profile(
    panel: Any, sensor: SensorNoise, profile_values: dict[str, float], profile: Profile | None
) -> None:
    taus = sensor.curve.taus
    estimates = [sensor.combined(name) for name in QUANTITIES]
    N, B, K = (one.value if one.significant else 0.0 for one in estimates)
    for part in (N / np.sqrt(taus), np.full(len(taus), np.sqrt(FLICKER_FACTOR) * B), K * np.sqrt(taus / 3)):
        if part.all():
            panel.plot(taus, part, ":", color="#888", linewidth=1)
    if profile_values and profile:
        line = np.sqrt(profile_values["density"] ** 2 / taus + profile_values["walk"] ** 2 * taus / 3)
        panel.plot(taus, line, "--", color="black", linewidth=1, label=f"profile {profile.name}")
    panel.set_ylim(sensor.curve.deviation.min() / 6, sensor.curve.deviation.max() * 2)


def _estimates_text(sensor: SensorNoise, units: dict[str, str]) -> str:
    lines = []
    for letter, (name, unit) in zip("NBK", units.items(), strict=True):
        estimate = sensor.combined(name)
        lines.append(f"{letter} {'= ' if estimate.significant else ''}{estimate.text} {unit}")
    return "\n".join(lines)
