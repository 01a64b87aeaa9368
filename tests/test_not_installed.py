"""How people are told to get what is missing."""

from __future__ import annotations

import sys

from share.errors import install_hint


def test_what_is_missing_is_told_with_how_to_get_it():
    assert install_hint("moderngl", "emulate") == (
        "moderngl is not installed: pip install 'share-slam[emulate]', "
        "in a checkout .venv/bin/pip install -e '.[emulate]'"
    )


def test_nobody_is_told_to_pip_into_a_frozen_program(monkeypatch):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert "use a computer with Python: pip install 'share-slam[train]'" in install_hint("torch", "train")
