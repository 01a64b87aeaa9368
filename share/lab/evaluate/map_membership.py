"""Which agents share a map with another, by the corrections sent to them."""

from __future__ import annotations

from collections import Counter


class MapMembership:
    """`map_ids`: the map of each agent's last correction, by agent."""

    def __init__(self) -> None:
        self.map_ids: dict[str, str] = {}

    def add_correction(self, agent: str, map_id: str) -> None:
        """Add the next correction, in the order in which they are sent."""
        self.map_ids[agent] = map_id

    @property
    def sharing_agents(self) -> list[str]:
        """Agents that are not alone in their map."""
        members = Counter(self.map_ids.values())
        return [agent for agent, map_id in self.map_ids.items() if members[map_id] > 1]
