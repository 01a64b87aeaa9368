"""`share edge --blind`: the policy that a study's key has for a letter, shown as the letter."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from share.cli import options
from share.errors import UsageError

if TYPE_CHECKING:
    from share.config import Config
    from share.runtime.blinding import Blinding


def edge_settings(
    config_file: Path | None, policy: str | None, blind: str | None
) -> tuple[Config, Blinding | None]:
    """Return the settings of an edge, and how a blind one shows them.

    policy: --policy. blind: --blind, KEY:LETTER. Raises ConfigError, UsageError."""
    if blind is None:
        return options.load_config(config_file, [policy]), None
    from share.config import STREAMED, Config, with_policy
    from share.files.yaml_file import read_given_settings
    from share.lab.study.plan import read_key, sealed_settings
    from share.runtime.blinding import Blinding

    key_file, colon, letter = blind.rpartition(":")
    if not colon:
        raise UsageError(f"--blind {blind}: expected KEY:LETTER, such as study-key.json:B")
    given: dict[str, Any] = {}
    config = Config()
    if config_file is not None:
        config, given = read_given_settings(config_file)
    if policy is not None or "policy" in given.get("edge", {}):
        raise UsageError("--blind: the key says the policy; leave out --policy, and edge.policy of --config")
    key = read_key(Path(key_file), None)
    if letter not in key.policies:
        raise UsageError(f"--blind {blind}: the key has no '{letter}', only {', '.join(key.policies)}")
    blinded = with_policy(config, key.policies[letter])
    if blinded.edge.policy == STREAMED:
        raise UsageError(f"--blind: condition {letter} builds no map, so no robot drives by it")
    return blinded, Blinding(letter, key.seal(sealed_settings(blinded)))


def condition_text(settings: Config, blinding: Blinding | None) -> str:
    """Return the policy or condition of an edge, as printed at its start."""
    return f"policy {settings.edge.policy}" if blinding is None else f"condition {blinding.label}"
