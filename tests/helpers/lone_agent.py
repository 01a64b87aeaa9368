"""An agent's link that does nothing but receive, as a process of its own: `python lone_agent.py ENDPOINT`.

Takes 64 messages in 50 ms at most, as `share agent` does, and says PINGs of its own so that it is known to
live. At its end, when its input is closed, one line of JSON: messages, joined, and what its trouble was.
"""

from __future__ import annotations

import json
import select
import sys
import time

from share.net.transport import connect


def main() -> None:
    link = connect(sys.argv[1], 1)
    messages, joined, said, tick_s = 0, 0, [], 0.0
    print("here", flush=True)
    while not select.select([sys.stdin], [], [], 0)[0]:
        began, taken = time.monotonic(), 0
        while (left_s := began + 0.05 - time.monotonic()) > 0 and taken < 64:
            taken += link.receive(round(1e3 * left_s)) is not None
        messages, tick_s = messages + taken, max(tick_s, time.monotonic() - began)
        time.sleep(max(0.0, began + 0.05 - time.monotonic()))
        link.send([b"hello"])
        joined += link.poll_connected()
        if (trouble := link.trouble()) is not None and trouble not in said:
            said.append(trouble)
    link.close()
    print(json.dumps({"messages": messages, "joined": joined, "said": said, "tick_s": tick_s}), flush=True)


if __name__ == "__main__":
    main()
