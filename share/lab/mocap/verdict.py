"""Whether a fit can be believed, and what its recording did not tell."""

from __future__ import annotations

import numpy as np

from share.errors import CalibrationMismatchError
from share.lab.mocap.fit import MocapFit
from share.types import F64

MAX_ROTATION_SIGMA = np.radians(0.1)  # one sigma on the worst axis; more is said
MAX_TRANSLATION_SIGMA = 0.003  # m, likewise
MAX_OUTLIER_SHARE = 1 / 3  # of the poses: markers that are swapped for longer leave too little to go by
_WARN_OUTLIER_SHARE = 0.1
MAX_RESIDUAL_RATIO = (
    3.0  # times what was said of the mocap's noise; raw ones come to 0.3, a mirrored one to 3.6
)
_WARN_RESIDUAL_RATIO = 1.7
MAX_SCALE_ERROR = (
    0.1  # of a way along an axis: a mirrored one comes to 1.5 to 2, an accelerometer errs by 0.02
)
_WARN_SCALE_ERROR = 0.03
_SCALE_ERROR_SIGMAS = 5.0
MAX_MOUNTING_PRIOR_SIGMAS = (
    3.0  # sigmas (told twice as wide) of the mounting that was given, on its worst axis
)
_MAX_SCALE_SIGMA = (
    0.05  # one sigma; where less is known, as of a robot's height, errors of the path seem long
)


def shared_sigmas(fit: MocapFit) -> F64:
    """(10,) of `fit.cov_shared`: tilt (2) rad, body rotation (3) rad and position (3) m, offset s, drift."""
    return np.asarray(np.sqrt(np.diag(fit.cov_shared)), np.float64)


def check_fit(fit: MocapFit) -> None:
    """Raises MisfitError for a fit that comes together without telling of one motion, as with a mirrored
    world it may."""
    fit_residuals = fit.residuals
    if (scale_text := _scale_error_text(fit, MAX_SCALE_ERROR)) is not None:
        raise CalibrationMismatchError(
            f"mocap and IMU do not tell of "
            f"one motion: {scale_text}; "
            f"is an axis mirrored, or a scale or unit wrong?"
        )
    if fit.mounting_prior_sigmas > MAX_MOUNTING_PRIOR_SIGMAS:
        raise CalibrationMismatchError(
            "mocap and IMU do not tell of the mounting that was given (--mounting): the fit leaves it by "
            f"{fit.mounting_prior_sigmas:.1f} "
            f"of its sigmas; were "
            f"markers moved since, or is it another device's? "
            "Calibrate it again"
        )
    if fit_residuals.doubted > MAX_OUTLIER_SHARE:
        raise CalibrationMismatchError(
            f"mocap and IMU do not tell of one motion: "
            f"{100 * fit_residuals.doubted:.0f} "
            f"% of the mocap's poses are "
            "elsewhere; were markers swapped for long (cut there), or is an axis mirrored? "
            "Export as the system shows it"
        )
    if fit_residuals.position_sigmas > MAX_RESIDUAL_RATIO:
        raise CalibrationMismatchError(
            f"mocap and IMU do not tell of one motion: "
            f"{_residual_text(fit)} (--sigma-mm); "
            f"is an axis mirrored, or a "
            "scale wrong? If the motion capture is so noisy, say so"
        )


def fit_warnings(fit: MocapFit) -> list[str]:
    """What is not as it should be, each in a line."""
    fit_residuals, out = fit.residuals, []
    if (text := mounting_warning(fit)) is not None:
        out.append(text)
    if fit_residuals.doubted > _WARN_OUTLIER_SHARE:
        out.append(
            f"{100 * fit_residuals.doubted:.0f} % of the motion "
            f"capture's poses are elsewhere "
            f"and do not count; were "
            "its markers swapped?"
        )
    if fit_residuals.position_sigmas > _WARN_RESIDUAL_RATIO:
        out.append(
            f"{_residual_text(fit)}; say by --sigma-mm how noisy the motion capture is, or calibrate it anew"
        )
    if (text := _scale_error_text(fit, _WARN_SCALE_ERROR)) is not None:
        out.append(f"{text}; calibrate the motion capture anew, or the accelerometer")
    return out


def mounting_warning(fit: MocapFit) -> str | None:
    """What the motion did not tell, and what to do about it; None where it told all."""
    sigma = shared_sigmas(fit)
    rotation_sigma, translation_sigma = sigma[2:5].max(), sigma[5:8].max()
    if rotation_sigma <= MAX_ROTATION_SIGMA and translation_sigma <= MAX_TRANSLATION_SIGMA:
        return None
    return (
        f"the motion tells the body to "
        f"{np.degrees(rotation_sigma):.2f} "
        f"deg and {translation_sigma * 1e3:.1f} mm only (wanted: "
        f"{np.degrees(MAX_ROTATION_SIGMA):.1f} deg, "
        f"{MAX_TRANSLATION_SIGMA * 1e3:.0f} mm); "
        f"record a minute in which the device "
        "turns about all three axes, by a radian or more each"
    )


def _scale_error_text(fit: MocapFit, max_error: float) -> str | None:
    """The axis whose ways are off most; None where none is by more than `max_error`, and surely so."""
    is_significant = (fit.scale_error_sigma < _MAX_SCALE_SIGMA) & (
        np.abs(fit.scale_error) > _SCALE_ERROR_SIGMAS * fit.scale_error_sigma
    )
    errors = np.where(is_significant, np.abs(fit.scale_error), 0.0)
    k = int(errors.argmax())
    if errors[k] <= max_error:
        return None
    size = f"{100 * errors[k]:.1f} ± {100 * fit.scale_error_sigma[k]:.1f} %"
    where, direction = (
        f"along its {'xyz'[k]} the motion capture",
        "longer" if fit.scale_error[k] > 0 else "shorter",
    )
    if fit.scale_error[k] < -1:
        return f"{where} goes the other way than the accelerometer"
    return f"{where}'s ways are {size} {direction} than the accelerometer's"


def _residual_text(fit: MocapFit) -> str:
    fit_residuals = fit.residuals
    return (
        f"{fit_residuals.position_mm:.1f} mm rms are left, "
        f"{fit_residuals.position_sigmas:.1f} "
        f"times the noise that was said"
    )
