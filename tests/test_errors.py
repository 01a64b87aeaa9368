"""Advice on how to install a missing package."""

from __future__ import annotations

import sys

from share.errors import install_hint


def test_missing_package_is_reported_with_install_advice():
    assert install_hint("moderngl", "emulate") == (
        "moderngl is not installed: pip install 'share-slam[emulate]', "
        "in a checkout .venv/bin/pip install -e '.[emulate]'"
    )


def test_frozen_program_gets_no_pip_advice(monkeypatch):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert "use a computer with Python: pip install 'share-slam[train]'" in install_hint("torch", "train")
