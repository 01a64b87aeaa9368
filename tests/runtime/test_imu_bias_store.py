"""The IMU bias of a live camera is kept from run to run, that of a recording is not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.plain_walk import RIG

from share.cameras.live import LiveSource
from share.config import Config
from share.geometry.camera import ImuBias
from share.runtime.imu_bias_store import POWER_ON_ACCEL, ImuBiasStore, bias_file

DAY_NS = 86_400 * 10**9
NOON_NS = 1_790_000_000 * 10**9
LEARNT = ImuBias([0.004, -0.005, 0.006], [0.1, -0.2, 0.25], 2e-4, 4e-3)


class Camera(LiveSource):
    """A live camera with a serial number and a rig, and nothing else."""

    def __init__(self, serial: str = "0123", rig: Any = RIG) -> None:
        self.serial, self.rig = serial, rig


def memory(source: Any, now_ns: int = NOON_NS) -> tuple[ImuBiasStore, list[str]]:
    said: list[str] = []
    return ImuBiasStore(source, Config().inertial, said.append, lambda: now_ns), said


def test_the_next_run_starts_with_the_saved_bias() -> None:
    first, said = memory(Camera())
    assert first.bias is None
    assert first.report() == {"imu_bias": {"learnt_at": None}}
    first.save(LEARNT)
    second, more = memory(Camera(), NOON_NS + 10**9)
    assert second.bias is not None
    np.testing.assert_array_equal(second.bias.accel, LEARNT.accel)
    assert second.bias.accel_sigma == pytest.approx(POWER_ON_ACCEL, rel=0.01)
    assert second.report() == {"imu_bias": {"learnt_at": "2026-09-21T14:13:20Z"}}
    assert memory(Camera("0456"))[0].bias is None
    assert said == more == []


def test_a_run_without_an_estimate_keeps_the_saved_bias() -> None:
    memory(Camera())[0].save(LEARNT)
    memory(Camera(), NOON_NS + DAY_NS)[0].save(None)
    assert memory(Camera(), NOON_NS + DAY_NS)[0].report()["imu_bias"]["learnt_at"] == "2026-09-21T14:13:20Z"


def test_a_bias_that_a_body_at_rest_contradicts_costs_one_line_and_is_not_reported() -> None:
    memory(Camera())[0].save(LEARNT)
    run, said = memory(Camera(), NOON_NS + DAY_NS)
    for _ in range(3):
        run.note_dropped()
    assert [line.startswith("the IMU bias of the last run is not used: ") for line in said] == [True]
    assert run.report() == {"imu_bias": {"learnt_at": None}}
    unknown, nothing = memory(Camera("0456"))
    unknown.note_dropped()
    assert nothing == []


def test_an_old_bias_is_not_used() -> None:
    memory(Camera())[0].save(LEARNT)
    old, said = memory(Camera(), NOON_NS + 365 * DAY_NS)
    assert (old.bias, old.report(), said) == (None, {"imu_bias": {"learnt_at": None}}, [])


def test_a_bias_from_the_future_is_not_used() -> None:
    memory(Camera())[0].save(LEARNT)
    young, said = memory(Camera(), NOON_NS - DAY_NS)
    assert young.bias is None
    assert said == ["the IMU bias is taken as unknown: its file is from the future by this machine's clock"]


def test_a_damaged_file_costs_one_line_and_is_replaced() -> None:
    memory(Camera())[0].save(LEARNT)
    bias_file("0123").write_text("{")
    run, said = memory(Camera())
    assert run.bias is None
    assert len(said) == 1
    assert said[0].startswith("the IMU bias is taken as unknown: ")
    assert "0123.json: is damaged" in said[0]
    run.save(LEARNT)
    assert memory(Camera())[0].bias is not None


def test_a_malformed_serial_number_costs_a_line_each_time() -> None:
    run, said = memory(Camera("../../0123"))
    run.save(LEARNT)
    assert run.bias is None
    assert len(said) == 2
    assert all("not a valid serial number" in line for line in said)


def test_a_folder_that_cannot_be_made_does_not_end_the_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    (tmp_path / "state").write_text("a file")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    run, said = memory(Camera())
    run.save(LEARNT)
    assert len(said) == 1
    assert said[0].startswith("the IMU bias is not saved: ")


def test_no_bias_is_saved_of_a_recording() -> None:
    memory(Camera())[0].save(LEARNT)
    recording = SimpleNamespace(serial="0123", rig=RIG)
    run, said = memory(recording, NOON_NS + DAY_NS)
    before = bias_file("0123").read_bytes()
    run.save(ImuBias([0.0] * 3, [0.0] * 3, 1e-3, 1e-2))
    assert (run.bias, run.report(), said) == (None, {}, [])
    assert bias_file("0123").read_bytes() == before
