"""`share agent` for hours: a recording to and fro, so that motion goes on smoothly.

    python loop_agent.py SESSION/NAME NAME ADDRESS OUT SECONDS

Played backwards, the gyroscope's sign turns and the accelerometer's does not: acceleration is the second
derivative of time. (The gyroscope's bias turns too, so each turn is a step of it.) All else is the product.
"""

from __future__ import annotations

import secrets
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from share import process

process.prepare()

import numpy as np  # noqa: E402

from share.config import Config  # noqa: E402
from share.core.measurement import IMU, Measurement  # noqa: E402
from share.io.network import error_model  # noqa: E402
from share.io.recording import Source  # noqa: E402
from share.io.source import open_source  # noqa: E402
from share.io.trajectory import Trajectory  # noqa: E402
from share.io.transport import connect  # noqa: E402
from share.run.agent import AgentRun  # noqa: E402
from share.run.errors import ByModel  # noqa: E402
from share.run.stop import on_stop  # noqa: E402
from share.types import AgentKind  # noqa: E402
from share.wire.messages import Hello  # noqa: E402


class Loop(Source):
    """A recording to and fro, until stopped. Its samples are kept; images are decoded anew each time."""

    def __init__(self, source: Source) -> None:
        self.name, self.rig, self.notes, self.serial = source.name, source.rig, source.notes, source.serial
        self._stamps = source.stamps()
        self._samples = sorted(source.measurements(), key=lambda m: m.stamp_ns)
        self._ending = False

    def stamps(self) -> dict[str, Any]:
        return self._stamps

    def truth(self) -> Trajectory | None:
        return None

    def stop(self) -> None:
        self._ending = True

    def measurements(self) -> Iterator[Measurement]:
        first, last = self._samples[0].stamp_ns, self._samples[-1].stamp_ns
        step = round(1e9 / self.rate_hz)
        start = first
        while not self._ending:
            for m in self._samples:
                yield Measurement(m.stream, start + m.stamp_ns - first, m.payload)
            start += last - first + step
            for m in reversed(self._samples):
                yield Measurement(m.stream, start + last - m.stamp_ns, _backwards(m))
            start += last - first + step


def _backwards(m: Measurement) -> Any:
    if m.stream != IMU:
        return m.payload
    values = np.array(m.payload, float)
    values[:3] *= -1
    return tuple(values.tolist())


def main() -> None:
    where, name, address, out, seconds = sys.argv[1:6]
    source, settings, run_id = Loop(open_source(where)), Config(), secrets.randbits(63)

    def say(text: str) -> None:
        print(f"{time.monotonic():.1f} {text}", file=sys.stderr, flush=True)

    errors = ByModel(error_model(settings.agent.error_model), say)
    hello = Hello(name, AgentKind.AR, run_id, source.rig)
    run = AgentRun(source, hello, settings, lambda: connect(address, run_id), Path(out), say, errors=errors)

    def end() -> None:
        source.stop()
        run.stop()

    timer = threading.Timer(float(seconds), end)
    timer.daemon = True  # nobody waits for it once the agent has ended
    timer.start()
    with on_stop(end):
        run.go()


if __name__ == "__main__":
    main()
