"""Display of a run while it plays: its edge's pages, opened where there is a screen, and the room as text in
a terminal."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from share.cli.terminal import LiveLine

if TYPE_CHECKING:
    from share.cli.terminal_room import TerminalRoom
    from share.lab.evaluate.real_time import Progress, RunPages


class RunScreen:
    """Shows a run. `pages`: the pages that its edge serves; None: none.

    has_pages: print their addresses, and open the first where there is a screen. may_draw: draw the room as
    text where the terminal is large enough, else one line.
    """

    def __init__(self, has_pages: bool, may_draw: bool = True) -> None:
        from share.cli.terminal_room import has_room
        from share.lab.evaluate.real_time import RunPages
        from share.view.viewer import MISSING, is_installed

        self._live = LiveLine()
        self._room: TerminalRoom | None = None
        self._merges_printed = 0
        self._is_text, self._has_pages = may_draw and has_room(self._live), has_pages
        self._has_view = has_pages and is_installed()
        if has_pages and not self._has_view:
            self._live.print_line(f"share: {MISSING}; there is a plain page")
        is_served = has_pages or self._is_text
        self.pages: RunPages | None = RunPages(self._has_view, self._show_page) if is_served else None

    def _show_page(self, line: str) -> None:
        """Take an edge's line that says where a page is."""
        from share.cli.terminal_room import TerminalRoom

        address, is_status = line.split()[-1], line.startswith("status")
        if self._is_text and is_status:
            self._room = TerminalRoom(self._live, address)
        if not self._has_pages:
            return
        self._live.print_line(line)
        if self._live.is_terminal and is_status != self._has_view and _has_screen():
            _open_browser(address)

    def show(self, now: Progress) -> None:
        """Show how far the run is."""
        for line in now.merges[self._merges_printed :]:
            if self._live.is_terminal:
                self._live.print_line(line)
        self._merges_printed = len(now.merges)
        if self._room is None or not self._room.show(str(now)):
            self._live.write(str(now))

    def end(self) -> None:
        """Keep what is shown last."""
        self._live.end()


def _has_screen() -> bool:
    """Return whether a browser could open a window here."""
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _open_browser(url: str) -> None:
    """Open a page without waiting; a browser that fails costs the picture only."""
    import threading
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
