"""Run every tools/experiments/bench_*.py and write their figures to build/bench.json: `make bench`."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from pathlib import Path

TOOLS = Path(__file__).resolve().parent
OUT = TOOLS.parent / "build" / "bench.json"


def main() -> None:
    results = {}
    for script in sorted((TOOLS / "experiments").glob("bench_*.py")):
        print(f"{script.stem} …", file=sys.stderr, flush=True)
        done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{script.name} failed:\n{done.stderr}")
        results[script.stem.removeprefix("bench_")] = json.loads(done.stdout)
    machine = {"python": platform.python_version(), "system": platform.platform()}
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(json.dumps({"machine": machine, **results}, indent=2) + "\n")
    print(OUT.read_text(), end="")


if __name__ == "__main__":
    main()
