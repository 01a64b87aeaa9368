"""An OpenGL context without a screen (EGL), and one clear line where there can be none."""

from __future__ import annotations

import os
from typing import Any

from share.emulate.render.errors import RenderError

_GL = 430  # storage buffers
_THREADS = "LP_NUM_THREADS"


def create() -> Any:
    """A moderngl context of this process. Raises RenderError.

    Mesa's software driver takes a thread a core unless told otherwise before the context is made. Here
    it takes none (0: all is done in the calling thread): who wants two cores starts two processes.
    """
    os.environ[_THREADS] = "0"
    try:
        import moderngl
    except ImportError:
        raise RenderError("moderngl is not installed: pip install 'share-slam[emulate]'") from None
    try:
        return moderngl.create_context(standalone=True, backend="egl", require=_GL)
    except Exception as e:
        raise RenderError(f"no OpenGL context can be made ({e}): apt install libegl1 libgl1") from None
