"""Make the table of settings in docs/lookup/configuration.md from share/config.py: names, defaults, comments.

python tools/config_table.py            print it
python tools/config_table.py --write    write it into docs/lookup/configuration.md, below its marker
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "share" / "config.py"
PAGE = ROOT / "docs" / "lookup" / "configuration.md"
MARKER = "<!-- Below: made by tools/config_table.py from share/config.py. Change it there. -->\n"

# unit by the end of a name; the first match counts.
UNITS = {
    "_per_rad": "",
    "_per_m": "",
    "_m_s": "m/s",
    "_rad_s": "rad/s",
    "_ms": "ms",
    "_us": "µs",
    "_s": "s",
    "_days": "d",
    "_px": "px",
    "_rad": "rad",
    "_deg": "°",
    "_m": "m",
    "_bits": "bit",
    "_ppm": "ppm",
    "_hz": "Hz",
}


class Setting(NamedTuple):
    """One row. meaning: the comment on the field's line, empty if there is none."""

    name: str
    default: str
    unit: str
    meaning: str


class SettingsSection(NamedTuple):
    """One top-level key of the file. about: the docstring of its dataclass."""

    name: str
    about: str
    settings: list[Setting]


def sections(text: str) -> list[SettingsSection]:
    """Return the sections in the order of `Config`, from the source text of share/config.py."""
    classes = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)}
    comments = _comments(text)
    return [
        SettingsSection(name, " ".join((ast.get_docstring(classes[kind]) or "").split()), rows)
        for name, kind in _fields_of_config(classes["Config"])
        for rows in [list(_settings(classes[kind], comments))]
    ]


def page(found: list[SettingsSection]) -> str:
    """Return the sections as Markdown."""
    return "\n".join(_markdown(section) for section in found)


def _fields_of_config(config: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for field in config.body:
        if isinstance(field, ast.AnnAssign):
            yield ast.unparse(field.target), ast.unparse(field.annotation)


def _settings(node: ast.ClassDef, comments: dict[int, str]) -> Iterator[Setting]:
    for field in node.body:
        if isinstance(field, ast.AnnAssign) and field.value is not None:
            name = ast.unparse(field.target)
            unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
            default = ast.unparse(field.value).replace("field(default_factory=dict)", "{}")
            default = "null" if default == "None" else default  # as YAML has it
            yield Setting(name, default, unit, comments.get(field.lineno, ""))


def _comments(text: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT}


def _markdown(section: SettingsSection) -> str:
    lines = [f"## {section.name}", "", section.about, ""]
    lines += ["| key | default | unit | meaning |", "|---|---|---|---|"]
    for name, default, unit, meaning in section.settings:
        meaning = meaning.replace("|", "\\|").replace("*", "\\*")
        lines.append(f"| `{name}` | {default.strip(chr(39))} | {unit} | {meaning} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    text = page(sections(SOURCE.read_text()))
    if "--write" not in sys.argv[1:]:
        print(text, end="")
        return
    head, marker, _ = PAGE.read_text().partition(MARKER)
    if not marker:
        sys.exit(f"{PAGE}: has no line {MARKER.strip()!r}")
    PAGE.write_text(head + MARKER + "\n" + text)


if __name__ == "__main__":
    main()
