"""A file of settings."""

from __future__ import annotations

from pathlib import Path

from share.config import Config, load
from share.errors import UsageError
from share.io.regular_file import SETTINGS, read_text


def read_settings(path: Path) -> Config:
    """Raises ConfigError that names the key and what would be right, UsageError."""
    try:
        text = read_text(path, SETTINGS)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise UsageError(f"{path}: cannot read the configuration: {reason}") from None
    return load(text, str(path))
