"""A report as one HTML page that opens offline, with its pictures embedded."""

from __future__ import annotations

import base64
import html
import re
from functools import partial
from pathlib import Path

from share.files.reading import path_inside
from share.recordings.images import read_picture

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; display: block;
  overflow-x: auto; }
th, td { padding: 0.25rem 0.75rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { background: #f3f3f3; }
tbody tr:hover { background: #f8f8f0; }
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #555; font-size: 14px; }
"""
_PICTURE = re.compile(r'<p><img alt="([^"]*)" src="([^"]*)" ?/?></p>')


def html_page(title: str, text: str, folder: Path) -> str:
    """Return HTML of a Markdown text. HTML in the text is escaped.

    Pictures are PNG files in `folder`, each a paragraph of its own; its alt text becomes the caption.
    """
    from markdown import markdown
    from markdown.extensions.tables import TableExtension  # imported by class, so that a freezer sees it

    body = markdown(html.escape(text, quote=False), extensions=[TableExtension()])
    body = _PICTURE.sub(partial(_figure_html, folder), body)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width">\n<title>{html.escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _figure_html(folder: Path, match: re.Match[str]) -> str:
    caption, name = match[1], html.unescape(match[2])
    data = base64.b64encode(read_picture(path_inside(folder, name, "a report"))).decode()
    return (
        f'<figure>\n<img alt="{caption}" src="data:image/png;base64,{data}">\n'
        f"<figcaption>{caption}</figcaption>\n</figure>"
    )
