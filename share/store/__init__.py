"""The edge's map on disk, an SQLite file (docs/lookup/map-file.md)."""
