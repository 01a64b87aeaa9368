"""What tests ask of map files."""

from __future__ import annotations

from pathlib import Path

from share.errors import StoreError
from share.store.map_store import MapStore


def is_locked(path: Path) -> bool:
    """Return whether an edge, or a room of one, uses the map."""
    try:
        MapStore.open(path).close()
    except StoreError:
        return True
    return False
