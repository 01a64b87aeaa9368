"""A front that does nothing but answer, as a process of its own: `python echo_edge.py [KEYS]`.

Says its endpoint, then sends back whatever an agent sends; SIGINT ends it as it ends `share edge`. At its end
one line of JSON: messages, strangers, and what it said of whom it did not let in.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from share.net.keys import edge_keys
from share.net.transport import bind
from share.runtime.signals import stop_on_signal


def main() -> None:
    keys = edge_keys(Path(sys.argv[1])) if len(sys.argv) > 1 else None
    link = bind("tcp://127.0.0.1:0", keys)
    print(link.endpoint, flush=True)
    stopping: list[bool] = []
    messages, said = 0, set()

    def stop() -> None:
        stopping.append(True)
        link.wake()

    with stop_on_signal(stop):
        while not stopping:
            arrival = link.receive(50)
            if arrival is not None:
                messages += 1
                link.send(arrival.peer, arrival.frames)
            said.update(link.refusals())
    strangers = link.discarded_messages  # type: ignore[attr-defined]
    link.close()
    print(json.dumps({"messages": messages, "strangers": strangers, "said": sorted(said)}), flush=True)


if __name__ == "__main__":
    main()
