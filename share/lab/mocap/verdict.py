"""Whether a fit can be believed, and what its recording did not tell."""

from __future__ import annotations

import numpy as np

from share.errors import MisfitError
from share.lab.mocap.fit import Fit
from share.types import F64

MOST_TURN = np.radians(0.1)  # one sigma on the worst axis; more is said
MOST_SHIFT = 0.003  # m, likewise
MOST_DOUBTED = 1 / 3  # of the poses: markers that are swapped for longer leave too little to go by
_SAY_DOUBTED = 0.1
MOST_LEFT = 3.0  # times what was said of the mocap's noise; raw ones come to 0.3, a mirrored one to 3.6
_SAY_LEFT = 1.7
MOST_LONG = 0.1  # of a way along an axis: a mirrored one comes to 1.5 to 2, an accelerometer errs by 0.02
_SAY_LONG = 0.03
_LONG_SIGMAS = 5.0
MOST_STRAYED = 3.0  # sigmas (told twice as wide) of the mounting that was given, on its worst axis
_KNOWN_LONG = 0.05  # one sigma; where less is known, as of a robot's height, errors of the path seem long


def sigmas(fit: Fit) -> F64:
    """(10,) of `fit.cov_shared`: tilt (2) rad, body rotation (3) rad and position (3) m, offset s, drift."""
    return np.asarray(np.sqrt(np.diag(fit.cov_shared)), np.float64)


def check_fit(fit: Fit) -> None:
    """Raises MisfitError for a fit that comes together without telling of one motion, as with a mirrored
    world it may."""
    left = fit.residuals
    if (told := _too_long(fit, MOST_LONG)) is not None:
        raise MisfitError(
            f"mocap and IMU do not tell of one motion: {told}; is an axis mirrored, or a scale or unit wrong?"
        )
    if fit.strayed > MOST_STRAYED:
        raise MisfitError(
            "mocap and IMU do not tell of the mounting that was given (--mounting): the fit leaves it by "
            f"{fit.strayed:.1f} of its sigmas; were markers moved since, or is it another device's? "
            "Calibrate it again"
        )
    if left.doubted > MOST_DOUBTED:
        raise MisfitError(
            f"mocap and IMU do not tell of one motion: {100 * left.doubted:.0f} % of the mocap's poses are "
            "elsewhere; were markers swapped for long (cut there), or is an axis mirrored? "
            "Export as the system shows it"
        )
    if left.position_sigmas > MOST_LEFT:
        raise MisfitError(
            f"mocap and IMU do not tell of one motion: {_noisy(fit)} (--sigma-mm); is an axis mirrored, or a "
            "scale wrong? If the motion capture is so noisy, say so"
        )


def doubts(fit: Fit) -> list[str]:
    """What is not as it should be, each in a line."""
    left, out = fit.residuals, []
    if (told := unsure(fit)) is not None:
        out.append(told)
    if left.doubted > _SAY_DOUBTED:
        out.append(
            f"{100 * left.doubted:.0f} % of the motion capture's poses are elsewhere and do not count; were "
            "its markers swapped?"
        )
    if left.position_sigmas > _SAY_LEFT:
        out.append(f"{_noisy(fit)}; say by --sigma-mm how noisy the motion capture is, or calibrate it anew")
    if (told := _too_long(fit, _SAY_LONG)) is not None:
        out.append(f"{told}; calibrate the motion capture anew, or the accelerometer")
    return out


def unsure(fit: Fit) -> str | None:
    """What the motion did not tell, and what to do about it; None where it told all."""
    sigma = sigmas(fit)
    turn, shift = sigma[2:5].max(), sigma[5:8].max()
    if turn <= MOST_TURN and shift <= MOST_SHIFT:
        return None
    return (
        f"the motion tells the body to {np.degrees(turn):.2f} deg and {shift * 1e3:.1f} mm only (wanted: "
        f"{np.degrees(MOST_TURN):.1f} deg, {MOST_SHIFT * 1e3:.0f} mm); record a minute in which the device "
        "turns about all three axes, by a radian or more each"
    )


def _too_long(fit: Fit, most: float) -> str | None:
    """The axis whose ways are off most; None where none is by more than `most`, and surely so."""
    known = (fit.too_long_sigma < _KNOWN_LONG) & (np.abs(fit.too_long) > _LONG_SIGMAS * fit.too_long_sigma)
    off = np.where(known, np.abs(fit.too_long), 0.0)
    k = int(off.argmax())
    if off[k] <= most:
        return None
    size = f"{100 * off[k]:.1f} ± {100 * fit.too_long_sigma[k]:.1f} %"
    where, way = f"along its {'xyz'[k]} the motion capture", "longer" if fit.too_long[k] > 0 else "shorter"
    if fit.too_long[k] < -1:
        return f"{where} goes the other way than the accelerometer"
    return f"{where}'s ways are {size} {way} than the accelerometer's"


def _noisy(fit: Fit) -> str:
    left = fit.residuals
    return f"{left.position_mm:.1f} mm rms are left, {left.position_sigmas:.1f} times the noise that was said"
