"""The lock files have all that the frozen program needs, by hash; every licence was checked."""

from __future__ import annotations

import configparser
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
LOCKS = sorted((ROOT / "tools" / "locks").glob("*.txt"))
LICENSES = runpy.run_path(str(ROOT / "tools" / "licenses.py"))
SBOM = ROOT / "tools" / "sbom.py"

each_lock = pytest.mark.parametrize("lock", LOCKS, ids=lambda lock: lock.stem)


def pinned(lock: Path) -> dict[str, str]:
    return dict(re.findall(r"^([\w.-]+)==(\S+)", lock.read_text(), flags=re.MULTILINE))


def required(lock: Path) -> list[Requirement]:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    extras = config["options.extras_require"]
    lines = "\n".join([config["options"]["install_requires"], extras["freeze"], extras["realsense"]])
    all_of = [Requirement(line) for line in lines.splitlines() if line and not line.startswith("#")]
    machine, _, python = lock.stem.partition("-py")
    where = {"platform_machine": machine, "python_version": python}
    return [one for one in all_of if one.marker is None or one.marker.evaluate(where)]


def test_both_processors_have_locks() -> None:
    assert {lock.stem.partition("-")[0] for lock in LOCKS} == {"x86_64", "aarch64"}


@each_lock
def test_locks_hold_the_requirements_of_setup_cfg(lock: Path) -> None:
    have = pinned(lock)
    for one in required(lock):
        assert one.specifier.contains(have[canonicalize_name(one.name)]), f"{one}: run make lock"


@each_lock
def test_every_package_has_hashes_and_no_address(lock: Path) -> None:
    text = lock.read_text()
    parts = re.split(r"^(?=[\w.-]+==)", text, flags=re.MULTILINE)[1:]
    assert len(parts) == len(pinned(lock)) > 30
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", part) for part in parts)
    assert "://" not in text and "--index" not in text and "--find-links" not in text


@each_lock
def test_all_licences_are_listed(lock: Path) -> None:
    page = (ROOT / "docs" / "lookup" / "licenses.md").read_text()
    listed = set(re.findall(r"^\| ([\w.-]+) \| [\d.]", page, flags=re.MULTILINE))
    assert not set(pinned(lock)) - listed, "run make licenses"


def test_licence_page_has_the_versions_of_its_lock() -> None:
    page = (ROOT / "docs" / "lookup" / "licenses.md").read_text()
    rows = dict(re.findall(r"^\| ([\w.-]+) \| ([\w.]+) \|", page, flags=re.MULTILINE))
    have = pinned(ROOT / "tools" / "locks" / "x86_64-py3.11.txt")
    assert {name: rows[name] for name in have} == have, "run make licenses"


@pytest.mark.parametrize("expression", ["", "GPL-3.0-only", "MIT AND AGPL-3.0-only"])
def test_unknown_licence_is_refused(expression: str) -> None:
    with pytest.raises(ValueError, match=r"newcomer: .*read its licence"):
        LICENSES["table"]([("newcomer", "1.0", expression)])


def test_accepted_licence_is_listed() -> None:
    assert "| newcomer | 1.0 | MIT OR Apache-2.0 |  |" in LICENSES["table"](
        [("newcomer", "1.0", "MIT OR Apache-2.0")]
    )


@pytest.mark.slow
def test_bill_of_materials_is_valid(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedx", reason="cyclonedx-bom is not installed: pip install -e '.[release]'")
    subprocess.run([sys.executable, str(SBOM), sys.executable, str(tmp_path / "bom.json")], check=True)
    bom = json.loads((tmp_path / "bom.json").read_text())
    assert (bom["bomFormat"], bom["specVersion"]) == ("CycloneDX", "1.6")
    assert bom["metadata"]["component"]["name"] == "share-slam"
    assert {"numpy", "pyzmq", "cpython"} <= {part["name"] for part in bom["components"]}
    assert str(ROOT) not in json.dumps(bom)
