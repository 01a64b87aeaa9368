"""What the mapper decides, and tells the edge."""

from __future__ import annotations

from dataclasses import dataclass

from share.types import Correction


@dataclass(frozen=True, eq=False)
class Finding:
    """Something decided about an agent's run, why, and the correction that follows, if one does."""

    agent: str
    what: str
    reason: str
    correction: Correction | None = None
