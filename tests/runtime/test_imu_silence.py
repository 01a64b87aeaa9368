"""An IMU that falls silent, or repeats the same values, is reported once, by `share track` and by agents."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.recordings import make_euroc

from share.config import Config
from share.runtime.offline_tracking import track
from share.runtime.pipeline import read_frames
from share.runtime.source import Source, open_source
from share.sensors.measurement import IMU, Measurement
from share.sensors.sequencer import SequencerCounters

FRAMES = 60  # at 20 Hz


def silenced(tmp_path: Path, from_s: float, to_s: float = 1e9) -> Source:
    """A recording whose IMU gives nothing from one time to another."""
    source = open_source(str(make_euroc(tmp_path / "recording", frames=FRAMES)))
    all_of, first_ns = source.measurements, int(source.stamps()["cam0"][0])

    def measurements() -> Iterator[Measurement]:
        for one in all_of():
            if one.stream != IMU or not from_s <= (one.stamp_ns - first_ns) * 1e-9 < to_s:
                yield one

    object.__setattr__(source, "measurements", measurements)  # it is frozen
    return source


def stuck(tmp_path: Path, from_s: float, to_s: float = 1e9, zeros: bool = False) -> Source:
    """A recording whose IMU repeats one sample, or sends zeros, from one time to another."""
    source = open_source(str(make_euroc(tmp_path / "recording", frames=FRAMES)))
    all_of, first_ns = source.measurements, int(source.stamps()["cam0"][0])

    def measurements() -> Iterator[Measurement]:
        held = (0.0,) * 6 if zeros else None
        for one in all_of():
            if one.stream == IMU and from_s <= (one.stamp_ns - first_ns) * 1e-9 < to_s:
                held = held or one.payload
                one = Measurement(IMU, one.stamp_ns, held)
            yield one

    object.__setattr__(source, "measurements", measurements)
    return source


def said_of(source: Source) -> list[str]:
    said: list[str] = []
    assert len(list(read_frames(source, Config(), SequencerCounters(), notify=said.append))) == FRAMES
    return said


@pytest.mark.parametrize(
    ("from_s", "to_s", "reported"), [(1.0, 9.0, "1.0 s"), (-9.0, 9.0, "0.0 s"), (0.5, 2.0, "0.5 s")]
)
def test_an_imu_that_stops_is_reported_once(
    tmp_path: Path, from_s: float, to_s: float, reported: str
) -> None:
    (line,) = said_of(silenced(tmp_path, from_s, to_s))
    assert line.startswith(f"no IMU samples from {reported} on, for at least 1 s; ")


def test_a_short_silence_is_not_reported(tmp_path: Path) -> None:
    assert said_of(silenced(tmp_path, 1.0, 1.8)) == []


def test_silence_of_a_live_camera_is_left_to_its_feed(tmp_path: Path) -> None:
    source = silenced(tmp_path, 1.0)
    object.__setattr__(source, "reports_silence", True)
    assert said_of(source) == []


def test_share_track_reports_it(tmp_path: Path) -> None:
    said: list[str] = []
    run = track(silenced(tmp_path, 1.0), Config(), lambda result: None, said.append)
    assert ["no IMU samples" in line for line in said] == [True]
    assert run.report["sequencer"]["imu_silent"] > 30


def of_repeats(said: list[str]) -> list[str]:
    """Without the lines on spikes: this IMU's samples are noise, among which two equal ones look like one."""
    assert not any("no IMU samples" in line for line in said)
    return [line for line in said if "repeats the same values" in line]


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize(
    ("from_s", "to_s", "zeros", "reported_s"),
    [(1.0, 9.0, False, 1.0), (-9.0, 9.0, True, 0.0), (0.52, 1.0, False, 0.5)],
)
def test_an_imu_that_repeats_one_sample_is_reported_once(
    tmp_path: Path, from_s: float, to_s: float, zeros: bool, reported_s: float, live: bool
) -> None:
    source = stuck(tmp_path, from_s, to_s, zeros)
    object.__setattr__(source, "reports_silence", live)
    (line,) = of_repeats(said_of(source))
    said_s = float(line.removeprefix("the IMU repeats the same values from ").split()[0])
    assert said_s == pytest.approx(reported_s, abs=0.11)


def test_values_that_repeat_for_less_than_a_tenth_of_a_second_are_not_reported(tmp_path: Path) -> None:
    assert of_repeats(said_of(stuck(tmp_path, 1.0, 1.06))) == []


def test_share_track_reports_an_imu_that_sends_zeros_and_nothing_fails(tmp_path: Path) -> None:
    said: list[str] = []
    run = track(stuck(tmp_path, -9.0, zeros=True), Config(), lambda result: None, said.append)
    assert ["repeats the same values" in line for line in said] == [True]
    assert run.report["failed_steps"] == 0
    assert run.report["sequencer"]["imu_silent"] == FRAMES
    assert run.report["sequencer"]["imu_repeated"] > 500
