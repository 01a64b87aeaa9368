"""The pages that the edge of a run serves while it plays: said, and opened where there is a screen."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from share.cli.terminal import LiveLine

if TYPE_CHECKING:
    from share.lab.evaluate.real_time import Pages


def live_pages(live: LiveLine) -> Pages:
    """Return the pages to serve. The first is opened where there is somebody to see it."""
    from share.lab.evaluate.real_time import Pages
    from share.view.viewer import MISSING, is_installed

    has_view = is_installed()
    if not has_view:
        live.print_line(f"share: {MISSING}; there is a plain page")
    opened = "live room" if has_view else "status"

    def show(line: str) -> None:
        live.print_line(line)
        if live.is_terminal and line.startswith(opened) and _has_screen():
            _open_browser(line.split()[-1])

    return Pages(has_view, show)


def _has_screen() -> bool:
    """Return whether a browser could open a window here."""
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _open_browser(url: str) -> None:
    """Open a page without waiting; a browser that fails costs the picture only."""
    import threading
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
