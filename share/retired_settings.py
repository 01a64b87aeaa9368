"""Settings of earlier releases that are constants now, and where each is."""

from __future__ import annotations

from typing import Any

from share.errors import ConfigError

# "section.key": "module.CONSTANT", of the modules below `share`
RETIRED_SETTINGS: dict[str, str] = {
    # tracker
    # inertial
    # sequencer
    "sequencer.gap_factor": "sensors.stamps.GAP_FACTOR",
    "sequencer.max_jump_s": "sensors.stamps.MAX_JUMP_S",
    # place
    # graph
    # merge
    # edge
    # control
    # agent
    # link
    # stream
    # clock
}


def refuse_retired(data: Any, where: str) -> None:
    """Raise ConfigError for the first retired setting of a configuration (mapping of sections)."""
    for section, settings in data.items() if isinstance(data, dict) else ():
        for key in settings if isinstance(settings, dict) else ():
            if constant := RETIRED_SETTINGS.get(f"{section}.{key}"):
                module, _, name = constant.rpartition(".")
                place = f"{name} in share/{module.replace('.', '/')}.py"
                raise ConfigError(
                    f"{where}: {section}.{key} is no longer a setting: it is {place}; remove the line"
                )
