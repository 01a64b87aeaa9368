"""Which code made something."""

import shutil
import sys
from pathlib import Path

import share
from share.lab.evaluate.provenance import code_digest


def test_it_is_another_once_a_source_is(tmp_path, monkeypatch):
    copy = tmp_path / "share"
    shutil.copytree(Path(share.__file__).parent / "scheduling", copy / "scheduling")
    (copy / "__init__.py").write_text("")
    monkeypatch.setattr(share, "__file__", str(copy / "__init__.py"))
    states = [code_digest.__wrapped__()]
    states.append(code_digest.__wrapped__())
    (copy / "__init__.py").write_text("changed = True\n")
    states.append(code_digest.__wrapped__())
    (copy / "__init__.py").rename(copy / "other.py")
    states.append(code_digest.__wrapped__())
    assert states[0] == states[1]
    assert len(set(states)) == 3


def test_of_a_frozen_program_it_is_the_program_that_counts(tmp_path, monkeypatch):
    program = tmp_path / "program"
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    monkeypatch.setattr(sys, "executable", str(program))
    states = []
    for content in (b"one", b"two"):
        program.write_bytes(content)
        states.append(code_digest.__wrapped__())
    assert len(set(states)) == 2
