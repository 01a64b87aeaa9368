"""What `share edge` and `share site` print at their end."""

from __future__ import annotations

from helpers.many_runs import stored_map

from share.cli.edge_output import run_summary
from share.config import Config, EdgeConfig
from share.mapping.mapper import Mapper
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import restored_runs


def test_the_summary_has_a_line_for_each_run_listed_and_one_for_the_rest() -> None:
    config, stored = Config(edge=EdgeConfig(max_agents=4)), stored_map(60, 30)
    edge, mapper = EdgeProtocol(config, 7, True, restored_runs(stored, 1.0)), Mapper(config)
    mapper.restore(stored)
    lines = run_summary(edge.report(mapper.report())).splitlines()
    assert lines[-2:] == ["and 44 earlier runs", "loops: 0 tried, 0 accepted; 0 merges"]
    assert len(lines) == 16 + 2 and all(line.startswith("n") for line in lines[:16])
