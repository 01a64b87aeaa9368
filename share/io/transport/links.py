"""Which emulated network each agent of a session goes through, as a person writes it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from share.core.channel import NETWORKS, Network
from share.errors import UsageError
from share.io.transport.shaped import network


@dataclass(frozen=True)
class Links:
    """Names or files. usual: for who has none of its own; None: this machine's own. own: by agent."""

    usual: str | None
    own: Mapping[str, str]

    @classmethod
    def parse(cls, text: str | None) -> Links:
        """`wifi5`, all; `wifi5,bob=wifi-busy`, all but Bob; `bob=far.yaml`, Bob alone.

        Raises UsageError or ConfigError where one of them is no network.
        """
        if text is None:
            return cls(None, {})
        if text in NETWORKS or Path(text).is_file():  # a file's name may have any character
            pairs = [("", text)]
        else:
            pairs = [_pair(part.strip()) for part in text.split(",")]
        for _, name in pairs:
            network(name)
        whose = [agent for agent, _ in pairs]
        if twice := [agent for agent in whose if whose.count(agent) > 1]:
            raise UsageError(f"--link: two for {twice[0] or 'all'}; give one, and others as AGENT=LINK")
        own = dict(pairs)
        return cls(own.pop("", None), own)

    def check(self, agents: Collection[str]) -> None:
        """Raises UsageError where a link is that of an agent who is not there."""
        if unknown := [name for name in self.own if name not in agents]:
            raise UsageError(f"--link: no agent is called '{unknown[0]}'; there are {', '.join(agents)}")

    def of(self, agent: str) -> str | None:
        return self.own.get(agent, self.usual)

    def network(self, agent: str) -> Network:
        """One without limits where it has no link."""
        name = self.of(agent)
        return Network() if name is None else network(name)


def _pair(part: str) -> tuple[str, str]:
    """An agent, "" for all, and its network."""
    agent, found, name = part.partition("=")
    return (agent, name) if found else ("", part)
