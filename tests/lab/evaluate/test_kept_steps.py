"""Mapping steps of the same content are run once; others are not taken for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from share.geometry.camera import Camera
from share.lab.evaluate.kept_steps import KeptSteps, content_digest
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView
from share.mapping.steps import DescribeStep, QueryStep, VerifyStep
from share.types import KeyframeImage, View

CAMERA = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)


def view(seed: int) -> CameraView:
    rng = np.random.default_rng(seed)
    seen = View(rng.normal(size=(30, 2)), rng.normal(size=(30, 3)), rng.integers(0, 256, (30, 32), np.uint8))
    return CameraView(seen, 40.0, np.eye(4), np.array([0.0, 0.0, 1.0]))


def image(seed: int) -> ImageView:
    rng = np.random.default_rng(seed)
    facing = np.column_stack([np.zeros((3, 2)), rng.uniform(0.2, 1, 3)])
    surfaces = rng.normal(size=(3, 2)), facing, rng.uniform(0, 0.1, 3)
    return ImageView(KeyframeImage(rng.integers(0, 256, 60).astype(np.uint8), *surfaces), CAMERA, np.eye(4))


def test_a_step_of_the_same_content_is_run_once(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, run = KeptSteps(), VerifyStep.run
    runs = [0]

    def counted(step: VerifyStep) -> object:
        runs[0] += 1
        return run(step)

    monkeypatch.setattr(VerifyStep, "run", counted)
    first = kept.run(VerifyStep(1, view(1), 2, view(2), image(1), image(2)))
    again = kept.run(VerifyStep(7, view(1), 9, view(2), image(1), image(2)))  # other agents', the same walk
    assert again is first and runs == [1] and (kept.asked, kept.found) == (2, 1)
    assert repr(first) == repr(run(VerifyStep(1, view(1), 2, view(2), image(1), image(2))))
    for other in (
        VerifyStep(1, view(2), 2, view(1), image(1), image(2)),
        VerifyStep(1, view(1), 2, view(2)),
        VerifyStep(1, view(1), 2, view(2), image(1), image(3)),
        VerifyStep(1, replace(view(1), up=np.zeros(3)), 2, view(2), image(1), image(2)),
    ):
        kept.run(other)
    assert runs == [5] and kept.found == 1


def test_what_depends_on_the_map_is_always_run() -> None:
    kept, index = KeptSteps(), PlaceIndex()
    assert kept.run(QueryStep(index, 1, view(1), 5, ())) == []
    assert (kept.asked, kept.found) == (0, 0)


def test_features_are_found_once_and_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("share.lab.evaluate.kept_steps._KEPT", {"describe": 2})
    kept = KeptSteps()
    first = kept.run(DescribeStep(1, image(1)))
    assert kept.run(DescribeStep(2, image(1))) is first
    for seed in (2, 3):
        kept.run(DescribeStep(3, image(seed)))
    assert kept.run(DescribeStep(1, image(1))) is not first and kept.found == 1


def test_content_that_is_not_known_is_no_content() -> None:
    with pytest.raises(TypeError, match="object: its content is not known"):
        content_digest(object())
