"""The mapper's part of edge.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from share.mapping.atlas import Atlas
from share.mapping.mapper_counters import MapperCounters
from share.mapping.query_queue import QueryQueue


def mapper_report(atlas: Atlas, queries: QueryQueue, counters: MapperCounters) -> dict[str, Any]:
    """Return the mapper's fields of edge.json, and under `agents` those of each run."""
    return {
        "agents": {
            agent: {
                **own.report(),
                "queries_skipped": queries.skipped[agent],
                "map_id": atlas.current_map_id(agent),
                "consistency": asdict(atlas.quarantine.agreement.standing(agent)),
            }
            for agent, own in counters.runs.items()
        },
        "maps": atlas.map_sizes(),
        "waiting": len(queries),
        **counters.report(len(atlas.loop_acceptance.pending), len(atlas.graph.edges.loops)),
    }
