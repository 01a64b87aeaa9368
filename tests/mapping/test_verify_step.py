"""Where features leave a pose uncertain, the images decide, unless gravity contradicts."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import textured_planes
from helpers.textured_planes import T_BODY_CAM, Planes

from share.geometry import se3
from share.mapping import steps
from share.mapping.recognition.verification import CameraView, Refusal, Verification
from share.mapping.steps import VerifyStep
from share.types import View

T_WORLD_C = se3.inverse(T_BODY_CAM)
T_WORLD_Q = se3.exp(np.array([0.05, 0.12, 0.03, 0.15, -0.05, 0.1])) @ T_WORLD_C
T_C_Q = se3.inverse(T_WORLD_C) @ T_WORLD_Q


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0])
def test_images_find_a_pose_that_features_leave_uncertain(
    tilt_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    room, rng = (
        Planes([[0.1, 0.05, 0.4], [-0.6, 0.0, 0.3], [0.0, 0.7, 0.25]], seed=3),
        np.random.default_rng(1),
    )
    query, candidate = (textured_planes.image_view(room, T, rng) for T in (T_WORLD_Q, T_WORLD_C))
    tilt = se3.so3_exp(np.array([np.radians(tilt_deg), 0.0, 0.0]))
    up = [R @ np.array([0.0, 0.0, 1.0]) for R in (T_WORLD_Q[:3, :3].T @ tilt, T_WORLD_C[:3, :3].T)]
    views = [CameraView(View.empty(), 400.0, T_BODY_CAM, one) for one in up]
    unsure = Refusal("pose uncertain", (T_C_Q @ se3.exp(np.full(6, 0.005)),))
    monkeypatch.setattr(steps, "verify", lambda *_: unsure)
    found = VerifyStep(1, views[0], 0, views[1], query, candidate).run()
    if tilt_deg:
        assert found is unsure
    else:
        assert isinstance(found, Verification)
        assert np.abs(se3.log(se3.inverse(T_C_Q) @ found.T_c_q)).max() < 0.002
    assert VerifyStep(1, views[0], 0, views[1]).run() is unsure
