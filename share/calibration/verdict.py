"""Whether a calibration may be believed, and why not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.calibration import corners
from share.calibration.bundle import LEAST_VIEWS, Solution, View
from share.calibration.coverage import Coverage
from share.calibration.epipolar import typical_miss
from share.calibration.projection import intrinsics
from share.types import F64

_WRONG_SHARE = 0.05
_OUTLYING = 5.0  # times the spread of the views' RMS
_MAD = 1.4826


@dataclass(frozen=True)
class Limits:
    """What passes. rms_px: of the corners that are kept; focal: sigma over focal length; covered: of the
    image's cells; views: at least; pair_px: from epipolar lines."""

    rms_px: float = 0.5
    pair_px: float = 0.3
    focal: float = 2e-3
    covered: float = 0.6
    views: int = 12


@dataclass(frozen=True, eq=False)
class Verdict:
    """reasons: what fails, none where it passes; rms_px: of each camera, of the corners kept; rms_all_px: of
    all; wrong: how many were not kept; view_rms (V, cameras) px, NaN where a camera saw nothing, and which
    of these are outlying; pair_px: that half of what both cameras saw lies from its epipolar lines, None of
    one."""

    reasons: tuple[str, ...]
    rms_px: tuple[float, ...]
    rms_all_px: tuple[float, ...]
    wrong: tuple[int, ...]
    view_rms: F64
    outlying: NDArray[np.bool_]
    pair_px: float | None

    @property
    def outliers(self) -> tuple[int, ...]:
        """Rows of views that outlie in any camera."""
        return tuple(np.flatnonzero(self.outlying.any(axis=1)).tolist())

    @property
    def passed(self) -> bool:
        return not self.reasons


def judge(
    solution: Solution,
    covers: Sequence[Coverage],
    pairs: Sequence[View] = (),
    limits: Limits = Limits(),
) -> Verdict:
    """Of a solution and what each camera's views cover. pairs: all views in which two cameras saw the board,
    also those that had no part in the solution."""
    eyes = range(len(solution.state.cameras))
    view_rms = np.array([[corners.rms(view[eye]) for eye in eyes] for view in solution.residuals])
    told = [residuals(solution, eye) for eye in eyes]
    inside = [corners.kept(r, solution.sigma_px) for r in told]
    rms = tuple(corners.rms(r[k]) for r, k in zip(told, inside, strict=True))
    rms_all = tuple(corners.rms(r) for r in told)
    wrong = tuple(int((~k).sum()) for k in inside)
    lost = [corners.lost(r, solution.sigma_px, limits.rms_px) for r in told]
    reasons = [reason for eye in eyes for reason in _reasons(solution, eye, rms[eye], lost[eye], limits)]
    for eye, cover in enumerate(covers):
        if cover.share < limits.covered:
            reasons.append(
                f"cam{eye}: corners in {cover.share:.0%} of the image, {limits.covered:.0%} needed; "
                + "; ".join(cover.missing)
            )
    state = solution.state
    two = len(eyes) == 2
    pair = typical_miss(state.cameras[0], state.cameras[1], state.T_cam1_cam0, pairs) if two else None
    if pair is not None and not pair <= limits.pair_px:
        reasons.append(
            f"the pair: half of the corners are {pair:.2f} px or more off their epipolar lines, at most "
            f"{limits.pair_px:g}: do both cameras expose at once, is one loose?"
        )
    return Verdict(tuple(reasons), rms, rms_all, wrong, view_rms, _outlying(view_rms), pair)


def _reasons(solution: Solution, eye: int, rms: float, lost: int, limits: Limits) -> list[str]:
    views = sum(len(view[eye]) > 0 for view in solution.residuals)
    corners = sum(len(view[eye]) for view in solution.residuals)
    begin = solution.state.parts[eye].start
    part = slice(begin, begin + 2)
    loose = float((solution.sigmas[part] / intrinsics(solution.state.cameras[eye])[:2]).max())
    out = []
    if views < max(limits.views, LEAST_VIEWS):
        out.append(f"cam{eye}: {views} views, {limits.views} needed")
    if not rms <= limits.rms_px:
        out.append(
            f"cam{eye}: {rms:.2f} px RMS, at most {limits.rms_px:g}: blur, a bent board or a wrong --target"
        )
    if lost > _WRONG_SHARE * corners:
        out.append(
            f"cam{eye}: {lost} of {corners} corners do not fit within {limits.rms_px:g} px, at most "
            f"{_WRONG_SHARE:.0%}"
        )
    if not loose <= limits.focal:
        out.append(
            f"cam{eye}: focal length known to {loose:.2%}, {limits.focal:.2%} needed: tilt the board more"
        )
    return out


def residuals(solution: Solution, eye: int) -> F64:
    """(N, 2) px of a camera, over all views."""
    return np.concatenate([view[eye] for view in solution.residuals])


def _outlying(view_rms: F64) -> NDArray[np.bool_]:
    """Whose RMS (V, cameras) is beyond median + 5 MAD of a camera's."""
    middle = np.nanmedian(view_rms, axis=0)
    spread = _MAD * np.nanmedian(np.abs(view_rms - middle), axis=0)
    return np.asarray(view_rms > middle + _OUTLYING * spread)
