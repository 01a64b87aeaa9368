"""Shell completion of options without a fixed choice: names that SHARE knows, and files."""

from __future__ import annotations

import click
from click.shell_completion import CompletionItem


def complete_scene(context: click.Context, option: click.Parameter, typed: str) -> list[CompletionItem]:
    """Return the rooms that begin with what was typed."""
    from share.lab.emulate.world.scenes import SCENES

    return _starting([*SCENES, "plain"], typed)


def complete_profile(context: click.Context, option: click.Parameter, typed: str) -> list[CompletionItem]:
    """Return the shipped profiles that begin with what was typed, after NAME= where there is one."""
    from share.errors import ShareError
    from share.sensors.profile import shipped_profiles

    agent, equals, name = typed.rpartition("=")
    try:
        names = list(shipped_profiles())
    except ShareError:
        names = []
    return _starting([f"{agent}{equals}{one}" for one in names], f"{agent}{equals}{name}")


def _starting(names: list[str], typed: str) -> list[CompletionItem]:
    """Return the names that begin with `typed`; where none does, the shell is to complete files."""
    found = [CompletionItem(name) for name in names if name.startswith(typed)]
    return found or [CompletionItem(typed, type="file")]
