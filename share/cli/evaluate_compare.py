"""`share evaluate compare`: run SHARE's tracker and others on the same recordings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.evaluate_many import check_none_failed
from share.cli.terminal import LiveLine
from share.errors import DataError, UsageError
from share.lab.peer_trackers import PEERS

if TYPE_CHECKING:
    from share.lab.evaluate.peer_comparison import TrackerEntry, TrackerRow
    from share.runtime.source import Source


@click.command()
@click.argument("sources", nargs=-1, required=True)
@click.option(
    "--peer",
    "peers",
    multiple=True,
    metavar="NAME=PYTHON",
    help=f"Python with {' or '.join(PEERS)} installed. May be repeated.  [default: the one running SHARE]",
)
@click.option(
    "--vocabulary",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="ORBvoc.txt, which ORB-SLAM3 needs and its package lacks.",
)
@options.config
@options.out_folder
@options.as_json
def compare(
    sources: tuple[str, ...],
    peers: tuple[str, ...],
    vocabulary: Path | None,
    config_file: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Run SHARE's tracker and others over the same recordings; compare their errors against ground truth and
    their CPU time. Each agent runs alone, without an edge.

    SOURCES are sessions (all agents are run) or sources that `share track` takes, with ground truth, stereo
    and IMU. Other trackers are installed from package registries, each in its own environment; one that is
    missing is named and skipped. DIR gets a row and a trajectory (TUM) per run, table.md, table.csv,
    report.html and pictures. An interrupted command continues when it is run again.

    \b
    Example:  python -m venv peers && peers/bin/pip install depthai==3.12.0
              share evaluate compare room1 --peer basalt=peers/bin/python --out compared
    """
    settings = options.load_config(config_file)
    from share.files.writing import writable_dir
    from share.lab.evaluate.peer_comparison import tracker_entries

    recordings = _open_recordings(sources)
    entries, missing = tracker_entries(settings, peer_interpreters(peers), vocabulary)
    jobs = [(name, entry) for name in recordings for entry in entries]
    unsuitable = [(name, one) for name, one in jobs if not one.can_run(recordings[name])]
    missing += [
        f"{one.title} on {name}, which is {recordings[name].rig.kind}: other trackers need stereo+imu"
        for name, one in unsuitable
    ]
    for text in missing:
        click.echo(f"skipped: {text}", err=True)
    writable_dir(out, "table.md", "table.csv", "report.html")
    jobs = [job for job in jobs if job not in unsuitable]
    rows_found, failed = _run_jobs(jobs, recordings, out)
    if rows_found:
        _write_report(out, rows_found, missing, as_json)
    check_none_failed(len(jobs) - failed, len(jobs))


def _open_recordings(sources: tuple[str, ...]) -> dict[str, Source]:
    """Open the recordings, by name. Raises UsageError for one without ground truth."""
    from share.lab.evaluate.peer_comparison import check_truth
    from share.runtime.source import open_source

    opened = {name: open_source(path) for name, path in _named_recordings(sources)}
    for name, source in opened.items():
        check_truth(name, source)
    return opened


def _run_jobs(
    jobs: Sequence[tuple[str, TrackerEntry]], recordings: Mapping[str, Source], out: Path
) -> tuple[list[TrackerRow], int]:
    """Return the rows of all runs that succeeded and the number that failed; print why they failed."""
    from share.lab.evaluate.peer_comparison import tracker_rows

    live, rows_found, failed = LiveLine(), list["TrackerRow"](), 0
    for number, (name, entry) in enumerate(jobs):
        label = f"{number + 1} of {len(jobs)}: {name}: {entry.title}"
        show = partial(_show_progress, live, label, recordings[name].images_count)
        try:
            rows_found += tracker_rows(name, recordings[name], entry, out, show)
        except DataError as error:
            live.print_line(f"share: {name}: {entry.title}: {error}")
            failed += 1
    live.end()
    return rows_found, failed


def _write_report(out: Path, rows_found: Sequence[TrackerRow], missing: Sequence[str], as_json: bool) -> None:
    from share.files.json_file import nan_to_none
    from share.files.writing import atomic_write
    from share.lab.evaluate.peer_comparison import draw_comparison, markdown, rows_csv
    from share.lab.evaluate.report import html_page

    text = markdown(rows_found, missing)
    atomic_write(out / "table.md", text)
    atomic_write(out / "table.csv", rows_csv(rows_found))
    atomic_write(
        out / "report.html",
        html_page("Trackers side by side", f"{text}\n{draw_comparison(out, rows_found)}", out),
    )
    if as_json:
        rows = [nan_to_none(asdict(row)) for row in rows_found]
        click.echo(json.dumps({"rows": rows, "missing": list(missing)}))
        return
    click.echo(text)
    click.echo(f"report: {out / 'report.html'}   tables: {out / 'table.md'}, {out / 'table.csv'}")


def _show_progress(line: LiveLine, label: str, total: int, done: int) -> None:
    line.write(f"{label}  {done} of {total} frames")


def _named_recordings(sources: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield name and path of each recording. Raises UsageError if two have the same name."""
    from share.recordings.session import is_session, read_session

    named = []
    for text in sources:
        folder = Path(text)
        if is_session(folder):
            named += [
                (f"{folder.resolve().name}/{name}", f"{text}/{name}") for name in read_session(folder).agents
            ]
        else:
            named.append(("/".join(folder.resolve().parts[-2:]) if "/" in text else text, text))
    names = [name for name, _ in named]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"two recordings are named {twice[0]}; rename a folder")
    yield from named


def peer_interpreters(peers: Sequence[str]) -> dict[str, Path]:
    """Parse NAME=PYTHON texts; return the interpreter by tracker name. Raises UsageError."""
    interpreters = {}
    for text in peers:
        name, _, python = text.partition("=")
        if name not in PEERS or not python:
            raise UsageError(f"--peer {text}: give NAME=PYTHON, where NAME is {' or '.join(PEERS)}")
        interpreters[name] = Path(python)
    return interpreters
