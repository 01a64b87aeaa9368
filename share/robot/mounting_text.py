"""Another mounting in the text of a robot file (docs/do/robot.md), of which nothing else changes."""

from __future__ import annotations

from typing import NamedTuple

import yaml

from share.errors import ConfigError
from share.files.yaml_file import parse_yaml, without_opencv
from share.strict_yaml import StrictLoader
from share.types import F64

_MOUNTING_KEYS = ("camera", "T_base_body")
_NOTE = "by share robot calibrate"


class MountingText(NamedTuple):
    """text: of the new file. is_rewritten: whether the old text has another form, and is a comment in it."""

    text: str
    is_rewritten: bool


def with_mounting(text: str, T_base_body: F64, where: str) -> MountingText:
    """Return the text of a robot file with another mounting; the old one stays as a comment.

    A text that does not read back as meant is not returned: one in which the lines cannot be exchanged
    (JSON, for example) is written anew. Raises ConfigError.
    """
    data = parse_yaml(text, where).data
    rest = {key: value for key, value in data.items() if key not in _MOUNTING_KEYS}
    wanted = rest | {"T_base_body": _rounded(T_base_body)}
    edited = _edited(text, T_base_body)
    if edited is not None and _reads_as(edited, wanted):
        return MountingText(edited, False)
    old = "\n".join(f"# {line}".rstrip() for line in text.splitlines())
    body = yaml.safe_dump(rest, sort_keys=False, allow_unicode=True) if rest else ""
    rewritten = f"# before {_NOTE[3:]}:\n{old}\n{body}" + "\n".join([*_lines(T_base_body), ""])
    if _reads_as(rewritten, wanted):
        return MountingText(rewritten, True)
    raise ConfigError(f"{where}: the mounting does not go into this file")


def mounting_line(T_base_body: F64) -> str:
    """Return the mounting as one line of a robot file."""
    return f"T_base_body: {_rounded(T_base_body)}"


def _edited(text: str, T_base_body: F64) -> str | None:
    """Return the text with the mounting's lines as comments and new ones after them; None where a line may
    hold more than one key."""
    root = yaml.compose(without_opencv(text), StrictLoader)
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        return None
    lines, new_lines = text.splitlines(), _lines(T_base_body, root.start_mark.column)
    starts = [key.start_mark.line for key, _ in root.value] + [len(lines)]
    for index in reversed(range(len(root.value))):  # from the end: lines before stay where they are
        key, value = root.value[index]
        if key.value not in _MOUNTING_KEYS:
            continue
        end = min(value.end_mark.line + (value.end_mark.column > 0), starts[index + 1])
        while _is_comment(lines[end - 1]):  # what follows a block belongs to the next key
            end -= 1
        old = [line if _is_comment(line) else f"# {line}" for line in lines[starts[index] : end]]
        lines[starts[index] : end] = [*old, *new_lines]
        new_lines = []
    return "\n".join([*lines, ""])


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _reads_as(text: str, wanted: dict[str, object]) -> bool:
    try:
        return bool(parse_yaml(text, "").data == wanted)
    except ConfigError:
        return False


def _lines(T_base_body: F64, indent: int = 0) -> list[str]:
    rows = [f"  - [{', '.join(f'{value:.6f}' for value in row)}]" for row in T_base_body]
    return [" " * indent + line for line in (f"T_base_body:  # {_NOTE}", *rows)]


def _rounded(T_base_body: F64) -> list[list[float]]:
    return [[float(f"{value:.6f}") for value in row] for row in T_base_body]
