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
    "edge.name_hold_s": "protocol.admission.NAME_HOLD_S",
    "edge.each_waiting": "mapping.query_queue.MAX_WAITING_EACH",
    "edge.hurry_waiting": "mapping.query_queue.HURRY_WAITING",
    "edge.hurry_candidates": "mapping.query_queue.HURRY_CANDIDATES",
    # control
    "control.integral_max_hz": "scheduling.policies.INTEGRAL_MAX_HZ",
    "control.gap_s": "scheduling.policies.GAP_S",
    "control.interval_m": "scheduling.merge_gate.INTERVAL_M",
    # agent
    "agent.rate_burst": "protocol.agent.RATE_BURST",
    "agent.blend_jump_m": "protocol.localisation.BLEND_JUMP_M",
    "agent.blend_jump_rad": "protocol.localisation.BLEND_JUMP_RAD",
    # link
    "link.hello_s": "protocol.agent.HELLO_S",
    "link.refused_s": "protocol.agent.REFUSED_S",
    "link.ping_s": "protocol.edge_clock.PING_S",
    "link.resend_s": "protocol.agent_ledger.RESEND_S",
    "link.resend_max_s": "protocol.agent_ledger.RESEND_MAX_S",
    "link.gap_s": "protocol.agent_ledger.GAP_RESEND_S",
    # stream
    "stream.begin_s": "runtime.frame_consumers.TRACKER_START_S",
    # clock
    "clock.noise_us": "protocol.edge_clock.NOISE_US",
    "clock.asymmetry": "protocol.edge_clock.ASYMMETRY",
    "clock.offset_walk_us": "protocol.edge_clock.OFFSET_WALK_US",
    "clock.drift_walk_ppm": "protocol.edge_clock.DRIFT_WALK_PPM",
    "clock.drift_ppm": "protocol.edge_clock.DRIFT_PPM",
    "clock.least_of": "protocol.edge_clock.LEAST_OF",
    "clock.gate_sigma": "protocol.edge_clock.GATE_SIGMA",
    "clock.step_after": "protocol.edge_clock.STEP_AFTER",
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
