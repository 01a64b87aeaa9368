"""Check a fit of motion capture and IMU, and warn about what its recording did not determine."""

from __future__ import annotations

import numpy as np

from share.errors import CalibrationMismatchError
from share.lab.mocap.fit import MocapFit
from share.types import F64

MAX_ROTATION_SIGMA = np.radians(0.1)  # one sigma on the worst axis; a warning above
MAX_TRANSLATION_SIGMA = 0.003  # m, likewise
MAX_OUTLIER_SHARE = 1 / 3  # of the poses; markers swapped for longer leave too few
_WARN_OUTLIER_SHARE = 0.1
MAX_RESIDUAL_RATIO = 3.0  # times the stated mocap noise; raw mocap has 0.3, a mirrored one 3.6
_WARN_RESIDUAL_RATIO = 1.7
MAX_SCALE_ERROR = 0.1  # a mirrored axis has 1.5 to 2, an accelerometer 0.02
_WARN_SCALE_ERROR = 0.03
_SCALE_ERROR_SIGMAS = 5.0
MAX_MOUNTING_PRIOR_SIGMAS = 3.0  # sigmas (doubled, see `read_mounting`) of the given mounting, worst axis
_MAX_SCALE_SIGMA = 0.05  # above, as for a robot's height, the scale is not determined


def shared_sigmas(fit: MocapFit) -> F64:
    """Return the sigmas (10,) of `fit.cov_shared`: tilt (2) rad, body rotation (3) rad and position (3) m,
    offset s, drift."""
    return np.asarray(np.sqrt(np.diag(fit.cov_shared)), np.float64)


def check_fit(fit: MocapFit) -> None:
    """Raise CalibrationMismatchError for a fit that converged although mocap and IMU are not of one
    motion, as may happen with a mirrored world."""
    residuals = fit.residuals
    if (scale_text := _scale_error_text(fit, MAX_SCALE_ERROR)) is not None:
        raise CalibrationMismatchError(
            f"mocap and IMU are not of one motion: {scale_text}; is an axis mirrored, or a scale or unit "
            "wrong?"
        )
    if fit.mounting_prior_sigmas > MAX_MOUNTING_PRIOR_SIGMAS:
        raise CalibrationMismatchError(
            "mocap and IMU contradict the given mounting (--mounting): the fit differs from it by "
            f"{fit.mounting_prior_sigmas:.1f} of its sigmas; were markers moved since, or is it another "
            "device's? Calibrate it again"
        )
    if residuals.outlier_share > MAX_OUTLIER_SHARE:
        raise CalibrationMismatchError(
            f"mocap and IMU are not of one motion: {100 * residuals.outlier_share:.0f} % of the mocap's "
            "poses are outliers; were markers swapped for long (cut there), or is an axis mirrored? Export "
            "as the system shows it"
        )
    if residuals.position_sigmas > MAX_RESIDUAL_RATIO:
        raise CalibrationMismatchError(
            f"mocap and IMU are not of one motion: {_residual_text(fit)}; is an axis mirrored, or a scale "
            "wrong? If the motion capture is that noisy, raise --sigma-mm"
        )


def fit_warnings(fit: MocapFit) -> list[str]:
    """Return warnings, a line each."""
    residuals, out = fit.residuals, []
    if (text := mounting_warning(fit)) is not None:
        out.append(text)
    if residuals.outlier_share > _WARN_OUTLIER_SHARE:
        out.append(
            f"{100 * residuals.outlier_share:.0f} % of the motion capture's poses are outliers and not used; "
            "were its markers swapped?"
        )
    if residuals.position_sigmas > _WARN_RESIDUAL_RATIO:
        out.append(
            f"{_residual_text(fit)}; set --sigma-mm to the motion capture's noise, or calibrate it again"
        )
    if (text := _scale_error_text(fit, _WARN_SCALE_ERROR)) is not None:
        out.append(f"{text}; calibrate the motion capture again, or the accelerometer")
    return out


def mounting_warning(fit: MocapFit) -> str | None:
    """Return what the motion did not determine, and what to do; None where it determined all."""
    sigma = shared_sigmas(fit)
    rotation_sigma, translation_sigma = sigma[2:5].max(), sigma[5:8].max()
    if rotation_sigma <= MAX_ROTATION_SIGMA and translation_sigma <= MAX_TRANSLATION_SIGMA:
        return None
    return (
        f"the motion determines the mounting to {np.degrees(rotation_sigma):.2f} deg and "
        f"{translation_sigma * 1e3:.1f} mm only ({np.degrees(MAX_ROTATION_SIGMA):.1f} deg and "
        f"{MAX_TRANSLATION_SIGMA * 1e3:.0f} mm needed); record a minute in which the device turns about all "
        "three axes, by a radian or more each"
    )


def _scale_error_text(fit: MocapFit, max_error: float) -> str | None:
    """Describe the axis with the largest scale error; None where none is significant and above
    `max_error`."""
    is_significant = (fit.scale_error_sigma < _MAX_SCALE_SIGMA) & (
        np.abs(fit.scale_error) > _SCALE_ERROR_SIGMAS * fit.scale_error_sigma
    )
    errors = np.where(is_significant, np.abs(fit.scale_error), 0.0)
    k = int(errors.argmax())
    if errors[k] <= max_error:
        return None
    size = f"{100 * errors[k]:.1f} ± {100 * fit.scale_error_sigma[k]:.1f} %"
    where = f"along its {'xyz'[k]} axis the motion capture"
    direction = "longer" if fit.scale_error[k] > 0 else "shorter"
    if fit.scale_error[k] < -1:
        return f"{where} moves opposite to the accelerometer"
    return f"{where}'s paths are {size} {direction} than the accelerometer's"


def _residual_text(fit: MocapFit) -> str:
    residuals = fit.residuals
    return (
        f"{residuals.position_mm:.1f} mm rms residual, {residuals.position_sigmas:.1f} times the stated noise"
    )
