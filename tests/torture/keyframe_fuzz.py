"""Mutated keyframes straight into the edge's code (`inner_edge.py`), beside two honest agents: a process.

    python keyframe_fuzz.py CASES [--seed S] [--work-every N]

Prints JSON. Half of the mutated keyframes, or so, are refused by the decoder or at intake; the others are
described, queried, verified, aligned and solved.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections import Counter
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).resolve().parents[1])]

from share import startup  # noqa: E402

startup.prepare_process()

import numpy as np  # noqa: E402
from inner_edge import BYE, PING, PLACES, STEP_NS, InnerEdge, PictureAgent, joint_error_m, said  # noqa: E402
from keyframe_mutations import mutate_keyframe  # noqa: E402
from mutations import mutate  # noqa: E402
from raw_wire import Message  # noqa: E402

HONEST_EVERY = 6  # cases
RUN_LENGTH = 60  # keyframes, after which the attacker goes on as another run
VALID, ANY_FORM = 0.2, 0.1  # the shares of its messages that are as they should be, and mutated in form too
LEAP = 70  # ids: a run that leapt so far is given up


class KeyframeFuzz:
    """honest: two agents that walk; the attacker walks with them under ever new runs, by names of one key."""

    def __init__(self, seed: int) -> None:
        self.edge, self._draw = InnerEdge(), random.Random(seed)
        self.honest = [PictureAgent("hope", 1, 0), PictureAgent("faith", 2, 9)]
        for agent in self.honest:
            self.edge.hear(agent.peer, said(agent.hello))
        self._walked = 0
        self._runs = 0
        self._eve = self._new_run()
        self.counts: Counter[str] = Counter()
        self.not_finite = 0

    def settle(self) -> None:
        """The honest agents meet before anybody attacks."""
        for _ in range(30):
            self._walk()

    def run(self, cases: int, work_every: int) -> None:
        """work_every: cases, after which the mapper has its turn; the honest agents walk on before."""
        for case in range(cases):
            if case % (HONEST_EVERY * work_every) == 0:
                self._walk()
            elif case % HONEST_EVERY == 0:
                for agent in self.honest:
                    self.edge.hear(agent.peer, PING)
            self._attack()
            if case % work_every == 0:
                self.edge.work(most=30)
                self._check()
            self.edge.tick(STEP_NS)

    def result(self) -> dict[str, Any]:
        raised = Counter((one.call, one.text, one.is_guarded) for one in self.edge.raised)
        return {
            **self.counts,
            "runs": self._runs,
            "raised": [[*key, n] for key, n in raised.most_common(20)],
            "unguarded": sum(n for (*_, is_guarded), n in raised.items() if not is_guarded),
            "cpu_ms": {call: round(ms, 1) for call, (ms, _) in self.edge.cpu_ms.items()},
            "not_finite": self.not_finite,
            "honest_error_m": round(joint_error_m(self.edge, self.honest), 5),
            "maps": len(self.edge.mapper.atlas.map_sizes()),
            "keyframes": len(self.edge.poses()),
            "events": dict(self.edge.events),
        }

    def _walk(self) -> None:
        for agent in self.honest:
            self.edge.hear(agent.peer, said(agent.keyframe(self._walked)))
            self.edge.work(most=30)
        self._walked += 1
        self.edge.tick(STEP_NS)

    def _attack(self) -> None:
        k = self.edge.acked.get(self._eve.peer, 0)
        if k >= RUN_LENGTH or k > len(self._eve) + LEAP:
            self.edge.hear(self._eve.peer, BYE)
            self._eve, k = self._new_run(), 0
        self.edge.hear(self._eve.peer, self._mutated(said(self._eve.keyframe(k))))
        self.counts["cases"] += 1
        self.counts["applied"] += self.edge.acked.get(self._eve.peer, 0) > k

    def _mutated(self, message: Message) -> Message:
        if self._draw.random() < VALID:
            return message
        for _ in range(self._draw.choice((1, 1, 2))):
            message = mutate_keyframe(self._draw, message)
        return mutate(self._draw, message) if self._draw.random() < ANY_FORM else message

    def _new_run(self) -> PictureAgent:
        self._runs += 1
        start = self._draw.randrange(PLACES)
        agent = PictureAgent(f"eve{self._runs % 20}", 1000 + self._runs, start)
        self.edge.keys[agent.hello.name] = "eve's"
        self.edge.hear(agent.peer, said(agent.hello))
        return agent

    def _check(self) -> None:
        poses = [pose for pose, _ in self.edge.poses().values()]
        self.not_finite += not np.isfinite(poses).all()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--work-every", type=int, default=1)
    args = parser.parse_args()
    fuzz = KeyframeFuzz(args.seed)
    fuzz.settle()
    fuzz.run(args.cases, args.work_every)
    print(json.dumps(fuzz.result()))


if __name__ == "__main__":
    main()
