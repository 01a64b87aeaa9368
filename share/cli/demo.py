"""`share demo`: run the whole system on this machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.completion import complete_scene
from share.cli.live_pages import RunScreen
from share.cli.terminal import Column, LiveLine, Stages, column_table
from share.config import BASE_POLICY, STREAMED
from share.errors import UsageError

if TYPE_CHECKING:
    from share.config import Config
    from share.lab.evaluate.real_time import Progress, RunOptions
    from share.lab.evaluate.scoring import SessionScore
    from share.metrics.ate import Ate
    from share.recordings.session import Session


@click.command()
@click.option(
    "--seconds",
    type=options.NumberRange(3, 600, "a number of seconds"),
    default=20,
    help="Length of the run, s.",
)
@options.policy
@options.link
@options.true_error
@options.config
@click.option("--out", metavar="DIR", type=options.PATH, default="share-demo", help="Output folder.")
@click.option(
    "--scene",
    metavar="S",
    shell_complete=complete_scene,
    help="Kind of room (see share emulate --help).  [default: warehouse]",
)
@click.option(
    "--seed", type=click.IntRange(0), help="Seed of the room.  [default: one where agents meet soon]"
)
@click.option("--view/--no-view", default=True, help="Show the room live in a browser, in 3D.")
@click.option(
    "--compare",
    "is_compared",
    is_flag=True,
    help="Play covins-g, then share (or --policy), on the same recordings; show both side by side. Takes "
    "twice as long, without a browser, which would take the same cores.",
)
@options.as_json
def demo(
    seconds: float,
    policy: str | None,
    link: str | None,
    true_error: bool,
    config_file: Path | None,
    out: Path,
    scene: str | None,
    seed: int | None,
    view: bool,
    is_compared: bool,
    as_json: bool,
) -> None:
    """Try the whole system on this machine; nothing else is needed.

    Makes a virtual room with two headset wearers and a robot (cached for the next time), plays it in real
    time to an edge and three agents, each its own process, and shows how accurately the agents knew their
    poses in the shared map. Meanwhile a browser shows the map as it grows.

    \b
    Example:  share demo --seconds 30 --out /tmp/demo
              share demo --compare
    """
    config = options.load_config(config_file, [policy])  # checked before the room is made
    policy = config.edge.policy
    _check_policy(policy, is_compared, true_error)
    from share.files.writing import writable_dir
    from share.lab.emulate.recipe import DEMO_AGENTS, demo_recipe, meeting_seed
    from share.lab.emulate.session import make_cached_session
    from share.lab.evaluate.emulated_network import LinkAssignment
    from share.lab.evaluate.real_time import RunOptions
    from share.recordings.session import read_session

    LinkAssignment.parse(link).check(DEMO_AGENTS)
    writable_dir(out)
    room = _renderable_scene(scene)
    seed = meeting_seed(room) if seed is None else seed
    with Stages() as stages:
        session = read_session(make_cached_session(demo_recipe(room, seconds, seed), progress=stages))
    terms = RunOptions(policy, link, seed, true_error, agents_first=True)
    if is_compared:
        _compare(session, terms, config, out, as_json)
    else:
        named = replace(terms, config=None if config_file is None else str(config_file))
        _play(session, seconds, named, view, out, as_json)


def _check_policy(policy: str, is_compared: bool, true_error: bool) -> None:
    if is_compared and policy in (BASE_POLICY, STREAMED):
        raise UsageError(f"--compare plays {BASE_POLICY} and another policy; choose another than {policy}")
    if policy == STREAMED and true_error:
        raise UsageError(
            "--true-error does not go with --policy streamed, where the edge tracks; leave out one"
        )


def _play(session: Session, seconds: float, terms: RunOptions, view: bool, out: Path, as_json: bool) -> None:
    """Play a session in real time; show how accurately the agents knew their poses."""
    from share.lab.evaluate.provenance import describe_machine
    from share.lab.evaluate.real_time import played_in_real_time
    from share.lab.evaluate.scoring import join_times, score_session

    machine = describe_machine()
    screen = RunScreen(view)
    with played_in_real_time(session, seconds, terms, out, screen.show, screen.pages) as folders:
        screen.end()
        result = score_session(session, folders)
        since_s = join_times(out / "edge" / "events.jsonl")
        picture = _draw_paths(out, result)
        if as_json:
            click.echo(json.dumps(_document(terms.policy, result, since_s)))
            return
        click.echo(_score_table(result, since_s, terms.policy == STREAMED))
        for line in _advice(result, seconds, machine["load"], machine["cores"]):
            click.echo(line)
        if picture is not None:
            click.echo(f"\npicture: {picture}   decisions of the edge: {out / 'edge' / 'events.jsonl'}")
        if view:
            click.pause("\nThe pages above stay until you press a key.")  # returns at once without a terminal


def _advice(result: SessionScore, seconds: float, load: float, cores: int) -> list[str]:
    """Return what to do where agents did not meet, and why frames waited. load, cores: of the machine before
    the run."""
    from share.lab.evaluate.provenance import busy_text

    count, lines = len(result.agents), []
    if result.joint is None:
        longer = f"{min(600.0, 2 * seconds):g}"
        lines.append(f"no two agents met in {seconds:g} s; in a longer run they may: --seconds {longer}")
    if busy := busy_text(load, cores, "the run"):
        lines.append(f"{busy}, so frames waited and keyframes came late; repeat it when idle")
    elif cores <= count:
        lines.append(
            f"{count} agents and the edge shared {cores} cores, so frames waited; on separate machines they "
            "would not"
        )
    return lines


def _draw_paths(out: Path, result: SessionScore) -> Path | None:
    """Draw the paths of a run in which agents share a map; return the picture."""
    picture = out / "trajectories.png"
    picture.unlink(missing_ok=True)  # left by an earlier demo
    if result.joint is None:
        return None
    from share.lab.evaluate.charts import draw_trajectories

    title = f"joint ATE {100 * result.joint.joint.rmse:.2f} cm, causal, one alignment for all"
    paths = {name: (agent.map, agent.truth) for name, agent in result.agents.items()}
    draw_trajectories(picture, paths, result.joint.joint.T_truth_est, title)
    return picture


def _document(policy: str, result: SessionScore, since_s: Mapping[str, float]) -> dict[str, Any]:
    """Return the result as plain data."""
    joint = {} if result.joint is None else result.joint.agents

    def rmse_cm(ate: Ate | None) -> float | None:
        return None if ate is None else 100 * ate.rmse

    agents = {
        name: {
            "odom_ate_cm": rmse_cm(agent.odometry),
            "map_ate_cm": rmse_cm(joint.get(name)),
            "shared_map_s": since_s.get(name),
            "report": agent.report,
        }
        for name, agent in result.agents.items()
    }
    return {
        "policy": policy,
        "joint_ate_cm": rmse_cm(None if result.joint is None else result.joint.joint),
        "agents": agents,
    }


def _compare(session: Session, terms: RunOptions, config: Config, out: Path, as_json: bool) -> None:
    """Play a session by the base policy and by that of `terms`; show both."""
    from share.cli.terminal import aligned_table
    from share.files.json_file import nan_to_none
    from share.lab.evaluate.side_by_side import (
        ScoredTrial,
        busy_note,
        comparison_rows,
        draw_side_by_side,
        headline,
    )
    from share.lab.evaluate.trial import run_trial

    scored, live = [], LiveLine()
    for policy in (BASE_POLICY, terms.policy):
        played, folder = replace(terms, policy=policy), out / policy
        _remove_trial(folder)

        def show(now: Progress, policy: str = policy) -> None:
            live.write(f"{policy}: {now}")

        scored.append(ScoredTrial.of(run_trial(session, played, config, folder, show)))
        live.end()
    picture = out / "compared.png"
    draw_side_by_side(picture, scored)
    if as_json:
        runs_of = {one.policy: nan_to_none(asdict(one.metrics)) for one in scored}
        click.echo(json.dumps({"headline": headline(scored), "runs": runs_of, "picture": str(picture)}))
        return
    click.echo(aligned_table(comparison_rows(scored)))
    runs = ", ".join(str(one.trial.folder) for one in scored)
    if note := busy_note(scored):
        click.echo(f"\n{note}")
    click.echo(f"\n{headline(scored)}\n\npicture: {picture}   runs: {runs}")


def _remove_trial(folder: Path) -> None:
    """Remove the run of an earlier demo; other folders are left to the error that names them."""
    import shutil

    from share.lab.evaluate.trial import RUN_FILE

    if (folder / RUN_FILE).is_file():
        shutil.rmtree(folder)


def _renderable_scene(scene: str | None) -> str:
    """Return the scene given, or the default; the plain one where OpenGL is missing."""
    from share.lab.emulate.recipe import DEFAULT_SCENE, FALLBACK_SCENE
    from share.lab.emulate.render.context import missing_reason

    if scene is not None:
        return scene
    missing_renderer = missing_reason()
    if missing_renderer is not None:
        click.echo(f"share: using the plain room: {missing_renderer}", err=True)
    return DEFAULT_SCENE if missing_renderer is None else FALLBACK_SCENE


def _score_table(result: SessionScore, since_s: dict[str, float], streamed: bool) -> str:
    """Return two tables, which an ordinary terminal is wide enough for: of errors and of times. since_s: when
    each agent came to share a map, s since the first one joined."""
    tables = _error_columns(result, since_s), _time_columns(result)
    text = "\n\n".join(column_table(columns, result.agents) for columns in tables)
    return f"{text}\n\n{_untracked_text(result) if streamed else _joint_text(result)}"


def _error_columns(result: SessionScore, since_s: dict[str, float]) -> tuple[Column, ...]:
    joint = {} if result.joint is None else result.joint.agents

    def coverage(ates: Mapping[str, Ate | None]) -> Column:
        """Return a column with the share of an agent's frames that its error is about."""
        return "of frames", lambda agent: _percent(ates.get(agent), result.agents[agent].report["frames"])

    return (
        ("agent", str),
        ("odom ATE", lambda agent: _cm(result.agents[agent].odometry)),
        coverage({name: agent.odometry for name, agent in result.agents.items()}),
        ("in the map since", lambda agent: f"{since_s[agent]:.1f} s" if agent in since_s else "–"),
        ("map ATE", lambda agent: _cm(joint.get(agent))),
        coverage(joint),
    )


