"""The status page: it fetches /snapshot.json three times a second, /plan.json once, and shows them.

Self-contained, for machines without a 3D view and for phones."""

from __future__ import annotations

import json
from pathlib import Path

from share.colours import AGENT_COLOURS, hex_colour
from share.files.reading import MB, read_bytes

_FILE = Path(__file__).with_name("status_page.html")


def status_page() -> bytes:
    """Return the page, HTML. Raises OSError."""
    colours = json.dumps([hex_colour(colour) for colour in AGENT_COLOURS])
    return read_bytes(_FILE, MB).replace(b"%COLOURS%", colours.encode())
