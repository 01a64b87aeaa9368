"""The file of an IMU's bias: nothing that it holds, and nothing that a device says, is taken on trust."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.errors import DataError, ShareError, UsageError
from share.geometry.camera import ImuBias
from share.sensors.imu_memory import SavedBias, bias_file, bias_folder, load_bias, save_bias

SERIAL = "845112070914"
WHAT = SavedBias(1_790_000_000_123_456_789, ImuBias([0.004, -0.005, 1 / 3e3], [0.1, -0.2, 0.25], 2e-4, 4e-3))


def told(**changes: Any) -> dict[str, Any]:
    save_bias(SERIAL, WHAT)
    return json.loads(bias_file(SERIAL).read_text()) | changes


def test_it_is_read_as_it_was_written_to_the_last_digit() -> None:
    assert load_bias(SERIAL) is None
    save_bias(SERIAL, WHAT)
    found = load_bias(SERIAL)
    assert found is not None
    assert found.run_end_ns == WHAT.run_end_ns
    assert found.bias.gyro.tobytes() == WHAT.bias.gyro.tobytes()
    assert found.bias.accel.tobytes() == WHAT.bias.accel.tobytes()
    assert (found.bias.gyro_sigma, found.bias.accel_sigma) == (2e-4, 4e-3)
    assert load_bias("0123") is None


def test_it_is_where_the_system_keeps_state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert bias_file(SERIAL) == tmp_path / "share" / "imu" / f"{SERIAL}.json"
    monkeypatch.setenv("HOME", str(tmp_path))
    for unset in ("", "relative/to/nothing"):  # which the XDG specification calls invalid
        monkeypatch.setenv("XDG_STATE_HOME", unset)
        assert bias_folder() == tmp_path / ".local" / "state" / "share" / "imu"


def test_nobody_without_a_home_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_no_serial_number_leads_out_of_the_folder(serial: str) -> None:
    with pytest.raises(DataError, match="not a valid serial number"):
        load_bias(serial)
    with pytest.raises(DataError, match="not a valid serial number"):
        save_bias(serial, WHAT)
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
def test_a_file_that_says_what_no_imu_has_is_damaged(change: dict[str, Any]) -> None:
    bias_file(SERIAL).write_text(json.dumps(told(**change)))
    with pytest.raises(DataError, match=rf"{SERIAL}.json: is damaged, or of another version of SHARE"):
        load_bias(SERIAL)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"schema": NaN}', '{"schema": 1e999}', "\0" * 100, "[" * 10**5]
)
def test_a_file_that_is_no_json_object_is_damaged(text: str) -> None:
    told()
    bias_file(SERIAL).write_text(text)
    with pytest.raises(DataError, match="damaged"):
        load_bias(SERIAL)


def test_what_is_no_file_is_not_waited_for() -> None:
    bias_folder().mkdir(parents=True)
    os.mkfifo(bias_file(SERIAL))
    with pytest.raises(DataError, match="it is a pipe"):
        load_bias(SERIAL)
    with pytest.raises(ShareError):
        save_bias(SERIAL, WHAT)


def test_a_link_in_the_place_of_the_file_is_replaced_and_not_followed(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("mine")
    bias_folder().mkdir(parents=True)
    bias_file(SERIAL).symlink_to(mine)
    save_bias(SERIAL, WHAT)
    assert mine.read_text() == "mine"
    assert load_bias(SERIAL) is not None
    assert np.array_equal(load_bias(SERIAL).bias.accel, WHAT.bias.accel)  # type: ignore[union-attr]
