"""A report as one page."""

import base64
import re
from pathlib import Path

import pytest

from share.lab.evaluate.report import html_page

TEXT = """# Two < three

| a | b |
| --- | --- |
| 1 | <script>alert(1)</script> |

![what it <shows>](one.png)

* one
* two
"""
PNG = b"\x89PNG and so on"


@pytest.fixture
def made(tmp_path: Path) -> str:
    (tmp_path / "one.png").write_bytes(PNG)
    return html_page("R & D", TEXT, tmp_path)


def test_text_and_tables_are_html(made):
    assert "<h1>Two &lt; three</h1>" in made
    assert made.count("<li>") == 2
    assert re.search(r"<td>1</td>\s*<td>&lt;script&gt;", made)
    assert "<title>R &amp; D</title>" in made


def test_the_page_has_no_scripts_and_no_external_links(made):
    assert "<script" not in made
    assert not re.search(r'(?:src|href)="(?!data:)', made)
    assert f'src="data:image/png;base64,{base64.b64encode(PNG).decode()}"' in made
    assert "<figcaption>what it &lt;shows&gt;</figcaption>" in made


def test_a_picture_stands_where_the_text_has_it(made):
    assert made.index("</table>") < made.index("<figure>") < made.index("<li>one")
