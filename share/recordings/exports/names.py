"""Names of what an export writes, made from names of agents and maps: distinct, and safe wherever they go."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from unicodedata import normalize

_MAX_BYTES = 200  # of a file name without its suffix; file systems allow 255


def plain_names(names: Iterable[str]) -> dict[str, str]:
    """Return a distinct name for each that is allowed in a file name, a ROS topic and a frame: letters,
    digits and underscores, not beginning with a digit."""
    return _distinct(names, _plain)


def distinct_file_names(names: Iterable[str]) -> dict[str, str]:
    """Return a distinct file name for each, without suffix: its letters, digits, spaces and `-_.+@#()`, a dot
    for each `/`, not beginning with a dot. Distinct also where case does not count."""
    return _distinct(names, _file_name)


def map_folders(work: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the folder of each map: `work` of a single one, else a new one in it."""
    if len(names) == 1:
        return {names[0]: work}
    folders = {name: work / file_name for name, file_name in distinct_file_names(names).items()}
    for folder in folders.values():
        folder.mkdir()
    return folders


def _distinct(names: Iterable[str], make: Callable[[str], str]) -> dict[str, str]:
    out: dict[str, str] = {}
    used = set[str]()
    for name in names:
        if name in out:
            continue
        base = made = make(name)
        number = 1
        while (key := normalize("NFKC", made).casefold()) in used:
            number += 1
            made = f"{base}_{number}"
        used.add(key)
        out[name] = made
    return out


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", name if not name[:1].isdigit() else f"_{name}") or "_"


def _file_name(name: str) -> str:
    made = re.sub(r"[^\w .+@#()-]", "_", name.replace("/", "."))
    made = made.encode(errors="replace")[:_MAX_BYTES].decode(errors="ignore").rstrip(" .")
    return re.sub(r"^\.", "_", made) or "_"
