"""An edge in this process, as `share edge` runs it: a thread here, and a process for the mapper."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from share.config import POLICY_NAMES, STREAMED, Config, with_policy
from share.errors import UsageError
from share.library.background import BackgroundRun
from share.library.checked_input import checked_call, checked_config, checked_kind, checked_path
from share.net.keys import allowed_without_keys, edge_keys_for
from share.net.transport import bind, parse_address
from share.runtime.edge import EdgeRun
from share.store.map_store import MapStore
from share.wire.layouts import MAX_FRAME_BYTES, MAX_IMAGE_BYTES

logger = logging.getLogger("share")


class EdgeThread(BackgroundRun):
    """One run of an edge. Use it as a context manager, or call `start` and `stop`. endpoint: the address that
    agents connect to.

    Its mapper is a process that imports the program anew, so the program must start the edge under
    `if __name__ == "__main__":`.
    """

    def __init__(
        self,
        address: str = "tcp://127.0.0.1:5555",
        *,
        policy: str | None = None,
        map_file: str | Path | None = None,
        config: Config | None = None,
        keys: str | Path | None = None,
        out: str | Path | None = None,
        allow: Collection[str] = (),
        on_event: Callable[[dict[str, Any]], None] = lambda event: None,
    ) -> None:
        """address: to listen at; port 0 takes a free one. policy, map_file, keys, out, allow: as of `share
        edge`.
        on_event: called from the edge's thread with each decision (events.jsonl); must not wait. Raises
        ShareError."""
        if getattr(multiprocessing.current_process(), "_inheriting", False):
            raise UsageError(
                'start an edge under `if __name__ == "__main__":`; its mapper imports this program'
            )
        settings = checked_config(config)
        if policy is not None:
            if policy not in POLICY_NAMES:
                raise UsageError(f"policy {policy!r:.40} is not known; known: {', '.join(POLICY_NAMES)}")
            settings = with_policy(settings, policy)
        is_streamed = settings.edge.policy == STREAMED
        if is_streamed and map_file is not None:
            raise UsageError("map_file: policy streamed builds no map; leave it out, or take another policy")
        own_keys = edge_keys_for(
            None if keys is None else checked_path("keys", keys),
            parse_address(checked_kind("address", address, str, "text"), bind=True).local,
        )
        own_out = None if out is None else checked_path("out", out)
        checked_call("on_event", on_event)
        allowed = allowed_without_keys(allow, own_keys is not None)
        self._error: BaseException | None = None
        self._report: dict[str, Any] = {}
        with contextlib.ExitStack() as stack:
            link = bind(address, own_keys, MAX_IMAGE_BYTES if is_streamed else MAX_FRAME_BYTES)
            stack.callback(link.close)
            self.endpoint = link.endpoint
            store = None
            if map_file is not None:
                store = MapStore.open(checked_path("map_file", map_file))
                stack.callback(store.close)
            self._run = EdgeRun(settings, link, own_out, on_event, store, allowed=allowed)
            stack.callback(self._run.close)
            self._resources = stack.pop_all()
        self._thread = threading.Thread(target=self._run_to_end, name="edge", daemon=True)

    def start(self) -> None:
        """Begin to answer agents, once. Returns at once. Raises ShareError the second time."""
        if self._thread.ident is not None:
            raise UsageError("this edge was started before; make another for another run")
        self._thread.start()

    def stop(self) -> dict[str, Any]:
        """End, once the map is saved, and return the report (edge.json). Raises the ShareError of what could
        not be written, if something could not."""
        self._run.stop()
        if self._thread.ident is not None:
            self._thread.join()
        self._resources.close()
        if self._error is not None:
            raise self._error
        return self._report

    def report(self) -> dict[str, Any]:
        """Return the report (edge.json) as it is now, at most 0.1 s old; empty before the first. `trouble`:
        lines on what is wrong."""
        return self._run.report()

    def _run_to_end(self) -> None:
        try:
            self._report = self._run.run()
        except BaseException as error:
            self._error = error
