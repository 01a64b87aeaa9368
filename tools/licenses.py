"""Licences of the packages in the frozen program: docs/lookup/licenses.md.

    python tools/licenses.py PYTHON PAGE

PYTHON is that of the build environment. A package with a licence that is unknown or not among ACCEPTED is an
error, and the page stays unchanged: read the licence, and add the package to KNOWN.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

MARKER = "<!-- made by make licenses -->"
ACCEPTED = {
    *(
        "MIT",
        "MIT-CMU",
        "0BSD",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "ISC",
        "Apache-2.0",
        "Zlib",
        "CC0-1.0",
        "PSF-2.0",
    ),
}
KNOWN = {  # metadata has other words or none; remarks follow a semicolon
    "altgraph": "MIT; builds only",
    "apsw": "Zlib; metadata says any-OSI; with SQLite (public domain)",
    "contourpy": "BSD-3-Clause",
    "cycler": "BSD-3-Clause",
    "filterpy": "MIT",
    "flatbuffers": "Apache-2.0",
    "fonttools": "MIT",
    "kiwisolver": "BSD-3-Clause",
    "lz4": "BSD-3-Clause",
    "matplotlib": "PSF-2.0; its own licence, in the form of Python's",
    "mcap": "MIT",
    "onnxruntime": "MIT",
    "opencv-python-headless": "Apache-2.0; its wheel brings FFmpeg (LGPL-2.1-or-later): see below",
    "pip": "MIT; builds only",
    "poselib": "BSD-3-Clause",
    "protobuf": "BSD-3-Clause",
    "pyinstaller": "GPL-2.0-or-later WITH Bootloader-exception; **copyleft**: see below",
    "pyinstaller-hooks-contrib": "GPL-2.0-or-later AND Apache-2.0; **copyleft**, builds only: see below",
    "pyrealsense2": "Apache-2.0",
    "pyyaml": "MIT",
    "pyzmq": "BSD-3-Clause; its wheel brings libzmq (MPL-2.0, **copyleft** by file): see below",
    "ruamel-yaml": "MIT",
    "scipy": "BSD-3-Clause",
    "tzdata": "Apache-2.0",
}
_ASK = """import importlib.metadata, json
found = importlib.metadata.distributions()
print(json.dumps([[d.name, d.version, d.metadata.get("License-Expression") or ""] for d in found]))"""


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def licence(name: str, expression: str) -> tuple[str, str]:
    """Return licence and remark. Raises ValueError for a licence that was not reviewed."""
    if (known := KNOWN.get(normalised(name))) is not None:
        stated, _, remark = known.partition("; ")
        return stated, remark
    if not expression or not set(re.split(r" AND | OR |[()]", expression)) - {""} <= ACCEPTED:
        what = f"'{expression}' is not accepted yet" if expression else "its metadata names none"
        raise ValueError(
            f"{name}: {what}; read its licence, then see KNOWN and ACCEPTED in tools/licenses.py"
        )
    return expression, ""


def table(installed: list[tuple[str, str, str]]) -> str:
    """Return one row per package (name, version, licence by its metadata). Raises ValueError as `licence`
    does."""
    rows = ["| package | version | licence | |", "|---|---|---|---|"]
    for name, version, expression in sorted(installed, key=lambda one: normalised(one[0])):
        if normalised(name) != "share-slam":
            stated, remark = licence(name, expression)
            rows.append(f"| {normalised(name)} | {version} | {stated} | {remark} |")
    return "\n".join(rows) + "\n"


def main(python: str, page: Path) -> None:
    answer = subprocess.run([python, "-c", _ASK], check=True, capture_output=True, text=True).stdout
    try:
        made = table([tuple(one) for one in json.loads(answer)])
    except ValueError as error:
        sys.exit(f"licenses: {error}")
    head, marker, _ = page.read_text().partition(MARKER)
    if not marker:
        sys.exit(f"{page}: has no line {MARKER}")
    page.write_text(f"{head}{MARKER}\n\n{made}")
    print(f"{page}: {made.count(chr(10)) - 2} packages")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1], Path(sys.argv[2]))
