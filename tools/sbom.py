"""Software bill of materials of the frozen program, as CycloneDX 1.6 in JSON.

    python tools/sbom.py PYTHON OUT

PYTHON is that of the build environment. Packages for building only have the scope `excluded`. The file is
checked against CycloneDX's schema before it is written, and is deterministic for a given environment.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BUILD_ONLY = {
    "pip",
    "setuptools",
    "altgraph",
    "pyinstaller-hooks-contrib",
}  # PyInstaller's bootloader is part of the program
OWN = "share-slam"


def bill(python: str) -> dict[str, Any]:
    """Return the components installed for this interpreter, and the interpreter."""
    command = [str(Path(sys.executable).with_name("cyclonedx-py")), "environment", python]
    more = ("--spec-version", "1.6", "--output-reproducible", "-o", "-")
    found = json.loads(subprocess.run([*command, *more], check=True, capture_output=True).stdout)
    (own,) = (part for part in found["components"] if part["name"] == OWN)
    own.pop("externalReferences", None)  # path of the checkout
    found["components"] = [part for part in found["components"] if part is not own] + [_interpreter(python)]
    found.setdefault("metadata", {})["component"] = own | {"type": "application"}
    for part in found["components"]:
        if part["name"].lower() in BUILD_ONLY:
            part["scope"] = "excluded"
    return dict(found)


def _interpreter(python: str) -> dict[str, Any]:
    code = "import platform; print(platform.python_version())"
    version = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True).stdout.strip()
    licence = [{"license": {"id": "PSF-2.0"}}]
    name = {"type": "platform", "name": "cpython", "version": version, "bom-ref": f"cpython=={version}"}
    return name | {"licenses": licence, "purl": f"pkg:generic/cpython@{version}"}


def faults(text: str) -> str | None:
    """Return what CycloneDX's schema finds wrong, None if nothing."""
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    error = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    return None if error is None else str(error)


def main(python: str, out: Path) -> None:
    text = json.dumps(bill(python), indent=1, sort_keys=True) + "\n"
    if (wrong := faults(text)) is not None:
        sys.exit(f"sbom: not valid CycloneDX: {wrong[:500]}")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text)
    print(f"{out}: {text.count('bom-ref')} components, valid CycloneDX 1.6")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1], Path(sys.argv[2]))
