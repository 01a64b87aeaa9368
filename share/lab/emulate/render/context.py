"""An OpenGL context without a screen (EGL), and one clear line where there can be none."""

from __future__ import annotations

import ctypes
import os
from typing import Any

from share.errors import install_hint
from share.lab.emulate.render.errors import RenderError

_VERSION = 430  # of OpenGL: storage buffers
_EGL, _GL = "libEGL.so.1", "libGL.so.1"  # by name: ctypes finds the unversioned ones by tools that may lack
_ENVIRONMENT = {
    # Mesa's software driver takes a thread a core unless it is told otherwise before the context is
    # made. 0: everything is done in the calling thread; who wants two cores starts two processes.
    "LP_NUM_THREADS": "0",
    # Its look-ups in 8-bit pictures weigh by 8 bits of fraction, four channels at a time: floats are exact
    # and, with one channel, faster.
    "GALLIVM_PERF": "no_aos_sampling",
    "EGL_LOG_LEVEL": "fatal",  # what is missing is said once, by us
}
# Debian's packages by the library that a bare system lacks; the first two bring in the others.
_PACKAGES = {_EGL: "libegl1", _GL: "libgl1", "libEGL_mesa.so.0": "libegl-mesa0"}
_DRIVERS = "libgl1-mesa-dri"


def create_context() -> Any:
    """A moderngl context of this process. Raises RenderError."""
    os.environ.update(_ENVIRONMENT)
    try:
        import moderngl
    except ImportError:
        raise RenderError(install_hint("moderngl", "emulate")) from None
    try:
        options: dict[str, Any] = {"backend": "egl", "libegl": _EGL, "libgl": _GL}
        return moderngl.create_context(require=_VERSION, standalone=True, **options)
    except Exception as e:  # moderngl and its loader raise nothing narrower
        raise RenderError(f"cannot draw without a screen ({e}): {_install_hint()}") from None


def missing_reason() -> str | None:
    """Why no room can be drawn on this machine, in one line; None where one can."""
    try:
        create_context().release()
    except RenderError as e:
        return str(e)
    return None


def _install_hint() -> str:
    absent = [package for library, package in _PACKAGES.items() if not _is_loadable(library)]
    return "apt install " + (" ".join(absent) or f"{_DRIVERS} (or another driver of OpenGL 4.3)")


def _is_loadable(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
