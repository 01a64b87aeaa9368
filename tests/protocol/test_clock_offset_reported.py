"""An agent tells the offset of the edge's clock only where it is as sure as the setting asks for."""

from __future__ import annotations

import pytest
from test_edge_clock import US, S, World, run

from share.protocol.edge_clock import ClockEstimate, ClockFilter

MS = 1000 * US
END = 120 * S


def test_nothing_is_claimed_before_an_exchange() -> None:
    claim = ClockEstimate.from_filter(ClockFilter(), 0, 1.0)
    assert claim.report() == {
        "offset_ms": None,
        "sigma_ms": None,
        "asymmetry_ms": None,
        "claim_ms": 1.0,
        "uncertainty_ms": None,
        "is_reliable": False,
    }


def test_a_quick_network_allows_the_claim() -> None:
    """There and back 0.4 ms and more, so half of that is not seen, nor whether it was kept for 0.015."""
    clock, _ = run(World(1))
    claim = ClockEstimate.from_filter(clock, END, 1.0)
    assert claim.is_reliable
    assert claim.asymmetry_ms == pytest.approx(0.215, abs=0.01)
    assert claim.uncertainty_ms == pytest.approx(claim.sigma_ms + claim.asymmetry_ms)  # type: ignore[operator]
    assert claim.offset_ms == pytest.approx(7000 + 50e-6 * 120e3, abs=0.1)


def test_a_slow_network_does_not_however_steady_it_is() -> None:
    """The filter's sigma is microseconds; 3 ms of 3.2 may be on the way there, and nobody would see it."""
    clock, _ = run(World(1, least_us=1600.0))
    claim = ClockEstimate.from_filter(clock, END, 1.0)
    assert claim.sigma_ms is not None and claim.sigma_ms < 0.05
    assert not claim.is_reliable
    assert claim.offset_ms is None
    assert claim.uncertainty_ms == pytest.approx(1.6, abs=0.1)
    assert ClockEstimate.from_filter(clock, END, 2.0).is_reliable


def test_what_was_not_heard_for_long_is_claimed_no_more() -> None:
    clock, _ = run(World(1))
    later = [ClockEstimate.from_filter(clock, END + minutes * 60 * S, 1.0) for minutes in (0, 1, 60)]
    sigmas = [claim.sigma_ms for claim in later]
    assert sigmas == sorted(sigmas)  # type: ignore[type-var]
    assert [claim.is_reliable for claim in later] == [True, True, False]


@pytest.mark.parametrize("up_us", [100.0, 400.0, 700.0])
def test_the_truth_is_within_what_is_stated_however_uneven_the_ways(up_us: float) -> None:
    """800 us on the way in all. Three sigmas, as sigma is a standard deviation, and all of the asymmetry."""
    clock = ClockFilter()
    for k in range(200):
        sent = k * S // 2
        arrived = sent + round(up_us * US)
        clock.update(sent, arrived + 7 * S, arrived + 7 * S, sent + 800 * US)
    claim = ClockEstimate.from_filter(clock, 100 * S, 1.0)
    assert claim.offset_ms is not None and claim.sigma_ms is not None and claim.asymmetry_ms is not None
    off_ms = abs(claim.offset_ms - 7000)
    assert off_ms <= claim.asymmetry_ms + 3 * claim.sigma_ms
    assert off_ms == pytest.approx(abs(up_us - 400) / 1000, abs=0.02)


@pytest.mark.parametrize("read_at", [0.0, 0.5, 1.0])
def test_an_edge_that_says_that_it_kept_the_question_long_makes_no_claim_surer(read_at: float) -> None:
    """Of the 30 ms that it took it says to have had the question for all but 0.2. Wherever within these its
    one true reading was made, here 7 s off, the offset is within what is stated."""
    clock, took, kept = ClockFilter(), 30 * MS, 30 * MS - 200 * US
    for k in range(200):
        sent = k * S // 2
        replied = sent + round(read_at * took) + 7 * S
        clock.update(sent, replied - kept, replied, sent + took)
    claim = ClockEstimate.from_filter(clock, 100 * S, 1.0)
    assert not claim.is_reliable and claim.offset_ms is None
    assert claim.uncertainty_ms is not None and claim.uncertainty_ms > 15
    told = clock.offset_ns(100 * S)
    assert told is not None and abs(told - 7 * S) <= claim.uncertainty_ms * MS
