"""The saved bias of an IMU: its file is checked, and its sigmas grow with time."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.config import InertialConfig
from share.errors import DataError, ShareError, UsageError
from share.geometry.camera import ImuBias, ImuNoise
from share.runtime.imu_bias_store import (
    POWER_ON_ACCEL,
    POWER_ON_GYRO,
    SavedBias,
    bias_file,
    bias_folder,
    load_bias,
    propagate_bias,
    save_bias,
)

SERIAL = "845112070914"
SAVED = SavedBias(1_790_000_000_123_456_789, ImuBias([0.004, -0.005, 1 / 3e3], [0.1, -0.2, 0.25], 2e-4, 4e-3))


def changed_record(**changes: Any) -> dict[str, Any]:
    save_bias(SERIAL, SAVED)
    return json.loads(bias_file(SERIAL).read_text()) | changes


def test_a_saved_bias_is_read_back_exactly() -> None:
    assert load_bias(SERIAL) is None
    save_bias(SERIAL, SAVED)
    found = load_bias(SERIAL)
    assert found is not None
    assert found.run_end_ns == SAVED.run_end_ns
    assert found.bias.gyro.tobytes() == SAVED.bias.gyro.tobytes()
    assert found.bias.accel.tobytes() == SAVED.bias.accel.tobytes()
    assert (found.bias.gyro_sigma, found.bias.accel_sigma) == (2e-4, 4e-3)
    assert load_bias("0123") is None


def test_the_bias_is_saved_in_the_xdg_state_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert bias_file(SERIAL) == tmp_path / "share" / "imu" / f"{SERIAL}.json"
    monkeypatch.setenv("HOME", str(tmp_path))
    for unset in ("", "relative/to/nothing"):  # which the XDG specification calls invalid
        monkeypatch.setenv("XDG_STATE_HOME", unset)
        assert bias_folder() == tmp_path / ".local" / "state" / "share" / "imu"


def test_without_a_home_folder_no_bias_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(UsageError, match="set XDG_STATE_HOME"):
        load_bias(SERIAL)


@pytest.mark.parametrize(
    "serial",
    ["", ".", "..", "../../etc/passwd", "/etc/passwd", "a/b", "a\\b", "a\0b", "a\nb", "é", ".a", "1" * 65],
)
def test_a_serial_number_cannot_leave_the_folder(serial: str) -> None:
    with pytest.raises(DataError, match="not a valid serial number"):
        load_bias(serial)
    with pytest.raises(DataError, match="not a valid serial number"):
        save_bias(serial, SAVED)
    assert not bias_folder().exists()


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"serial": "0123"},
        {"at_ns": "yesterday"},
        {"at_ns": None},
        {"gyro": None},
        {"gyro": {"bias": [0.0, 0.0], "sigma": 1e-3}},
        {"gyro": {"bias": [0.0, 0.0, 0.6], "sigma": 1e-3}},  # beyond what a gyro has
        {"gyro": {"bias": [0.0, 0.0, 0.0], "sigma": 0.0}},
        {"accel": {"bias": [0.0, 0.0, -3.1], "sigma": 1e-2}},
        {"accel": {"bias": [0.0, 0.0, "1"], "sigma": [1e-2]}},
        {"accel": {"bias": [0.0, 0.0, 0.0], "sigma": -1e-2}},
        {"accel": {"bias": [0.0, 0.0, 0.0], "sigma": 1e9}},
        {"accel": [0.0, 0.0, 0.0]},
    ],
)
def test_an_impossible_bias_is_refused(change: dict[str, Any]) -> None:
    bias_file(SERIAL).write_text(json.dumps(changed_record(**change)))
    with pytest.raises(DataError, match=rf"{SERIAL}.json: is damaged, or of another version of SHARE"):
        load_bias(SERIAL)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"schema": NaN}', '{"schema": 1e999}', "\0" * 100, "[" * 10**5]
)
def test_a_bias_file_other_than_a_json_object_is_refused(text: str) -> None:
    changed_record()
    bias_file(SERIAL).write_text(text)
    with pytest.raises(DataError, match="damaged"):
        load_bias(SERIAL)


def test_a_special_file_instead_of_a_bias_file_is_refused() -> None:
    bias_folder().mkdir(parents=True)
    os.mkfifo(bias_file(SERIAL))
    with pytest.raises(DataError, match="it is a pipe"):
        load_bias(SERIAL)
    with pytest.raises(ShareError):
        save_bias(SERIAL, SAVED)


def test_a_link_at_the_bias_file_is_replaced_and_not_followed(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("mine")
    bias_folder().mkdir(parents=True)
    bias_file(SERIAL).symlink_to(mine)
    save_bias(SERIAL, SAVED)
    assert mine.read_text() == "mine"
    assert load_bias(SERIAL) is not None
    assert np.array_equal(load_bias(SERIAL).bias.accel, SAVED.bias.accel)  # type: ignore[union-attr]


CONFIG = InertialConfig()
BMI055 = ImuNoise(2.44e-4, 1.47e-3, 1.0e-5, 1.5e-4, 400.0)
ESTIMATED = ImuBias(np.array([0.004, -0.005, 0.006]), np.array([0.1, -0.2, 0.25]), 0.0002, 0.004)
DAY_S = 86_400.0


def test_a_recent_bias_has_the_sigma_of_a_power_cycle() -> None:
    now = propagate_bias(ESTIMATED, BMI055, 60.0, CONFIG)
    assert now is not None
    np.testing.assert_array_equal(now.gyro, ESTIMATED.gyro)
    np.testing.assert_array_equal(now.accel, ESTIMATED.accel)
    assert now.gyro_sigma == pytest.approx(POWER_ON_GYRO, rel=0.02)
    assert now.accel_sigma == pytest.approx(POWER_ON_ACCEL, rel=0.02)


def test_the_bias_sigma_grows_with_the_random_walk() -> None:
    now = propagate_bias(ESTIMATED, BMI055, DAY_S, CONFIG)
    assert now is not None
    walked = CONFIG.imu_noise * BMI055.accel_walk * np.sqrt(DAY_S)
    assert walked > 0.08
    assert now.accel_sigma**2 == pytest.approx(ESTIMATED.accel_sigma**2 + POWER_ON_ACCEL**2 + walked**2)
    turned = CONFIG.imu_noise * BMI055.gyro_walk * np.sqrt(DAY_S)
    assert now.gyro_sigma**2 == pytest.approx(ESTIMATED.gyro_sigma**2 + POWER_ON_GYRO**2 + turned**2)


@pytest.mark.parametrize("days", [60.0, 1e5, np.inf])
def test_an_old_bias_is_unknown(days: float) -> None:
    assert propagate_bias(ESTIMATED, BMI055, DAY_S, CONFIG) is not None
    assert propagate_bias(ESTIMATED, BMI055, days * DAY_S, CONFIG) is None


def test_a_bias_worse_than_the_prior_is_dropped() -> None:
    vague = ImuBias(ESTIMATED.gyro, ESTIMATED.accel, CONFIG.gyro_bias, 0.01)
    assert propagate_bias(vague, BMI055, 0.0, CONFIG) is None
