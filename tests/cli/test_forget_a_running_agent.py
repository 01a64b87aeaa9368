"""`share dataset forget` while the agents still run: real agents and an edge in virtual time, and its map
file."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner
from helpers.edge_sim import ModelRun, Person, Town, walls

from share.cli.main import cli
from share.config import Config, EdgeConfig
from share.mapping.forgetting import DAY_S
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import restored_runs
from share.store.map_store import MapStore

NOW_S = 1_800_000_000.0


class KeptTown(Town):
    """Ann and bob in one room, and an edge with a map file that ends and starts again."""

    def __init__(self, path: Path) -> None:
        room = walls(3)
        people = [Person("ann", room, 0.0, 11), Person("bob", room, 0.3, 22)]
        super().__init__(people, config=Config(edge=EdgeConfig(policy="covins-g", keep_days=1.0)))
        self.path = path
        self.start(1)

    def start(self, session: int) -> None:
        self.store = MapStore.open(self.path)
        kept = self.store.load()
        assert kept.problems == ()
        self.edge = ModelRun(self.config, session)
        restored = restored_runs(kept, 0.05)
        self.edge.machine = EdgeProtocol(self.config, session, True, restored, forgotten=kept.forgotten)
        if kept.runs:
            self.edge.mapper.restore(kept)

    def stop(self) -> None:
        self.store.close()
        self.edge = None

    def save(self, edge: ModelRun, effect: ed.SaveChanges) -> None:
        self.store.write(effect.changes)
        self._in(0, lambda: self.to_edge(ed.ChangesSaved(effect.ticket)) if self.edge is edge else None)

    def kept(self, name: str) -> set[int]:
        """Ids of an agent's keyframes in the file."""
        with MapStore.read(self.path) as store:
            return {k.keyframe_key.id for k in store.load().keyframes if k.run_key.startswith(f"{name}-")}


def test_a_forgotten_agent_that_still_runs_brings_back_nothing(tmp_path: Path) -> None:
    town = KeptTown(tmp_path / "room.sqlite")
    town.walk(12)
    town.run(500)
    town.stop()
    assert town.kept("ann") == town.kept("bob") == set(range(12))
    town.walk(3)  # it keeps these, no edge has seen them
    result = CliRunner().invoke(cli, ["dataset", "forget", str(town.path), "--agent", "ann", "--yes"])
    assert result.exit_code == 0, result.output
    for session in (2, 3):  # the second start finds a run that goes on
        town.start(session)
        town.walk(5)
        town.run(1000)
        town.stop()
    assert town.kept("ann") == set(range(12, 25))
    assert town.kept("bob") == set(range(25))
    report = town.agents[town.peer("ann")].report()
    assert report["unacknowledged"] == report["pending"] == 0
    (ann, bob) = (town.event(ev.LocalisedPose, name)[-1].map_id for name in ("ann", "bob"))
    assert ann == bob  # they found each other again


def test_what_expired_does_not_come_back_with_a_restart(tmp_path: Path) -> None:
    town = KeptTown(tmp_path / "room.sqlite")
    town.walk(8)
    town.run(500)
    assert town.edge is not None
    for now_s in (NOW_S, NOW_S + DAY_S):
        town.to_edge(ed.MapperResult(tuple(town.edge.mapper.expire(now_s)), town.edge.mapper.take_changes()))
    assert town.kept("ann") == town.kept("bob") == set()
    town.stop()
    town.start(2)
    town.walk(4)
    town.run(1000)
    town.stop()
    assert town.kept("ann") == town.kept("bob") == set(range(8, 12))
