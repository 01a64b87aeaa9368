"""Read the poses of a running agent. Needs Python alone: copy this file to where the poses are used.

share agent room1/ann --name ann --kind ar --edge tcp://127.0.0.1:5555 --poses udp://127.0.0.1:5570
python examples/read_poses.py 5570
"""

import json
import socket
import sys
from collections.abc import Iterator


def poses(port: int, timeout_s: float = 10.0) -> Iterator[dict]:
    """Yield each message (docs/do/integrate.md) until none has come for `timeout_s`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", port))
        listener.settimeout(timeout_s)
        while True:
            try:
                message = json.loads(listener.recv(2048))
            except TimeoutError:
                return
            if message["schema"] == 3:  # another number: keys have another meaning
                yield message


if __name__ == "__main__":
    for message in poses(int(sys.argv[1]) if len(sys.argv) > 1 else 5570):
        frame = "map" if message["map"] else "odom"
        pose = message[frame]
        if pose is None:
            print(message["agent"], message["state"], flush=True)
        else:
            where = " ".join(f"{value:7.3f}" for value in pose["position"])
            velocity = message["odom"]["velocity"]
            print(message["agent"], message["state"], frame, where, "m ", velocity, "m/s", flush=True)
