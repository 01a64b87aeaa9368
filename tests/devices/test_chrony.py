"""The output of chronyc is parsed, and chronyd accepts the configuration that SHARE prints."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from helpers.time_servers import chronyd, needs_chrony

from share.devices import clocks
from share.errors import DataError
from share.net.udp import HostPort

# Printed by chronyc 4.3 beside "0.004984827 seconds slow of NTP time", "Root delay: 0.000034467", "Root
# dispersion: 0.000007578" and "RMS offset: 0.000002491" for people.
LINE = (
    "7F000001,127.0.0.1,11,1795446605.127984351,0.004984824,-0.000000439,0.000002491,"
    "-0.647,-0.002,1.717,0.000034467,0.000007568,1.0,Normal\n"
)


def test_chronyc_line_is_parsed() -> None:
    found = clocks.parse_tracking(LINE)
    assert (found.source, found.stratum, found.synchronised, found.local) == ("127.0.0.1", 11, True, False)
    assert (found.offset_s, found.rms_s) == (
        0.004984824,
        0.000002491,
    )  # ahead of this machine's, which is slow
    assert found.uncertainty_s == pytest.approx(0.000034467 / 2 + 0.000007568)


def test_unsynchronised_chronyd_is_recognised() -> None:
    assert not clocks.parse_tracking(LINE.replace("Normal", "Not synchronised")).synchronised
    assert clocks.parse_tracking(LINE.replace("7F000001,127.0.0.1", "7F7F0101,")).local


@pytest.mark.parametrize(
    "text", ["", "506 Cannot talk to daemon", LINE.replace("0.004984824", "x"), LINE[:60]]
)
def test_unparsable_output_is_refused(text: str) -> None:
    with pytest.raises(
        DataError, match=r"chronyc -c tracking: cannot be parsed \(.*(expected 14|could not convert)"
    ):
        clocks.parse_tracking(text)


def test_missing_chronyd_gives_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert clocks.read_tracking() is None


@needs_chrony
def test_chronyd_accepts_the_advised_lines(tmp_path: Path) -> None:
    lines = clocks.follow_lines(HostPort("192.168.1.10", 11123))
    (tmp_path / "chrony.conf").write_text("\n".join(lines) + "\n")
    done = subprocess.run(
        chronyd("-p", "-f", str(tmp_path / "chrony.conf")), capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == lines
