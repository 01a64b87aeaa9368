"""Messages between agent and edge, and their bytes (docs/lookup/wire.md)."""
