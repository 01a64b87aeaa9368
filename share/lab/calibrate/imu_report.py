"""What `share calibrate imu` leaves behind: Kalibr's IMU chain, and all that was found as JSON."""

from __future__ import annotations

import io
import json
from typing import Any, NamedTuple

import numpy as np

from share.lab.calibrate.imu import ImuNature, SensorNoise
from share.lab.calibrate.imu_noise import FLAT, AxisNoise, Figure
from share.recordings.calibration import SERIAL
from share.sensors.profile_types import Inertial, Profile

GYRO, ACCEL = "gyroscope", "accelerometer"
FIGURES = ("density", "instability", "walk")
UNITS = {
    GYRO: dict(zip(FIGURES, ("rad/s/sqrt(Hz)", "rad/s", "rad/s^2/sqrt(Hz)"), strict=True)),
    ACCEL: dict(zip(FIGURES, ("m/s^2/sqrt(Hz)", "m/s^2", "m/s^3/sqrt(Hz)"), strict=True)),
}
STANDARD_GRAVITY = 9.80665


class Row(NamedTuple):
    """One figure of one sensor: of each axis, of all as one, and as the profile has it, if it does."""

    sensor: str
    figure: str
    unit: str
    axes: tuple[Figure, ...]
    together: Figure
    stated: float | None

    @property
    def ratio(self) -> float | None:
        """How many times the stated; None where one of the two is not known."""
        return self.together.value / self.stated if self.stated and self.together.told else None


def rows(nature: ImuNature, profile: Profile | None) -> list[Row]:
    """N, B and K of the gyroscope and of the accelerometer."""
    out = []
    for name, sensor in ((GYRO, nature.gyro), (ACCEL, nature.accel)):
        said = stated(profile, name)
        for figure, unit in UNITS[name].items():
            axes = tuple(getattr(axis, figure) for axis in sensor.axes)
            out.append(Row(name, figure, unit, axes, sensor.typical(figure), said.get(figure)))
    return out


def stated(profile: Profile | None, sensor: str) -> dict[str, float]:
    """density, with what its digits add, and walk by a profile; nothing without one."""
    if profile is None:
        return {}
    imu = profile.device.imu
    facts: Inertial = imu.gyro if sensor == GYRO else imu.accel
    digits = facts.step**2 / 12 / facts.rate_hz  # evenly spread within a digit, as white as the samples
    return {"density": float(np.sqrt(facts.density**2 + digits)), "walk": facts.kalibr_walk}


def kalibr_text(nature: ImuNature, name: str, inflate: float, serial: str | None = None) -> str:
    """kalibr_imu_chain.yaml, as `share.recordings.calibration` and Kalibr read it. inflate: times the
    measured; serial: of the device."""
    lines = [
        f"# share calibrate imu: {name}, {nature.rest_s:.0f} s at rest",
        "# " + ("as measured" if inflate == 1 else f"{inflate:g} times what was measured (--inflate)"),
        "imu0:",
    ]
    for sensor, noise in ((ACCEL, nature.accel), (GYRO, nature.gyro)):
        for figure, key in (("density", "noise_density"), ("walk", "random_walk")):
            found, unit = noise.typical(figure), UNITS[sensor][figure]
            lines.append(f"  {sensor}_{key}: {found.cautious * inflate:.4e}  # {unit}, {_how(found)}")
    of = [f"  {SERIAL}: {json.dumps(serial)}"] if serial else []  # quoted, or YAML makes it a number
    return "\n".join([*lines, f"  update_rate: {nature.rate_hz:.3f}", *of, ""])


def _how(figure: Figure) -> str:
    if figure.told:
        return f"+- {100 * figure.sigma / figure.value:.1f} %"
    return "an upper bound (95 %): the recording does not tell it"


def to_json(nature: ImuNature, name: str, profile: Profile | None, inflate: float) -> dict[str, Any]:
    """All of it. Figures are as measured, without `inflate`."""
    return {
        "source": name,
        "rate_hz": nature.rate_hz,
        "rest_s": nature.rest_s,
        "rest_start_s": nature.start_s,
        "recording_s": nature.total_s,
        "samples": nature.samples,
        "missing": nature.missing,
        "gaps": nature.gaps,
        "cuts": nature.cuts,
        "inflate": inflate,
        "profile": profile.name if profile else None,
        "gravity": gravity(nature),
        GYRO: _sensor(nature.gyro, GYRO, profile),
        ACCEL: _sensor(nature.accel, ACCEL, profile),
    }


def gravity(nature: ImuNature) -> float:
    """Norm of the mean specific force, m/s^2."""
    return float(np.linalg.norm(nature.accel.mean))


def _sensor(sensor: SensorNoise, name: str, profile: Profile | None) -> dict[str, Any]:
    return {
        "unit": UNITS[name]["instability"],
        "mean": sensor.mean.tolist(),
        **{figure: sensor.typical(figure)._asdict() for figure in FIGURES},
        "profile": stated(profile, name) or None,
        "tau_s": sensor.curve.taus.tolist(),
        "clusters": sensor.curve.clusters.tolist(),
        "axes": {
            axis: {**_axis(noise), "deviation": sensor.curve.deviation[:, k].tolist()}
            for k, (axis, noise) in enumerate(zip("xyz", sensor.axes, strict=True))
        },
    }


def _axis(noise: AxisNoise) -> dict[str, Any]:
    figures = {name: getattr(noise, name)._asdict() for name in (*FIGURES, "quantisation")}
    return figures | {key: getattr(noise, key).tolist() for key in ("low", "high", "modelled")}


# ---- The Allan deviation of an IMU as a picture: seen, how sure, fitted, and stated.

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