def _time_columns(result: SessionScore) -> tuple[Column, ...]:
    def duration(title: str, name: str, percentile: str) -> Column:
        return title, lambda agent: _ms(result.agents[agent].report[name][percentile])

    def count(name: str) -> Column:
        return name, lambda agent: str(result.agents[agent].report[name])

    return (
        ("agent", str),
        duration("pose p50", "track_ms", "p50"),
        duration("p95", "track_ms", "p95"),
        ("> 20 ms", lambda agent: f"{100 * result.agents[agent].report['over_20ms']:.1f} %"),
        duration("corrected p50", "corrected_ms", "p50"),
        duration("p95", "corrected_ms", "p95"),
        *(count(name) for name in ("keyframes", "sent", "corrections")),
    )


def _untracked_text(result: SessionScore) -> str:
    untracked = ", ".join(f"{name} {agent.report['untracked']}" for name, agent in result.agents.items())
    return f"the edge tracked each agent alone; frames without an answer: {untracked}"


def _joint_text(result: SessionScore) -> str:
    members = 0 if result.joint is None else len(result.joint.agents)
    joint = "" if result.joint is None else f", joint ATE {_cm(result.joint.joint)}"
    return (
        f"{members} of {len(result.agents)} agents in one map{joint}"
        "  (causal poses, one SE3 alignment for all)"
    )


def _cm(ate: Ate | None) -> str:
    return "–" if ate is None else f"{100 * ate.rmse:.2f} cm"


def _percent(ate: Ate | None, frames: int) -> str:
    return "–" if ate is None else f"{100 * ate.n / frames:.0f} %"


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f} ms"
