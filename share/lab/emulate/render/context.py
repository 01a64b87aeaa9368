"""Create an OpenGL context without a display (EGL), or say in one line why there can be none."""

from __future__ import annotations

import ctypes
import os
from typing import Any

from share.errors import ShareError, install_hint


class RenderError(ShareError):
    """This machine cannot draw a room: a library or a driver is missing."""


_VERSION = 430  # of OpenGL, for storage buffers
_EGL, _GL = "libEGL.so.1", "libGL.so.1"  # by name: ctypes finds the unversioned ones by tools that may lack
_ENVIRONMENT = {
    # Mesa's software driver uses a thread per core unless set otherwise before the context is created. 0:
    # everything runs in the calling thread; to use two cores, start two processes.
    "LP_NUM_THREADS": "0",
    # With 8-bit textures the software driver interpolates with 8 bits of fraction, four channels at a time;
    # float textures are exact and, with one channel, faster.
    "GALLIVM_PERF": "no_aos_sampling",
    "EGL_LOG_LEVEL": "fatal",  # missing libraries are reported once, below
}
# Debian packages by the library that may be missing; the first two install the others.
_PACKAGES = {_EGL: "libegl1", _GL: "libgl1", "libEGL_mesa.so.0": "libegl-mesa0"}
_DRIVERS = "libgl1-mesa-dri"


def create_context() -> Any:
    """Create a moderngl context in this process. Raises RenderError."""
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
    """Return why this machine cannot draw, in one line; None if it can."""
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
