"""An emulated network, without a clock."""

from __future__ import annotations

import numpy as np
import pytest

from share.net.channel import NETWORK_PRESETS, Channel, ChannelModel
from share.plain_data import from_mapping

MS = 1_000_000


def arrivals(
    way: ChannelModel, sizes: list[int], every_ms: float, seed: int = 0, round_trip_ms: float = 4.0
) -> np.ndarray:
    """When each message arrives after it was sent, ms."""
    channel = Channel(way, round_trip_ms, np.random.default_rng(seed))
    sent = [round(i * every_ms * MS) for i in range(len(sizes))]
    return np.array([channel.arrival_ns(n, t) - t for n, t in zip(sizes, sent, strict=True)]) / MS


def test_a_message_takes_its_time_on_the_air_and_waits_for_those_before_it() -> None:
    late = arrivals(ChannelModel(mbps=8.0, delay_ms=3.0), [10_000 - 7 * 66, 934, 934], every_ms=1.0)
    assert late == pytest.approx([10 + 3, 10 + 1 + 3 - 1, 10 + 1 + 1 + 3 - 2])


def test_nothing_overtakes() -> None:
    sent = np.arange(2000) * 2.0
    late = arrivals(NETWORK_PRESETS["wifi-busy"].up, [400] * 2000, every_ms=2.0)
    assert (np.diff(sent + late) >= -1e-6).all()
    assert len(np.unique(late)) > 1000


def test_jitter_is_as_large_as_it_is_said() -> None:
    late = arrivals(ChannelModel(delay_ms=2.0, jitter_ms=3.0), [100] * 20_000, every_ms=1000.0)
    assert late.min() >= 2.0
    assert late.mean() == pytest.approx(5.0, rel=0.03)


def test_what_is_lost_comes_after_all_but_later() -> None:
    """One packet a message: the share that is late is the loss; the first try again after 2 x 4 + 10 ms."""
    late = arrivals(ChannelModel(loss=0.05), [100] * 40_000, every_ms=5000.0)
    assert (late > 0).mean() == pytest.approx(0.05, rel=0.07)
    once = late[late > 0]
    assert np.isclose(once, 18.0).mean() == pytest.approx(0.95, abs=0.02)
    assert set(np.round(np.unique(once[once < 700]), 6)) == {18.0, 218.0, 618.0}


def test_losses_come_in_bursts_and_are_as_many() -> None:
    """Of large messages as many packets are lost, but fewer messages are late."""
    single, bursts = (
        arrivals(ChannelModel(loss=0.02, burst=b), [14_000] * 8_000, every_ms=10_000.0) > 0
        for b in (1.0, 5.0)
    )
    assert single.mean() == pytest.approx(1 - 0.98**10, rel=0.06)
    assert bursts.mean() == pytest.approx(1 - 0.98 * (1 - 0.2 * 0.02 / 0.98) ** 9, rel=0.15)
    channel = Channel(ChannelModel(loss=0.02, burst=5.0), 4.0, np.random.default_rng(1))
    lost = np.array([channel._is_lost() for _ in range(300_000)])
    assert lost.mean() == pytest.approx(0.02, rel=0.1)
    assert lost.sum() / (np.diff(lost.astype(int)) == 1).sum() == pytest.approx(5.0, rel=0.1)


def test_the_same_seed_the_same_delays() -> None:
    way = NETWORK_PRESETS["wifi5"].down
    assert (arrivals(way, [500] * 300, 3.0, seed=4) == arrivals(way, [500] * 300, 3.0, seed=4)).all()
    assert (arrivals(way, [500] * 300, 3.0, seed=4) != arrivals(way, [500] * 300, 3.0, seed=5)).any()


def test_small_messages_are_lost_as_often_as_large_ones() -> None:
    """A packet each: a burst goes on from one to the next."""
    late = arrivals(ChannelModel(loss=0.02, burst=4.0), [100] * 60_000, every_ms=10_000.0) > 0
    assert late.mean() == pytest.approx(0.02, rel=0.12)
    ends = np.flatnonzero(np.diff(late.astype(int)) == -1)
    begins = np.flatnonzero(np.diff(late.astype(int)) == 1)
    runs = min(len(begins), len(ends))
    assert late.sum() / runs == pytest.approx(4.0, rel=0.12)


@pytest.mark.parametrize("wrong", [{"loss": 0.9}, {"burst": 0.5}])
def test_what_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    from share.errors import ConfigError

    with pytest.raises(ConfigError, match="loss must be at most"):
        from_mapping(ChannelModel, wrong, "a file")
