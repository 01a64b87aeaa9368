"""The residuals of a camera-IMU calibration over time, as a picture."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from share.calibration.camera_imu.fit import Fit
from share.calibration.corners import kept
from share.types import F64, I64

_COLOURS = ("#00798c", "#d1495b", "#edae49")


def residual_png(fit: Fit, title: str) -> bytes:
    """PNG: RMS of each picture's corners that were kept, and the residuals of gyroscope and accelerometer
    with three sigmas of what they are said to have."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(3, 1, figsize=(12, 8), layout="constrained", sharex=True)
    _draw_corners(panels[0], fit)
    t = _seconds(fit, fit.imu.stamps_ns)
    _draw_inertial(panels[1], t, fit.gyro, fit.stated.gyro, "gyroscope, rad/s")
    _draw_inertial(panels[2], t, fit.accel, fit.stated.accel, "accelerometer, m/s²")
    panels[2].set_xlabel("s")
    figure.suptitle(title)
    out = io.BytesIO()
    figure.savefig(out, dpi=75, format="png")
    pyplot.close(figure)
    return out.getvalue()


def _seconds(fit: Fit, stamps_ns: I64) -> F64:
    return np.asarray((stamps_ns - fit.state.curve.start_ns) * 1e-9, np.float64)


def _draw_corners(panel: Any, fit: Fit) -> None:
    t = _seconds(fit, fit.sights.stamps_ns) + fit.shift_s
    for eye, (r, seen) in enumerate(zip(fit.corners, fit.sights.corners, strict=True)):
        inside = kept(r, fit.sigmas.px)
        frames, size = seen.frame[inside], len(t)
        count = np.bincount(frames, minlength=size)
        rms = np.sqrt(np.bincount(frames, (r[inside] ** 2).sum(axis=1), size) / np.maximum(count, 1))
        panel.plot(t[count > 0], rms[count > 0], ".", markersize=3, color=_COLOURS[eye], label=f"cam{eye}")
    panel.set(ylabel="px", ylim=(0, None), title="corners, RMS of each picture")
    panel.legend(loc="upper right", fontsize=8)
    panel.grid(alpha=0.3)


def _draw_inertial(panel: Any, t: F64, residuals: F64, stated: float, title: str) -> None:
    for k, axis in enumerate("xyz"):
        panel.plot(t, residuals[:, k], ".", markersize=1, color=_COLOURS[k], label=axis)
    for side in (-3, 3):
        panel.axhline(side * stated, color="black", linewidth=1, linestyle="--")
    rms = float(np.sqrt((residuals**2).mean())) / stated
    panel.set(title=f"{title}: {rms:.2f} times the stated noise (dashed: three sigmas of that)")
    panel.legend(loc="upper right", fontsize=8, markerscale=6)
    panel.grid(alpha=0.3)
