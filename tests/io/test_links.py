"""Networks of a session's agents, as they are written."""

from pathlib import Path

import pytest

from share.errors import UsageError
from share.net.channel import NETWORKS, Network, Way
from share.net.emulated import Links


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
    links = Links.parse(text)
    assert (links.of("ann"), links.of("bob")) == (ann, bob)
    assert links.network("ann") == (NETWORKS[ann] if ann else Network())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wifi5,wifi-busy", "two for all; give one, and others as AGENT=LINK"),
        ("bob=wifi5,bob=wifi-busy", "two for bob"),
        ("wifi5,bob=wifi6", "'wifi6' is no file"),
        ("wifi5,", "'' is no file"),
        ("bob=", "'' is no file"),
    ],
)
def test_what_cannot_be_read_is_said(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        Links.parse(text)


def test_a_link_of_nobody_is_said() -> None:
    links = Links.parse("wifi5,bop=wifi-busy")
    links.check(["ann", "bop"])
    with pytest.raises(UsageError, match="no agent is called 'bop'; there are ann, bob"):
        links.check(["ann", "bob"])


def test_a_file_may_be_called_anything(tmp_path: Path) -> None:
    odd, plain = tmp_path / "a=b,c.yaml", tmp_path / "far.yaml"
    for file in (odd, plain):
        file.write_text("up: {mbps: 5, delay_ms: 40}\n")
    assert Links.parse(str(odd)).network("ann") == Network(Way(5.0, 40.0))
    assert Links.parse(f"bob={plain}").network("bob") == Network(Way(5.0, 40.0))
