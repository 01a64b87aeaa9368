"""A report as one page."""

import base64
import re
from pathlib import Path

import pytest

from share.io.page import page

TEXT = "# Two < three\n\n| a | b |\n| --- | --- |\n| 1 | <script>alert(1)</script> |\n\n* one\n* two\n"
PNG = b"\x89PNG and so on"


@pytest.fixture
def made(tmp_path: Path) -> str:
    (tmp_path / "one.png").write_bytes(PNG)
    return page("R & D", TEXT, {"what it <shows>": tmp_path / "one.png"})


def test_text_and_tables_are_html(made):
    assert "<h1>Two &lt; three</h1>" in made
    assert made.count("<li>") == 2
    assert re.search(r"<td>1</td>\s*<td>&lt;script&gt;", made)
    assert "<title>R &amp; D</title>" in made


def test_it_opens_offline_and_runs_nothing(made):
    assert "<script" not in made
    assert not re.search(r'(?:src|href)="(?!data:)', made)
    assert f'src="data:image/png;base64,{base64.b64encode(PNG).decode()}"' in made
    assert "what it &lt;shows&gt;" in made
