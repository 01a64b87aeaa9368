"""`share study run`: lead the next participant through the trials of a plan."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.stderr import Stderr
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.study.asking import PageWords
    from share.lab.study.question_page import QuestionPage

_TOKEN = "page-token"  # in the study's folder


@click.command(short_help="Lead the next participant through the trials.")
@click.argument("folder", metavar="STUDY", type=options.PATH)
@click.argument("edge_options", metavar="[-- EDGE OPTIONS]", nargs=-1, type=click.UNPROCESSED)
@click.option(
    "--participant", metavar="NAME", help="Who takes part.  [default: the next one with trials left]"
)
@click.option(
    "--key", "key_file", metavar="FILE", type=options.PATH, help="File of the key.  [default: STUDY-key.json]"
)
@click.option(
    "--page",
    metavar="[H:]P",
    help="Ask the questions on a page here, for a tablet, phone or headset.  [default: at this terminal]",
)
@click.option(
    "--questions",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="The plan's questions in another wording or language (docs/do/study.md).",
)
@click.option("--resume", is_flag=True, help="Go on with a trial that was interrupted, without asking.")
@click.option(
    "--leave", is_flag=True, help="Mark an interrupted trial as not carried through, and go on with the next."
)
def run(
    folder: Path,
    edge_options: tuple[str, ...],
    participant: str | None,
    key_file: Path | None,
    page: str | None,
    questions: Path | None,
    resume: bool,
    leave: bool,
) -> None:
    """Lead the next participant of STUDY, a folder by `share study plan`, through the trials left.

    For each trial it starts the edge of that condition with EDGE OPTIONS, those of `share edge`; checks that
    agents, clocks, poses, robot and the floor's marker are well; shows spot after spot in the room; and sends
    the robot when the participant has placed a cube, or you press Enter. Then it asks the questions. Every
    event is on the disk before the next; after Ctrl-C, a crash or a power cut the same command goes on. q and
    Enter ends it.

    \b
    Example:  share study run study --page 8090
              share study run study --page 0.0.0.0:8090 -- --bind tcp://0.0.0.0:5555 --headset 0.0.0.0:8443
    """
    from share.lab.study.asking import PageWords, read_wording
    from share.lab.study.plan import TRIALS, UNBLINDED, read_key, read_plan, renamed
    from share.lab.study.progress import read_progress
    from share.lab.study.session import GO_ON, LEAVE, StudySession
    from share.lab.study.study_room import EdgeOptions
    from share.runtime.signals import stop_on_signal

    if resume and leave:
        raise UsageError("--resume, --leave: give one of them")
    plan = read_plan(folder)
    key_path = key_file or folder.resolve().with_name(f"{folder.resolve().name}-key.json")
    renamed(plan.letters, read_key(key_path, plan).policies, str(key_path))
    if (folder / UNBLINDED).exists():
        raise UsageError(f"{folder / UNBLINDED}: the study was unblinded; no blind trial can follow")
    edge = EdgeOptions(edge_options)
    asked, words = (plan.questions, PageWords()) if questions is None else read_wording(questions, plan)
    with ExitStack() as stack:
        stderr = stack.enter_context(closing(Stderr()))
        stack.callback(os.close, _locked(folder / TRIALS))
        person, steps = read_progress(folder, plan).choose(participant)
        terminal = TerminalResearcher(stderr)
        shown = (
            None if page is None else stack.enter_context(closing(_open_page(page, folder, words, stderr)))
        )
        fate = GO_ON if resume else LEAVE if leave else None
        is_asked = sys.stdin is not None and sys.stdin.isatty()
        session = StudySession(folder, plan, key_path, edge, terminal, asked, words, shown, fate, is_asked)
        with stop_on_signal(terminal.end):
            session.lead(person, steps)


def _locked(trials: Path) -> int:
    """Return the lock on a study's trials. Raises UsageError while another run holds it."""
    from share.files.locks import lock_handle
    from share.files.writing import writable_dir

    try:
        folder = writable_dir(trials)
    except UsageError as error:  # `run` has no --out
        raise UsageError(f"{str(error).removesuffix('; give another --out')}; let it be written to") from None
    handle = os.open(folder, os.O_RDONLY)
    try:
        lock_handle(handle)
    except BlockingIOError:
        raise UsageError(f"{trials}: another `share study run` leads this study; end that first") from None
    return handle


def _open_page(address: str, folder: Path, words: PageWords, stderr: Stderr) -> QuestionPage:
    """Serve the page of questions; where others reach it, with a token that the study keeps."""
    from share.headset.headset_page import shown_host
    from share.lab.study.question_page import QuestionPage
    from share.net.http_guard import read_token, served_address

    is_local = served_address(address).local
    token = None if is_local else read_token(folder / _TOKEN)
    page = QuestionPage(address, words, token)
    host, _, port = page.endpoint.rpartition(":")
    shown = f"{shown_host(host.strip('[]'))}:{port}"
    query = "" if token is None else f"?token={token}"
    stderr.print_line(f"questions at http://{shown}/{query}")
    return page


class TerminalResearcher:
    """Who leads the trials, at this terminal: lines of stdin, and stderr."""

    def __init__(self, stderr: Stderr) -> None:
        self._stderr, self._lines = stderr, queue.SimpleQueue[str | None]()  # None: no line follows
        self._has_ended, self._reason = False, "ended by the researcher"
        threading.Thread(target=self._read, name="stdin", daemon=True).start()

    def say(self, text: str) -> None:
        self._stderr.print_line(text)

    def poll(self) -> str | None:
        try:
            line = self._lines.get_nowait()
        except queue.Empty:
            return None
        return None if self._ends(line) else line

    def forget_typed(self) -> None:
        with contextlib.suppress(queue.Empty):
            while not self._ends(self._lines.get_nowait()):
                pass

    def _ends(self, line: str | None) -> bool:
        """Return whether a line ends it; if so, it does."""
        if line is None:
            self._reason = "stdin has ended, so nobody can press Enter: give it a terminal"
        elif line.strip().lower() != "q":
            return False
        self.end()
        return True

    @property
    def wants_end(self) -> bool:
        return self._has_ended

    @property
    def end_reason(self) -> str:
        return self._reason

    def end(self) -> None:
        self._has_ended = True

    def _read(self) -> None:
        """Read without Python's buffer: a reading thread would hold its lock at the program's end."""
        rest = b""
        with contextlib.suppress(OSError, ValueError, AttributeError):
            while data := os.read(sys.stdin.fileno(), 4096):
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self._lines.put(line.decode(errors="replace").rstrip("\r"))
        self._lines.put(None)
