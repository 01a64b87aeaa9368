"""Machines that cannot draw: libraries are missing, in a process of its own."""

import os
import subprocess
import sys

import pytest
from helpers.rendered import needs_opengl

ASK = "from share.lab.emulate.render.context import missing_reason; print(missing_reason())"
DRAW = (
    "from share.lab.emulate.render.context import create_context as make; print(make().info['GL_RENDERER'])"
)


def answer(code, **environment):
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, timeout=60
    )
    return done.stdout.strip(), done.stderr.strip()


@needs_opengl
def test_a_machine_that_can_draw_has_nothing_missing():
    assert answer(ASK) == ("None", "")


@needs_opengl
@pytest.mark.parametrize(
    ("library", "package"),
    [("libEGL.so.1", "libegl1"), ("libGL.so.1", "libgl1"), ("libEGL_mesa.so.0", "libegl-mesa0")],
)
def test_a_missing_library_names_its_package(tmp_path, library, package):
    (tmp_path / library).touch()  # found first, and no library
    said, stderr = answer(ASK, LD_LIBRARY_PATH=str(tmp_path))
    assert said.endswith(f"apt install {package}") and "\n" not in said and not stderr
    _, stderr = answer(DRAW, LD_LIBRARY_PATH=str(tmp_path))
    assert stderr.splitlines()[-1].startswith("share.lab.emulate.render.context.RenderError: ")


@needs_opengl
def test_all_that_is_missing_is_named(tmp_path):
    for library in ("libEGL.so.1", "libGL.so.1"):
        (tmp_path / library).touch()
    assert answer(ASK, LD_LIBRARY_PATH=str(tmp_path))[0].endswith("apt install libegl1 libgl1")


@needs_opengl
def test_a_missing_driver_is_named(tmp_path):
    said, stderr = answer(ASK, LIBGL_DRIVERS_PATH=str(tmp_path))
    assert "apt install libgl1-mesa-dri" in said and "\n" not in said and not stderr


def test_a_missing_moderngl_names_the_extra():
    hide = f"import sys; sys.modules['moderngl'] = None; {ASK}"  # as Python marks what is not there
    said, stderr = answer(hide)
    assert said.startswith("moderngl is not installed: pip install 'share-slam[emulate]'") and not stderr


@needs_opengl
def test_the_driver_draws_in_the_calling_thread():
    names = "[open(f'/proc/self/task/{t}/comm').read() for t in os.listdir('/proc/self/task')]"
    said, _ = answer(f"import os; {DRAW}; print({names})", LP_NUM_THREADS="7")
    assert "llvmpipe-" not in said.splitlines()[-1]
