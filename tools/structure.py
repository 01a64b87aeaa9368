"""The size and shape of the house in figures, as Markdown or JSON.

    python tools/structure.py [--json] [--list] [--trace SESSION]

Lines, files and modules of product (`share` without `share.lab`) and laboratory, modules with a single
importer, class names used twice, long functions, configuration keys, size of the pages. --trace: of a session
with at least two agents, tracked and played in virtual time: how many packages, modules and functions one
frame enters in the tracker, and one keyframe in the mapper (medians).
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import statistics
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LONG_FUNCTION = 40  # lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--list", action="store_true", help="name what is counted, one a line")
    parser.add_argument("--trace", type=Path, metavar="SESSION")
    options = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    figures = count_tree(options.list) | ({} if options.trace is None else trace(options.trace))
    if options.json:
        print(json.dumps(figures, indent=2))
    else:
        print(
            "\n".join(
                ["| what | |", "|---|---|", *(f"| {name} | {value} |" for name, value in figures.items())]
            )
        )


def count_tree(listed: bool) -> dict[str, int]:
    modules = {module_name(path): path for path in sorted((ROOT / "share").rglob("*.py"))}
    trees = {name: ast.parse(path.read_text()) for name, path in modules.items()}
    lines = {
        name: 0 if is_docstring_only(trees[name]) else len(path.read_text().splitlines())
        for name, path in modules.items()
    }
    lab = {name for name in modules if name.startswith("share.lab")}
    importers = defaultdict(set)
    for name, tree in trees.items():
        for target in imported(tree, modules.keys()):
            importers[target].add(name)
    single = {name: names.pop() for name, names in importers.items() if len(names) == 1}
    homonyms = {name: places for name, places in class_places(trees).items() if len(places) > 1}
    long_functions = {
        f"{name}.{node.name}": length
        for name, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (length := (node.end_lineno or 0) - node.lineno + 1) > LONG_FUNCTION
    }
    if listed:
        print_lists(lines, single, homonyms, long_functions)
    return {
        "product: lines": sum(n for name, n in lines.items() if name not in lab),
        "product: modules": sum(bool(n) for name, n in lines.items() if name not in lab),
        "laboratory: lines": sum(lines[name] for name in lab),
        "laboratory: modules": sum(bool(lines[name]) for name in lab),
        "modules over 400 lines": sum(n > 400 for n in lines.values()),
        "modules with one importer": len(single),
        "... of fewer than 60 lines": sum(lines[name] < 60 for name in single),
        "class names used twice or more": len(homonyms),
        f"functions over {LONG_FUNCTION} lines": len(long_functions),
        "configuration keys": configuration_keys(),
        "pages: kB": sum(path.stat().st_size for path in (ROOT / "docs").rglob("*.md")) // 1000,
        "tests: lines": sum(len(p.read_text().splitlines()) for p in (ROOT / "tests").rglob("*.py")),
        "tools: lines": sum(len(p.read_text().splitlines()) for p in (ROOT / "tools").rglob("*.py")),
    }


def class_places(trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return the modules that define a class of each name; a leading _ does not make it another name."""
    out = defaultdict(list)
    for name, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                out[node.name.lstrip("_")].append(name)
    return out


def print_lists(
    lines: dict[str, int],
    single: dict[str, str],
    homonyms: dict[str, list[str]],
    long_functions: dict[str, int],
) -> None:
    for name in sorted(single, key=lambda name: lines[name]):
        print(f"one importer, {lines[name]} lines: {name} <- {single[name]}")
    for name, places in homonyms.items():
        print(f"class {name}: {', '.join(places)}")
    for name, length in sorted(long_functions.items(), key=lambda item: -item[1]):
        print(f"{length} lines: {name}")
    print()


def is_docstring_only(tree: ast.Module) -> bool:
    """Whether it introduces a package and holds no code."""
    return all(isinstance(node, ast.Expr) for node in tree.body)


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported(tree: ast.Module, known: Any) -> Iterator[str]:
    """Modules of ours that this one imports, at any place."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                if full in known:
                    yield full
                elif node.module in known:
                    yield node.module


def configuration_keys() -> int:
    from share.config import Config

    return sum(len(dataclasses.fields(getattr(Config(), field.name))) for field in dataclasses.fields(Config))


class CallRecorder:
    """The functions of `share` that are entered while it is on."""

    def __init__(self) -> None:
        self.entered: set[tuple[str, str]] = set()

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and "/share/" in path and not frame.f_code.co_name.startswith("<"):
            self.entered.add((path.partition("/share/")[2], frame.f_code.co_qualname))

    @contextmanager
    def on(self) -> Iterator[None]:
        sys.setprofile(self)
        try:
            yield
        finally:
            sys.setprofile(None)


def trace(session: Path) -> dict[str, int]:
    return medians("one frame", trace_frames(session)) | medians("one keyframe", trace_keyframes(session))


def medians(what: str, entered: list[set[tuple[str, str]]]) -> dict[str, int]:
    """Return the median number of packages, modules and functions that a frame or keyframe entered."""
    kinds: dict[str, Callable[[tuple[str, str]], object]] = {
        "packages": lambda call: call[0].rpartition("/")[0],
        "modules": lambda call: call[0],
        "functions": lambda call: call,
    }
    return {
        f"{what} enters: {kind}": round(statistics.median(len({key(c) for c in calls}) for calls in entered))
        for kind, key in kinds.items()
    }


def trace_frames(session: Path) -> list[set[tuple[str, str]]]:
    """Return what each frame of the first agent enters, once it has a pose."""
    from share.config import Config
    from share.recordings.session import read_session
    from share.runtime.pipeline import make_tracker, read_frames
    from share.runtime.source import open_source
    from share.sensors.sequencer import SequencerCounters

    source, config = open_source(str(session / next(iter(read_session(session).agents)))), Config()
    tracker, out = make_tracker(source.rig, config), []
    for frame in read_frames(source, config, SequencerCounters()):
        recorder = CallRecorder()
        with recorder.on():
            result = tracker.track(frame)
        if result.state.has_pose:
            out.append(recorder.entered)
    return out


def trace_keyframes(session: Path) -> list[set[tuple[str, str]]]:
    """Return what each keyframe enters: all steps of the mapper until the next one comes."""
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.virtual_time import play_in_virtual_time
    from share.mapping.mapper import Mapper
    from share.mapping.steps import AlignStep, DescribeStep, QueryStep, SolveStep, VerifyStep
    from share.recordings.session import read_session

    out: list[set[tuple[str, str]]] = []

    def recorded(owner: type, name: str) -> None:
        method = getattr(owner, name)

        def call(*arguments: Any, **named: Any) -> Any:
            if name == "add_keyframe":
                out.append(set())
            recorder = CallRecorder()
            with recorder.on():
                result = method(*arguments, **named)
            if out:
                out[-1] |= recorder.entered
            return result

        setattr(owner, name, call)

    for name in ("add_keyframe", "next_lookup", "next_solve", "finish_step"):
        recorded(Mapper, name)
    for step in (DescribeStep, AlignStep, QueryStep, VerifyStep, SolveStep):
        recorded(step, "run")
    with tempfile.TemporaryDirectory() as folder:
        play_in_virtual_time(
            read_session(session),
            60.0,
            RunOptions("share", virtual=True),
            Path(folder),
            lambda progress: None,
        )
    return out


if __name__ == "__main__":
    main()
