"""`from share import …`: the names, their types, what an import costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

import share

HEAVY = ["numpy", "cv2", "scipy", "zmq", "click", "yaml", "msgspec", "onnxruntime", "rosbags", "mcap"]
NAMES = {
    "Tracker",
    "Frame",
    "Pose",
    "Rig",
    "load_calibration",
    "open_recording",
    "Agent",
    "Edge",
    "Config",
    "Room",
}


def test_the_interface_has_these_names_and_no_other():
    assert set(share.__all__) == NAMES | {"ShareError"}
    assert set(share._NAMES) == set(share.__all__)
    assert set(share.__all__) <= set(dir(share))


@pytest.mark.parametrize("name", share.__all__)
def test_each_name_is_documented(name):
    assert len((getattr(share, name).__doc__ or "").split()) >= 5


def test_types_and_runtime_agree_on_where_a_name_is():
    """What a type checker reads in `share/__init__.py` is what `__getattr__` imports."""
    import ast
    import inspect

    tree = ast.parse(inspect.getsource(share))
    (block,) = [
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    typed = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == share._NAMES


def test_import_share_imports_nothing_heavy():
    code = f"import share, sys; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_ground_is_quick_to_import():
    """Errors, settings and types without the tracker, a camera or a link."""
    code = (
        "from share import Config, Frame, Rig, ShareError; import sys; "
        "print([m for m in ('cv2', 'scipy', 'zmq', 'click', 'onnxruntime') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Trakcer'"):
        share.Trakcer  # noqa: B018
