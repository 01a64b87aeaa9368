"""What an edge says of its policy in a blind study: the letter of the condition, and nothing else.

All that an edge tells of itself comes from its report (edge.json, /snapshot.json, /metrics, the pages), which
is covered in one place. Its configuration is shown as a digest, salted so that no list of guesses finds it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Blinding:
    """label: shown in place of the policy's name. seal: salted digest of the configuration."""

    label: str
    seal: str

    def covered(self, report: dict[str, Any]) -> dict[str, Any]:
        """Return the report of an edge (edge.json) without its policy and configuration."""
        return report | {"policy": self.label, "config": {"sealed_sha256": self.seal}}
