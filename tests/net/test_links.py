"""Networks of a session's agents, as they are written."""

from pathlib import Path

import pytest

from share.errors import UsageError
from share.net.channel import NETWORK_PRESETS, ChannelModel, NetworkModel
from share.net.emulated_link import LinkAssignment


@pytest.mark.parametrize(
    ("text", "ann", "bob"),
    [
        (None, None, None),
        ("wifi5", "wifi5", "wifi5"),
        ("wifi5,bob=wifi-busy", "wifi5", "wifi-busy"),
        ("bob=wifi-busy, wifi5", "wifi5", "wifi-busy"),
        ("bob=wifi-busy", None, "wifi-busy"),
        ("ann=wifi5,bob=wifi-busy", "wifi5", "wifi-busy"),
    ],
)
def test_whose_link_is_which(text: str | None, ann: str | None, bob: str | None) -> None:
    links = LinkAssignment.parse(text)
    assert (links.name_for("ann"), links.name_for("bob")) == (ann, bob)
    assert links.network_for("ann") == (NETWORK_PRESETS[ann] if ann else NetworkModel())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wifi5,wifi-busy", "two links for all; give one, and others as AGENT=LINK"),
        ("bob=wifi5,bob=wifi-busy", "two links for bob"),
        ("wifi5,bob=wifi6", "'wifi6' is neither a file"),
        ("wifi5,", "'' is neither a file"),
        ("bob=", "'' is neither a file"),
    ],
)
def test_what_cannot_be_read_is_said(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        LinkAssignment.parse(text)


def test_a_link_of_nobody_is_said() -> None:
    links = LinkAssignment.parse("wifi5,bop=wifi-busy")
    links.check(["ann", "bop"])
    with pytest.raises(UsageError, match="there is no agent 'bop'; the agents are ann, bob"):
        links.check(["ann", "bob"])


def test_a_file_may_be_called_anything(tmp_path: Path) -> None:
    odd, plain = tmp_path / "a=b,c.yaml", tmp_path / "far.yaml"
    for file in (odd, plain):
        file.write_text("up: {mbps: 5, delay_ms: 40}\n")
    assert LinkAssignment.parse(str(odd)).network_for("ann") == NetworkModel(ChannelModel(5.0, 40.0))
    assert LinkAssignment.parse(f"bob={plain}").network_for("bob") == NetworkModel(ChannelModel(5.0, 40.0))
