"""The edge's map on disk."""

from share.io.map_store.connect import is_map
from share.io.map_store.store import MapStore

__all__ = ["MapStore", "is_map"]
