"""A simulated room that tells a live room what happens, as `share.runtime.served_room` does."""

from __future__ import annotations

from collections.abc import Callable

from share.config import Config
from share.lab.evaluate.emulated_network import LinkAssignment
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import Simulation
from share.lab.evaluate.virtual_time import session_members, track_session
from share.protocol import edge_events as ed
from share.recordings.session import Session
from share.runtime.edge_observer import EdgeObserver

_POSES_S, _REPORT_EVERY = 0.05, 10  # as a real edge shows them: poses, and poses between reports


class ObservedSimulation(Simulation):
    """Tells an observer, if there is one."""

    observer: EdgeObserver | None = None

    def _to_edge(self, event: ed.EdgeEvent) -> None:
        super()._to_edge(event)
        if self.observer is not None and isinstance(event, ed.MapperResult):
            self.observer.add_result(event)

    def _on_edge_effect(self, effect: ed.EdgeEffect) -> None:
        if self.observer is not None:
            self.observer.add_effect(effect)

    def play(self, seconds: float, after_poses: Callable[[float], None] = lambda t_s: None) -> None:
        """Run to `seconds`; the observer gets poses twenty times a second, and twice a report.

        after_poses: called with the time after poses were shown.
        """
        for k in range(1, round(seconds / _POSES_S) + 1):
            self.run(k * _POSES_S)
            if self.observer is not None:
                self.observer.add_poses(self.edge.latest_poses())
                if k % _REPORT_EVERY == 0:
                    self.observer.add_report(self.edge.report(self.mapper.report()))
            after_poses(k * _POSES_S)


def observed_simulation(
    session: Session, settings: Config, observer: EdgeObserver | None
) -> ObservedSimulation:
    """Return a room with the agents of a session, which are tracked first."""
    tracked = track_session(
        session.folder.resolve(),
        settings.tracker,
        settings.inertial,
        settings.sequencer,
        settings.agent.error_model,
    )
    members = session_members(session, tracked, LinkAssignment.parse(None))
    room = ObservedSimulation(settings, members, ProcessingDelays(), seed=0)
    room.observer = observer
    if observer is not None:
        observer.begin_session(None, [])
    return room
