"""Where a headset's own tracking sits on a device: hand-eye of two trackers on one head, with their clocks.

Both are of one rigid body, each drifts in a world of its own. So their motions over a second are compared
(A X = X B, `handeye`), at a time offset that is estimated with the mount: rotation shows the offset, turning
about two axes the lever arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.lab.calibrate import handeye
from share.lab.mocap.offset import correlate_rotations, mocap_rotations
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.mocap.verdict import MAX_ROTATION_SIGMA, MAX_TRANSLATION_SIGMA
from share.types import F64

MAX_OFFSET_SIGMA_S = 0.002
_MAX_ROTATION_RMS = np.radians(1.0)  # of motions over a second; trackers of one head differ by 0.2 deg
_MAX_TRANSLATION_RMS = 0.03  # m; likewise 5 mm
_MIN_DURATION_S = 15.0
_ITERATIONS = 10
_DERIVATIVE_NS = 2_000_000  # of the headset's poses by time, from differences
_MOVED_SIGMAS = 5.0  # Mahalanobis distance of two halves; the sigmas are wide (NEES 0.5)
_MOVED_ROTATION, _MOVED_TRANSLATION = np.radians(0.3), 0.005  # less than that hurts nobody


@dataclass(frozen=True, eq=False)
class HeadsetMount:
    """T_body_viewer (4, 4): p_body = T_body_viewer p_viewer; offset_ns: device's clock less headset's.

    cov (7, 7): rotation rad and translation m on the right, offset s. rotation_rms_by_axis (3,): of the
    motions about their principal axes, rad. rotation_rms rad, translation_rms m: what motions over a second
    differ by.
    """

    T_body_viewer: F64
    offset_ns: int
    cov: F64
    rotation_rms_by_axis: F64
    rotation_rms: float
    translation_rms: float
    motions: int
    duration_s: float

    @property
    def sigmas(self) -> F64:
        """Rotation (3) rad, translation (3) m, offset s."""
        return np.asarray(np.sqrt(np.diag(self.cov)), np.float64)


def fit_mount(device: MocapTrajectory, headset: MocapTrajectory) -> HeadsetMount:
    """Fit the mount to poses of the device's body and of the headset's viewer, each in its own world and
    clock.

    Raises DataError for less than 15 s in common and for a head that turned about one axis only,
    CalibrationMismatchError where both are not of one head.
    """
    peak = correlate_rotations(
        mocap_rotations(device), mocap_rotations(headset), None, (headset.source, device.source)
    )
    mount = _fit_at(device, headset, peak.offset_ns)
    if mount.duration_s < _MIN_DURATION_S:
        raise DataError(
            f"{device.source} and {headset.source} have {mount.duration_s:.0f} s in common, "
            f"{_MIN_DURATION_S:.0f} are needed; record half a minute"
        )
    if mount.rotation_rms > _MAX_ROTATION_RMS or mount.translation_rms > _MAX_TRANSLATION_RMS:
        raise CalibrationMismatchError(
            f"{device.source} and {headset.source} are not of one head: motions over a second differ by "
            f"{np.degrees(mount.rotation_rms):.1f} deg and {mount.translation_rms * 1e3:.0f} mm; is the "
            "camera loose, one of both lost, or a file in other axes?"
        )
    return mount


def _fit_at(device: MocapTrajectory, headset: MocapTrajectory, offset_ns: int) -> HeadsetMount:
    """Fit mount and offset from an offset that is right to some milliseconds."""
    stamps = device.stamps_ns[headset.shifted(offset_ns).is_covered(device.stamps_ns)]
    first, last = handeye.motion_ends(stamps)
    A = handeye.relative_motions(device.interpolate(stamps), first, last)

    def viewer_motions(offset_s: float) -> F64:
        at = stamps - offset_ns - round(offset_s * 1e9)
        return handeye.relative_motions(headset.interpolate(at), first, last)

    initial = handeye.hand_eye(A, viewer_motions(0.0))
    X, offset_s, step_s = initial.T_a_b, 0.0, _DERIVATIVE_NS * 1e-9
    for _ in range(_ITERATIONS):
        B = viewer_motions(offset_s)
        ahead, behind = (
            handeye.motion_residuals(A, viewer_motions(offset_s + sign * step_s), X) for sign in (1, -1)
        )
        J = np.concatenate([handeye.motion_jacobian(B), ((ahead - behind) / (2 * step_s))[..., None]], axis=2)
        step, cov, rms = handeye.robust_step(handeye.motion_residuals(A, B, X), J)
        X, offset_s = X @ se3.exp(step[:6]), offset_s + float(step[6])
    return HeadsetMount(
        X,
        offset_ns + round(offset_s * 1e9),
        cov * handeye.overlap_factor(stamps),
        initial.rotation_rms_by_axis,
        *rms,
        len(A),
        float(stamps[-1] - stamps[0]) * 1e-9,
    )


def mount_warnings(mount: HeadsetMount) -> list[str]:
    """Return what the motion did not determine, and what to do; a line each."""
    rotation, translation, offset = mount.sigmas[:3].max(), mount.sigmas[3:6].max(), mount.sigmas[6]
    advice = (
        "record half a minute in which the wearer nods, tilts the head to both sides and looks around, by "
        "half a radian or more each"
    )
    out = []
    if rotation > MAX_ROTATION_SIGMA or translation > MAX_TRANSLATION_SIGMA or offset > MAX_OFFSET_SIGMA_S:
        out.append(
            f"the motion determines the mount to {np.degrees(rotation):.2f} deg, {translation * 1e3:.1f} mm "
            f"and {offset * 1e3:.1f} ms only ({np.degrees(MAX_ROTATION_SIGMA):.1f} deg, "
            f"{MAX_TRANSLATION_SIGMA * 1e3:.0f} mm and {MAX_OFFSET_SIGMA_S * 1e3:.0f} ms needed); {advice}"
        )
    least = mount.rotation_rms_by_axis[2]
    if least < handeye.MIN_ROTATION_RAD:
        out.append(
            f"about one axis the head turned by {np.degrees(least):.1f} deg rms within a second, "
            f"{np.degrees(handeye.MIN_ROTATION_RAD):.0f} are needed: drift of either tracker tilts the "
            f"mount; {advice}"
        )
    return out


def moved_warning(device: MocapTrajectory, headset: MocapTrajectory, mount: HeadsetMount) -> str | None:
    """Return a warning if the two halves of the recording contradict each other: the mount is loose."""
    middle = (device.stamps_ns[0] + device.stamps_ns[-1]) // 2
    try:
        early, late = (
            _fit_at(half, headset, mount.offset_ns)
            for half in (device.between(0, middle), device.between(middle, int(device.stamps_ns[-1])))
        )
    except DataError:  # a half in which the head hardly turned
        return None
    moved = se3.log(se3.inverse(early.T_body_viewer) @ late.T_body_viewer)
    rotation, translation = np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])
    sigmas = np.sqrt(moved @ np.linalg.solve((early.cov + late.cov)[:6, :6], moved))
    if sigmas < _MOVED_SIGMAS or (rotation < _MOVED_ROTATION and translation < _MOVED_TRANSLATION):
        return None
    return (
        f"the mount moved by {np.degrees(rotation):.1f} deg and {translation * 1e3:.0f} mm between the "
        f"halves of the recording ({sigmas:.0f} sigmas); fix the camera, and repeat"
    )
