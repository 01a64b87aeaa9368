"""Figures of matplotlib as PNG files."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

from share.io.files import atomic_write


def save(figure: Any, path: Path, dpi: int) -> None:
    """Whole or not at all, and its memory is given back. Raises as `atomic_write`."""
    from matplotlib import pyplot

    try:
        data = BytesIO()
        figure.savefig(data, dpi=dpi, format="png")
    finally:
        pyplot.close(figure)
    atomic_write(path, data.getvalue())
