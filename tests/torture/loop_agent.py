"""`share agent` for hours: a recording of a closed round again and again.

    python loop_agent.py SESSION/NAME NAME ADDRESS OUT SECONDS

The recording begins and ends at rest at the same place (`soak.py`), so that motion goes on smoothly. All else
is the product.
"""

from __future__ import annotations

import itertools
import secrets
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from share import startup

startup.prepare_process()


from share.config import Config  # noqa: E402
from share.net.transport import connect  # noqa: E402
from share.odometry.error_model.network import open_error_model  # noqa: E402
from share.recordings.recording import Source  # noqa: E402
from share.recordings.trajectory import Trajectory  # noqa: E402
from share.runtime.agent import AgentRun  # noqa: E402
from share.runtime.error_estimators import BackgroundErrorModel  # noqa: E402
from share.runtime.signals import stop_on_signal  # noqa: E402
from share.runtime.source import open_source  # noqa: E402
from share.sensors.measurement import Measurement  # noqa: E402
from share.types import AgentKind  # noqa: E402
from share.wire.messages import Hello  # noqa: E402


class Loop(Source):
    """A recording again and again, until stopped. Its samples are kept; images are decoded anew each time."""

    def __init__(self, source: Source) -> None:
        self.name, self.rig, self.notes, self.serial = source.name, source.rig, source.notes, source.serial
        self._stamps = source.stamps()
        samples = sorted(source.measurements(), key=lambda m: m.stamp_ns)
        images = self._stamps["cam0"]
        self._period_ns = int(images[-1] - images[0] + round(1e9 / self.rate_hz))
        begin_ns = samples[0].stamp_ns
        self._samples = [m for m in samples if m.stamp_ns < begin_ns + self._period_ns]
        self._ending = False

    def stamps(self) -> dict[str, Any]:
        return self._stamps

    def truth(self) -> Trajectory | None:
        return None

    def stop(self) -> None:
        self._ending = True

    def measurements(self) -> Iterator[Measurement]:
        for turn in itertools.count():
            for m in self._samples:
                if self._ending:
                    return
                yield Measurement(m.stream, m.stamp_ns + turn * self._period_ns, m.payload)


def main() -> None:
    where, name, address, out, seconds = sys.argv[1:6]
    source, settings, run_id = Loop(open_source(where)), Config(), secrets.randbits(63)

    def say(text: str) -> None:
        print(f"{time.monotonic():.1f} {text}", file=sys.stderr, flush=True)

    errors = BackgroundErrorModel(open_error_model("shipped"), say)
    hello = Hello(name, AgentKind.AR, run_id, source.rig)
    run = AgentRun(
        source, hello, settings, lambda: connect(address, run_id), Path(out), say, error_estimator=errors
    )

    def end() -> None:
        source.stop()
        run.stop()

    timer = threading.Timer(float(seconds), end)
    timer.daemon = True  # nobody waits for it once the agent has ended
    timer.start()
    with stop_on_signal(end):
        run.run()


if __name__ == "__main__":
    main()
