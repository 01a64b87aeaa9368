"""From labels to a model, on synthetic keyframes whose error is a function of their features."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="make train-test brings it")
pytest.importorskip("onnx", reason="make train-test brings it")
pytest.importorskip("sklearn", reason="make train-test brings it")

from helpers.made_features import made_features  # noqa: E402
from helpers.tiny_backbone import tiny_backbone  # noqa: E402

from share.lab.train.keyframe_table import collect_labels  # noqa: E402
from share.lab.train.labels import Labels, write_labels  # noqa: E402
from share.lab.train.training import (  # noqa: E402
    Standardiser,
    TrainingOptions,
    train_heads,
)
from share.odometry.error_model.inputs import INPUT_SHAPES  # noqa: E402
from share.odometry.error_model.network import backbone_features, open_network  # noqa: E402

ROOMS, EACH = 8, 300
NOTHING = np.zeros(INPUT_SHAPES["recent"], np.float32)


@pytest.fixture(scope="module")
def labels(tmp_path_factory) -> Path:
    """Labels of eight rooms: the error grows with a dark picture and few matches, with noise."""
    folder, rng = tmp_path_factory.mktemp("labels"), np.random.default_rng(5)
    for room in range(ROOMS):
        rows = []
        for k in range(EACH):
            dark, few = rng.random(2)
            scalars = rng.random(8).astype(np.float32)
            scalars[5] = 1 - few
            picture = np.full((128, 128), 255 * (1 - dark), np.uint8)
            error_cm = 0.2 * np.exp(2 * dark + 1.5 * few + 0.2 * rng.standard_normal())
            seen = made_features(rng, picture=picture, scalars=scalars, recent=NOTHING)
            rows.append((k, float(error_cm) if k else float("nan"), seen))
        made = {"scene": "warehouse", "seed": room, "size": None, "motions": ["ar=walk:"]}
        write_labels(
            folder / f"w{room}-ar-0.npz", Labels.from_rows({"session": f"w{room}", "provenance": made}, rows)
        )
    return folder


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("base") / "tiny.onnx"
    path.write_bytes(tiny_backbone())
    return path


@pytest.mark.long
def test_a_trained_model_predicts_errors_in_unseen_rooms(share, labels, base, tmp_path):
    common = ("--base", base)
    done = share("train", "fit", labels, *common, "--epochs", 60, "--out", tmp_path / "fit")
    assert done.code == 0, done.err
    assert "keyframes: " in done.out
    done = share("train", "compare", labels, "--fit", tmp_path / "fit", *common, "--json")
    assert done.code == 0, done.err
    scores = {one["name"]: one for one in json.loads(done.out)}
    assert list(scores) == [
        "always the mean",
        "linear regression",
        "random forest",
        "MLP head",
        "contrastive CNN",
        "ours",
    ]
    assert scores["ours"]["rank"] > 0.9
    assert scores["ours"]["rmse_cm"] < 0.7 * scores["linear regression"]["rmse_cm"]
    assert scores["MLP head"]["rmse_cm"] < scores["always the mean"]["rmse_cm"]
    assert 0.8 < scores["ours"]["coverage"] < 0.98

    model = tmp_path / "model.onnx"
    done = share("train", "export", tmp_path / "fit", "--labels", labels, *common, "--out", model)
    assert done.code == 0, done.err
    card = model.with_suffix(".md").read_text()
    assert "rank correlation" in card
    assert card.strip() in done.out
    again = share("train", "fit", labels, "--base", model, "--epochs", 1, "--out", tmp_path / "again")
    assert again.code == 0, again.err  # a model with a head has a backbone, too


@pytest.mark.long
def test_a_test_on_training_rooms_is_refused(share, labels, base, tmp_path):
    fit = tmp_path / "fit"
    assert share("train", "fit", labels, "--base", base, "--epochs", 1, "--out", fit).code == 0
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    for path in sorted(labels.iterdir())[1:]:
        (fewer / path.name).write_bytes(path.read_bytes())
    done = share("train", "compare", fewer, "--fit", fit, "--base", base)
    assert done.code == 2
    assert "these labels are not those of the training" in done.err


@pytest.mark.long
def test_too_few_rooms_are_refused(share, labels, base, tmp_path):
    few = tmp_path / "few"
    few.mkdir()
    done = share("train", "fit", few, "--base", base, "--out", tmp_path / "fit")
    assert done.code == 2
    assert "has no labels; make them with `share train labels`" in done.err
    for path in sorted(labels.iterdir())[:3]:
        (few / path.name).write_bytes(path.read_bytes())
    done = share("train", "fit", few, "--base", base, "--out", tmp_path / "fit")
    assert done.code == 2
    assert "is of 3 rooms" in done.err


@pytest.mark.long
def test_an_interrupted_training_resumes_to_the_same_weights(labels, base, tmp_path):
    collection = collect_labels(labels, 0)
    deep = backbone_features(open_network(base), collection.table.picture)
    scale = Standardiser(deep, collection)
    training, validation = scale.inputs("train"), scale.inputs("validate")
    whole = train_heads(training, validation, TrainingOptions(epochs=6), None, lambda *_: None)

    class InterruptedTrainingError(Exception):
        pass

    def after_three(epoch: int, training_loss: float, validation_loss: float) -> None:
        if epoch == 4:
            raise InterruptedTrainingError

    kept = tmp_path / "checkpoint.pt"
    with pytest.raises(InterruptedTrainingError):
        train_heads(training, validation, TrainingOptions(epochs=6), kept, after_three)
    epochs: list[int] = []
    resumed = train_heads(
        training, validation, TrainingOptions(epochs=6), kept, lambda epoch, *_: epochs.append(epoch)
    )
    assert epochs == [4, 5, 6]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    other = train_heads(
        training, validation, TrainingOptions(epochs=1, seed=9), kept, lambda epoch, *_: epochs.append(epoch)
    )
    assert epochs[-1] == 1  # other options start again
    assert other is not resumed
