"""Every command takes -v: where in the code it failed, and how long it took."""

from __future__ import annotations

import json
import logging

import click
import pytest
from helpers.recordings import make_euroc

from share.cli.main import cli


def commands(group: click.Group, name: str = "share") -> list[tuple[str, click.Command]]:
    out = []
    for word in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), word)
        assert command is not None
        out += (
            commands(command, f"{name} {word}")
            if isinstance(command, click.Group)
            else [(f"{name} {word}", command)]
        )
    return out


@pytest.fixture(autouse=True)
def quiet_again():
    """Other tests see the logger as it was."""
    logger = logging.getLogger("share")
    before = logger.level, list(logger.handlers)
    yield
    logger.setLevel(before[0])
    logger.handlers[:] = before[1]


def test_every_command_has_it_once():
    for name, command in [*commands(cli), *commands(cli)]:  # also when asked for again
        assert sum("--verbose" in option.opts for option in command.params) == 1, name


def test_a_failure_says_where_it_was(share, tmp_path):
    plain = share("dataset", "info", tmp_path / "missing")
    verbose = share("dataset", "info", tmp_path / "missing", "-v")
    assert plain.code == verbose.code == 2
    assert plain.err.count("\n") == 1 and verbose.err.endswith(plain.err)
    assert "Traceback" in verbose.err and "source.py" in verbose.err
    assert share("dataset", "info", tmp_path / "missing").err == plain.err  # the next is quiet again


def test_a_success_says_how_long_it_took(share, tmp_path):
    done = share("dataset", "info", make_euroc(tmp_path / "walk"), "-v")
    assert done.code == 0 and ": took " in done.err and "took" not in done.out


def test_an_internal_error_is_one_line_and_with_v_a_traceback(share, tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by zero\nor so")

    monkeypatch.setattr("share.recordings.describe.describe_recording", fail)
    walk = make_euroc(tmp_path / "walk")
    done = share("dataset", "info", walk)
    assert done.code == 1 and done.err.count("\n") == 1
    assert (
        "internal error: ZeroDivisionError: by zero?or so (test_verbose.py:" in done.err and "-v" in done.err
    )
    assert "Traceback" in share("dataset", "info", walk, "-v").err


@pytest.mark.parametrize("out", [".", "/"])
def test_a_folder_without_a_name_is_refused(out, share, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    done = share("emulate", "--scene", "plain", "--motion", "walk:", "--seconds", 3, "--out", out)
    assert done.code == 2 and done.err.count("\n") == 1 and "exists already" in done.err


def test_more_commands_print_json(share, tmp_path):
    walk = make_euroc(tmp_path / "walk")
    done = share("dataset", "convert", walk, "--out", tmp_path / "w.mcap", "--json")
    assert json.loads(done.out) == {
        "out": str(tmp_path / "w.mcap"), "format": "mcap", "frames": 6, "skipped": {},
    }  # fmt: skip
    made = json.loads(share("keys", "generate", "--keys", tmp_path / "keys", "--name", "ann", "--json").out)
    assert (made["name"], made["folder"]) == ("ann", str(tmp_path / "keys"))
    assert made["public_key"] in (tmp_path / "keys" / "ann.public").read_text()
