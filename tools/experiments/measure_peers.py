"""Basalt and SHARE's inertial tracker on the same emulated sequences. Prints a Markdown table.

    python -m venv DIR && DIR/bin/pip install depthai==3.12.0
    python tools/experiments/measure_peers.py --peer basalt=DIR/bin/python [--only NAME] [--seeds 101,102,103]

`share evaluate compare` on the sequences of measure_vio, which are made if missing. Runs are kept in --out;
docs/do/compare-trackers.md has a table and the limits of the comparison.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from share import startup

startup.prepare_process()

import vio_options  # noqa: E402
from tool_main import exit_code  # noqa: E402
from vio_kept import code_version  # noqa: E402

from share.cli.compare_trackers import peer_interpreters  # noqa: E402
from share.config import Config  # noqa: E402
from share.files.writing import atomic_write, writable_dir  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.lab.evaluate.peer_comparison import markdown, tracker_entries, tracker_rows  # noqa: E402
from share.runtime.source import open_source  # noqa: E402


def main() -> int:
    parser = vio_options.parser(__doc__, "peers", (101,))
    parser.add_argument("--peer", action="append", default=[], metavar="NAME=PYTHON", help="may be repeated")
    parser.add_argument("--vocabulary", type=Path, metavar="FILE", help="for ORB-SLAM3")
    options = parser.parse_args()
    return exit_code("measure_peers", lambda: measure(options))


def measure(options: argparse.Namespace) -> None:
    """Do all runs, seed by seed; then print the table."""
    (ours, *others), lacking = tracker_entries(
        Config(), peer_interpreters(options.peer), options.needs_vocabulary
    )
    trackers = [replace(ours, identity={**ours.identity, "code": code_version()}), *others]
    for text in lacking:
        print(f"left out: {text}", file=sys.stderr)
    chosen, found = vio_options.chosen(options), []
    writable_dir(options.out)
    for seed in options.seeds:
        for sequence in chosen:
            recipe = sequence.recipe(seed, options.data)
            source = open_source(str(make_cached_session(recipe, options.cache, options.workers) / "agent"))
            for tracker in trackers:
                name = f"{sequence.name}-{seed}"
                if options.again:
                    (options.out / f"{name}-{tracker.key}.json").unlink(missing_ok=True)
                found += tracker_rows(name, source, tracker, options.out, lambda done: None)
    text = markdown(found, lacking)
    print(text)
    atomic_write(options.out / "table.md", text)


if __name__ == "__main__":
    sys.exit(main())
