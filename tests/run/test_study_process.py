"""`share study run` as a process, with a real edge for each trial: from plan to report, blind, killed in
mid-trial, without its edge."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.study_actors import MARKER, StudyActors, in_map, study_map

from share.child_processes import child_environment
from share.config import POLICY_NAMES
from share.lab.study.plan import StudyPlan, read_plan
from share.lab.study.trial_machine import PRESS_AFTER_S

pytestmark = pytest.mark.long
_WAIT_S = 240.0  # on a busy machine
SHARE = [sys.executable, "-m", "share"]


class RunningStudy:
    """`share study run s …` in the present folder."""

    def __init__(self, address: str, *options: str, edge: tuple[str, ...] = ()) -> None:
        self.log = Path("run.log")
        self._at = 0  # in what it has said: up to where it was waited for
        self._from = self.log.stat().st_size if self.log.exists() else 0
        command = [
            *SHARE,
            "study",
            "run",
            "s",
            *options,
            "--",
            "--bind",
            address,
            "--map",
            "room.sqlite",
            *edge,
        ]
        with self.log.open("ab") as sink:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=sink, stderr=sink, env=child_environment()
            )

    @property
    def said(self) -> str:
        return self.log.read_bytes()[self._from :].decode()

    def wait(self, *texts: str) -> str:
        """Until it has said one of these since the last one that was waited for. Return which."""
        end_s = time.monotonic() + _WAIT_S
        while True:
            said = self.said
            found = min(
                ((said.find(text, self._at), text) for text in texts if text in said[self._at :]),
                default=None,
            )
            if found is not None:
                self._at = found[0] + len(found[1])
                return found[1]
            assert self.process.poll() is None and time.monotonic() < end_s, f"never {texts}: {said}"
            time.sleep(0.03)

    def begin(self, first: str) -> None:
        """Begin a trial whose first spot is announced so; on a busy machine not all stays well."""
        self.wait("all is well: Enter begins")
        self.type()
        while self.wait(first, "Enter again begins") != first:
            self.type()

    def type(self, text: str = "") -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n".encode())
        self.process.stdin.flush()

    def call(self) -> None:
        """Send the robot; an Enter right after the spot was shown calls nothing."""
        time.sleep(PRESS_AFTER_S + 0.2)
        self.type()

    def end(self) -> int:
        return self.process.wait(_WAIT_S)

    def __enter__(self) -> RunningStudy:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()


@pytest.fixture
def address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    study_map(Path("room.sqlite"))
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    return f"tcp://127.0.0.1:{port}"


def plan(share: Any, *options: object, spots: int = 3) -> StudyPlan:
    policies = ("--policy", "share", "--policy", "fixed")
    done = share("study", "plan", "--out", "s", "--participants", 2, *policies, "--spots", spots, *options)
    assert done.code == 0, done.err
    return read_plan(Path("s"))


def events(name: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in Path(f"s/trials/{name}/events.jsonl").read_text().splitlines()]


def fetched(study: RunningStudy) -> str:
    """All that the edge of the present trial serves."""
    status = re.findall(r"status at (http://\S+)/", study.said)[-1]
    texts = []
    for path in ("/", "/health", "/health/agents", "/metrics", "/snapshot.json", "/plan.json"):
        try:
            with urllib.request.urlopen(status + path, timeout=_WAIT_S) as answer:
                texts.append(answer.read().decode())
        except urllib.error.HTTPError as trouble:  # 503, on a busy machine
            texts.append(trouble.read().decode())
    return "\n".join(texts)


def contexts(text: str, letter: str) -> set[str]:
    """What stands around each policy's name, without numbers and the condition's letter."""
    text = re.sub(rf"\b{letter}\b", "LETTER", re.sub(r"\d+", "#", text))
    names = "|".join(map(re.escape, POLICY_NAMES))
    return {match[0] for match in re.finditer(rf".{{0,14}}\b(?:{names})\b.{{0,14}}", text)}


def all_files(folder: Path) -> str:
    """Names and contents of all files."""
    found = sorted(one for one in folder.rglob("*") if one.is_file())
    return "\n".join(f"{one.relative_to(folder)}\n{one.read_text()}" for one in found)


def test_a_participant_from_plan_to_report(share: Any, address: str) -> None:
    made = plan(share)
    letters = [one.condition for one in made.participants[0].trials]
    with StudyActors(address) as actors, RunningStudy(address, "--page", "0") as study:
        for place in (1, 2):
            study.begin("1 of 3:")
            for goal, spot in enumerate(made.participants[0].trials[place - 1].spots, 1):
                study.wait(f"spot {spot},")
                x, y = made.spots[spot - 1]
                if goal == 2:
                    shown = actors.place_cube(x + 0.1, y, 5)
                    assert shown is not None and shown.owner == "study"
                    np.testing.assert_allclose(shown.T_map_object[:2, 3], in_map(x, y), atol=1e-6)
                else:
                    study.call()
                study.wait("reached after")
            study.wait("questions are on the page")
            page = re.findall(r"questions at (http://\S+)", study.said)[-1].rstrip("/")
            asked = json.loads(urllib.request.urlopen(f"{page}/form.json", timeout=_WAIT_S).read())
            assert asked["form"]["heading"] == f"After round {place}"
            body = {
                "number": asked["number"],
                "answers": {"predictability": 3 + place, "responsiveness": None},
            }
            post(f"{page}/answers", body)
        study.wait("questions are on the page")
        study.type("here")
        study.wait("1 to 2")
        study.type("2")
        study.wait("1 to 2")
        study.type("")
        assert study.end() == 0, study.said
    for place in (1, 2):
        kinds = [one["event"] for one in events(f"p01-{place}")]
        assert "moves" in kinds  # of a goal that a busy machine reaches between two places, it is not seen
        assert [kind for kind in kinds if kind != "moves"] == [
            "begin",
            *3 * ("call", "stands", "status"),
            "end",
        ]
        begin, *rest = events(f"p01-{place}")
        assert (begin["judge"], begin["edge"], len(begin["config_sha256"])) == ("map", "edge-1", 64)
        assert [one["by"] for one in rest if one["event"] == "call"] == ["terminal", "headset", "terminal"]
        times = [one["t_s"] for one in rest if one["event"] in ("call", "status")]
        assert times == sorted(times)
    answers = [json.loads(line) for line in Path("s/answers.jsonl").read_text().splitlines()]
    assert answers[1:] == [
        {
            "participant": "p01",
            "condition": letters[1],
            "answers": {"predictability": 5, "responsiveness": None},
        },
        {"participant": "p01", "most": letters[1], "least": None},
    ]
    done = share("study", "run", "s", "--participant", "p01")
    assert done.code == 2 and "has done all trials and answered; the next is p02" in done.err
    report = share("study", "analyze", "s", "--json")
    assert report.code == 0, report.err
    reached = next(
        one for one in json.loads(report.out)["measures"] if one["name"].startswith("reachability")
    )
    assert [one["mean"][0] for one in reached["conditions"]] == [100.0, 100.0]


def post(url: str, body: dict[str, Any]) -> None:
    origin = "/".join(url.split("/")[:3])
    request = urllib.request.Request(url, json.dumps(body).encode(), {"Origin": origin})
    with urllib.request.urlopen(request, timeout=_WAIT_S) as answer:
        assert answer.status == 200


@pytest.mark.slow
def test_the_policies_of_two_trials_cannot_be_told_apart_by_name(share: Any, address: str) -> None:
    """The same trial under `share` and `fixed`: what stands around policies' names (share is the program's,
    too) is the same in all files, names of files, pages, metrics and lines of the terminal. An edge that is
    not blind shows its policy to the same search."""
    made = plan(share, spots=1)
    letters = [one.condition for one in made.participants[0].trials]
    pages, lines = [], []
    with StudyActors(address):
        for place in (1, 2):
            with RunningStudy(address) as study:
                study.begin("1 of 1: spot 1")
                pages.append(fetched(study))
                study.call()
                for _ in range(2):
                    study.wait("1 to 10")
                    study.type("5")
                study.wait("trial 2 of 2" if place == 1 else "After the last round")
                lines.append(study.said)
                study.process.send_signal(signal.SIGINT)
                study.end()
    assert Path("s/trials/p01-1/edge-1/edge.json").is_file()
    files = [all_files(Path(f"s/trials/p01-{place}")) for place in (1, 2)]
    said = [lines[0].partition("p01, trial 2")[0], lines[1]]
    said = [re.sub(r"(?m)^WAIT .*", "", text) for text in said]  # hints, which depend on how busy it is
    assert contexts(pages[0], letters[0])  # of the page itself
    for texts in (pages, said, files):
        first, second = (contexts(text, letter) for text, letter in zip(texts, letters, strict=True))
        assert first == second
    for text in (*said, *files):
        assert re.findall(r"\b(?:share-paper|covins-g|linear|equal|random|fixed|streamed)\b", text) == []
    told = files[0].replace(f'"policy": "{letters[0]}"', '"policy": "share"')
    assert told != files[0] and contexts(told, letters[0]) != contexts(files[0], letters[0])


def test_a_study_that_is_killed_in_mid_trial_goes_on(share: Any, address: str) -> None:
    made = plan(share)
    trial = made.participants[0].trials[0]
    with StudyActors(address, speed_m_s=0.05) as actors:
        with RunningStudy(address) as study:
            study.begin("1 of 3:")
            actors.speed_m_s = 5.0
            study.call()
            study.wait("2 of 3:")
            actors.speed_m_s = 0.05
            study.call()
            at = Path("s/trials/p01-1/events.jsonl")
            until(lambda: '"goal": 2' in at.read_text())
            study.process.send_signal(signal.SIGKILL)
            study.end()
        with at.open("ab") as torn:
            torn.write(b'{"event": "sta')  # the power went too
        until(lambda: not is_answering(address))  # its edge has gone with it
        with RunningStudy(address) as study:
            assert study.end() == 2
            assert "p01, trial 1 was interrupted after 1 of its spots: give --resume" in study.said
        actors.speed_m_s = 5.0
        with RunningStudy(address, "--resume") as study:
            study.begin(f"2 of 3: spot {trial.spots[1]},")
            study.call()
            study.wait("3 of 3:")
            edge = edge_process(study.process.pid)
            os.kill(edge, signal.SIGKILL)
            assert study.end() == 1
            (said,) = [line for line in study.said.splitlines() if line.startswith("share: ")]
            assert "p01, trial 1: the edge ended" in said and "run it again to go on" in said
        with RunningStudy(address, "--resume") as study:
            study.begin("3 of 3:")
            study.call()
            study.wait("1 to 10")
            study.type("q")
            assert study.end() == 1
    kinds = [one["event"] for one in events("p01-1")]
    assert kinds.count("begin") == 3 and kinds[-1] == "end"
    calls = [(one["goal"], one["spot"]) for one in events("p01-1") if one["event"] == "call"]
    assert calls == [(k, trial.spots[k - 1]) for k in (1, 2, 2, 3)]
    (broken,) = [one for one in events("p01-1") if one["event"] == "interrupted"]
    assert "the edge ended" in broken["reason"]
    times = [one["t_s"] for one in events("p01-1") if one["event"] in ("begin", "call", "status", "end")]
    assert times == sorted(times)
    done = share("study", "analyze", "s")
    assert done.code == 0, done.err
    assert "1 calls were repeated" in done.out


@pytest.mark.slow
def test_a_robot_that_does_not_come_and_no_marker(share: Any, address: str) -> None:
    Path("room.sqlite").unlink()
    study_map(Path("room.sqlite"), has_marker=False)
    made = plan(share, "--timeout", 1, spots=1)
    with StudyActors(address, reaches=False), RunningStudy(address) as study:
        study.wait("WAIT  marker   none: place one")
        study.type()
        study.wait("no spot can be shown without the floor's one marker")
        share("marker", "put", 0, 0, "--id", MARKER, "--edge", address, "--name", "lead")
        study.begin("1 of 1:")
        study.call()
        study.wait("timed out after")
        study.wait("1 to 10")
        assert made.success.timeout_s == 1.0
    (status,) = [one for one in events("p01-1") if one["event"] == "status"]
    assert status["status"] == "timed out"
    (stands,) = [one for one in events("p01-1") if one["event"] == "stands"]
    assert stands["path_m"] == 0.0


def test_a_bridge_that_dies_and_a_terminal_that_ends(share: Any, address: str) -> None:
    plan(share, spots=1)
    with StudyActors(address, speed_m_s=0.02) as actors, RunningStudy(address) as study:
        study.begin("1 of 1:")
        study.call()
        until(lambda: any(one["event"] == "moves" for one in events("p01-1")))
        actors.is_bridge_dead = True
        assert study.end() == 1
        (said,) = [line for line in study.said.splitlines() if line.startswith("share: ")]
        assert "p01, trial 1: the robot is gone: its bridge is silent" in said
    assert [one["event"] for one in events("p01-1")] == ["begin", "call", "moves", "interrupted"]
    with RunningStudy(address, "--resume") as study:
        assert study.process.stdin is not None
        study.process.stdin.close()
        assert study.end() == 1
        (said,) = [line for line in study.said.splitlines() if line.startswith("share: ")]
        assert "stdin has ended, so nobody can press Enter" in said


def until(is_so: Any) -> None:
    end_s = time.monotonic() + _WAIT_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def is_answering(address: str) -> bool:
    host, _, port = address.removeprefix("tcp://").partition(":")
    with socket.socket() as one:
        return one.connect_ex((host, int(port))) == 0


def edge_process(parent: int) -> int:
    """The process id of the edge that a study has started."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    (edge,) = [int(one) for one in children if b"\0edge\0" in Path(f"/proc/{one}/cmdline").read_bytes()]
    return edge
