"""The Allan deviation of an IMU as a picture: seen, how sure, fitted, and stated."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from share.calibration.imu import ImuNature, SensorNoise
from share.calibration.noise import FLAT
from share.io.imu_report import ACCEL, GYRO, UNITS, stated
from share.io.profile_types import Profile

_COLOURS = ("#00798c", "#d1495b", "#edae49")


def allan_png(nature: ImuNature, profile: Profile | None, title: str) -> bytes:
    """PNG: gyroscope and accelerometer side by side, three axes each."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(13, 5.4), layout="constrained")
    for panel, name, sensor in zip(panels, (GYRO, ACCEL), (nature.gyro, nature.accel), strict=True):
        _draw(panel, sensor)
        _draw_stated(panel, sensor, stated(profile, name), profile)
        panel.set(
            title=name, xlabel="averaging time [s]", ylabel=f"Allan deviation [{UNITS[name]['instability']}]"
        )
        panel.set_xscale("log")
        panel.set_yscale("log")
        for axis in (panel.xaxis, panel.yaxis):  # in plain digits: the frozen program has no fonts for powers
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        panel.grid(which="both", alpha=0.25)
        panel.text(0.03, 0.03, _figures(sensor, UNITS[name]), transform=panel.transAxes, fontsize=9)
        panel.legend(fontsize=8, loc="upper right")
    figure.suptitle(title)
    out = io.BytesIO()
    figure.savefig(out, dpi=85, format="png")
    pyplot.close(figure)
    return out.getvalue()


def _draw(panel: Any, sensor: SensorNoise) -> None:
    taus = sensor.curve.taus
    for k, (axis, colour) in enumerate(zip("xyz", _COLOURS, strict=True)):
        noise = sensor.axes[k]
        panel.fill_between(taus, noise.low, noise.high, color=colour, alpha=0.15, linewidth=0)
        panel.plot(taus, sensor.curve.deviation[:, k], ".", color=colour, markersize=4, label=f"{axis}, 95 %")
        panel.plot(taus, noise.modelled, color=colour, linewidth=1)


def _draw_stated(panel: Any, sensor: SensorNoise, said: dict[str, float], profile: Profile | None) -> None:
    taus = sensor.curve.taus
    found = [sensor.typical(name) for name in ("density", "instability", "walk")]
    N, B, K = (one.value if one.told else 0.0 for one in found)
    for part in (N / np.sqrt(taus), np.full(len(taus), np.sqrt(FLAT) * B), K * np.sqrt(taus / 3)):
        if part.all():
            panel.plot(taus, part, ":", color="#888", linewidth=1)
    if said and profile:
        line = np.sqrt(said["density"] ** 2 / taus + said["walk"] ** 2 * taus / 3)
        panel.plot(taus, line, "--", color="black", linewidth=1, label=f"profile {profile.name}")
    panel.set_ylim(sensor.curve.deviation.min() / 6, sensor.curve.deviation.max() * 2)


def _figures(sensor: SensorNoise, units: dict[str, str]) -> str:
    lines = []
    for letter, (name, unit) in zip("NBK", units.items(), strict=True):
        found = sensor.typical(name)
        lines.append(f"{letter} {'= ' if found.told else ''}{found.text} {unit}")
    return "\n".join(lines)
