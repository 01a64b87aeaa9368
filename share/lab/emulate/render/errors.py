"""The error of a machine that cannot draw."""

from __future__ import annotations

from share.errors import ShareError


class RenderError(ShareError):
    """This machine cannot draw a room: a library or a driver is missing."""
