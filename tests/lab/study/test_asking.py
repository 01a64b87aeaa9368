"""The questions: which answers there are, another wording, and the page that asks them."""

from __future__ import annotations

import json
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from helpers.study_folder import small_plan

from share.errors import ConfigError, ShareError, UsageError
from share.lab.study.asking import PageWords, choice_form, read_wording, trial_form
from share.lab.study.plan import QUESTIONS
from share.lab.study.question_page import QuestionPage

PLAN, _ = small_plan()
FORM = trial_form(QUESTIONS, PageWords(), 2)
EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "study"


def test_answers_are_one_for_each_question() -> None:
    assert FORM.heading == "After round 2"
    assert FORM.checked({"predictability": 7}) == {"predictability": 7, "responsiveness": None}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"predictability": 0}, "0 is not a whole number from 1 to 10"),
        ({"predictability": 11}, "11 is not a whole number from 1 to 10"),
        ({"predictability": 5.5}, "5.5 is not"),
        ({"predictability": "5"}, "5 is not"),
        ({"predictability": True}, "True is not"),
        ({"mood": 3}, "'mood' was not asked"),
    ],
)
def test_other_answers_are_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        FORM.checked(given)


def test_the_choice_is_among_the_rounds_that_were_carried_through() -> None:
    form = choice_form(PageWords(), [1, 3])
    assert form.items[0].options == ((1, "Round 1"), (3, "Round 3"))
    with pytest.raises(ValueError, match="2 is not"):
        form.checked({"most": 2})
    with pytest.raises(ValueError, match="The same round cannot be both"):
        form.checked({"most": 3, "least": 3})
    assert form.checked({}) == {"most": None, "least": None}


@pytest.mark.parametrize("name", ["questions-en.yaml", "questions-de.yaml"])
def test_the_examples_ask_what_the_default_plan_asks(name: str) -> None:
    questions, words = read_wording(EXAMPLES / name, PLAN)
    assert [one.name for one in questions] == [one.name for one in QUESTIONS]
    if name == "questions-en.yaml":
        assert questions == QUESTIONS and words == PageWords()
    else:
        assert words.language == "de" and all(
            getattr(words, one) != getattr(PageWords(), one) for one in PageWords.__dataclass_fields__
        )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("questions:\n- {name: other, text: T, low: a, high: b}\n", "asks something else than the plan"),
        ("words: {send: Los}\n", "key 'questions' is missing"),
        ("{questions}\n\nwords: {sent: Los}\n", "sent"),
    ],
)
def test_another_wording_asks_the_same(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "a.yaml"
    asked = "".join(f"\n- {{name: {one.name}, text: T, low: a, high: b}}" for one in QUESTIONS)
    path.write_text(text.replace("{questions}", f"questions:{asked}"))
    with pytest.raises((ConfigError, UsageError), match=says):
        read_wording(path, PLAN)


def test_a_wording_without_words_has_the_usual_ones(tmp_path: Path) -> None:
    rows = [f"- {{name: {one.name}, text: T, low: a, high: b}}" for one in QUESTIONS]
    (tmp_path / "a.yaml").write_text("\n".join(["questions:", *rows]))
    questions, words = read_wording(tmp_path / "a.yaml", PLAN)
    assert [one.text for one in questions] == ["T", "T"] and words == PageWords()


def nothing(answers: Mapping[str, int | None]) -> None:
    pass


class PageBench:
    def __init__(self, page: QuestionPage) -> None:
        self.page = page

    def fetch(self, path: str, body: Any = None, **headers: str) -> tuple[int, str]:
        url = f"http://{self.page.endpoint}{path}"
        data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        if data is not None:
            headers = {"Origin": f"http://{self.page.endpoint}"} | headers
        request = urllib.request.Request(url, data, {k: v for k, v in headers.items() if v})
        try:
            with urllib.request.urlopen(request, timeout=20) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def shown(self) -> dict[str, Any]:
        return dict(json.loads(self.fetch("/form.json")[1]))

    def send(self, answers: dict[str, Any], number: int | None = None, **headers: str) -> tuple[int, str]:
        number = self.shown()["number"] if number is None else number
        return self.fetch("/answers", {"number": number, "answers": answers}, **headers)


@pytest.fixture
def bench() -> Iterator[PageBench]:
    with closing(QuestionPage("127.0.0.1:0", PageWords())) as page:
        yield PageBench(page)


def test_a_form_is_shown_until_it_is_answered_once(bench: PageBench) -> None:
    assert bench.fetch("/")[0] == 200 and bench.shown()["form"] is None
    bench.page.ask(FORM, nothing)
    assert bench.shown()["form"]["heading"] == "After round 2" and bench.page.answers() is None
    number = bench.shown()["number"]
    assert bench.send({"predictability": 7, "responsiveness": 10})[0] == 200
    assert bench.page.answers() == {"predictability": 7, "responsiveness": 10}
    assert bench.shown()["form"] is None and bench.shown()["has_sent"]
    assert bench.send({"predictability": 1}, number)[0] == 409  # pressed twice
    assert bench.page.answers() == {"predictability": 7, "responsiveness": 10}


def test_answers_to_an_earlier_form_are_refused(bench: PageBench) -> None:
    bench.page.ask(FORM, nothing)
    number = bench.shown()["number"]
    bench.page.ask(FORM, nothing)
    assert bench.send({"predictability": 7}, number)[0] == 409 and bench.page.answers() is None


@pytest.mark.parametrize(
    "body", [b"", b"x", b"[]", b"{}", b'{"number": 1}', b'{"number": "x", "answers": {}}', b"\xff" * 100]
)
def test_what_is_no_answer_is_refused(bench: PageBench, body: bytes) -> None:
    bench.page.ask(FORM, nothing)
    assert bench.fetch("/answers", body)[0] == 400 and bench.page.answers() is None


def test_answers_out_of_range_are_refused_with_a_line(bench: PageBench) -> None:
    bench.page.ask(FORM, nothing)
    status, text = bench.send({"predictability": 11})
    assert (status, text) == (400, "predictability: 11 is not a whole number from 1 to 10\n")
    assert bench.send({"predictability": 10})[0] == 200


def test_other_pages_send_no_answers(bench: PageBench) -> None:
    bench.page.ask(FORM, nothing)
    assert bench.send({}, Origin="http://evil.example")[0] == 403
    assert bench.send({}, Origin="")[0] == 403
    assert bench.fetch("/answers", b"x" * 9000)[0] == 431
    assert bench.fetch("/form.json", b"{}")[0] == 404
    assert bench.page.answers() is None


def test_others_need_the_token() -> None:
    with pytest.raises(UsageError, match=r"--page 0\.0\.0\.0:0: others could read it"):
        QuestionPage("0.0.0.0:0", PageWords())
    with closing(QuestionPage("127.0.0.1:0", PageWords(), "t" * 20)) as page:
        bench = PageBench(page)
        page.ask(FORM, nothing)
        assert bench.fetch("/")[0] == 401 and bench.fetch("/form.json")[0] == 401
        assert bench.fetch("/answers", {"number": 1, "answers": {}})[0] == 401
        assert bench.fetch("/form.json", Authorization=f"Bearer {'t' * 20}")[0] == 200


def sent_raw(page: QuestionPage, *pieces: bytes) -> bytes:
    host, _, port = page.endpoint.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=20) as client:
        for piece in pieces:
            client.sendall(piece)
            time.sleep(0.05)
        client.shutdown(socket.SHUT_WR)
        return client.recv(12)


def test_a_body_may_come_in_pieces_and_ends_where_it_says(bench: PageBench) -> None:
    bench.page.ask(FORM, nothing)
    body = json.dumps({"number": bench.shown()["number"], "answers": {"predictability": 4}}).encode()
    head = (
        f"POST /answers HTTP/1.1\r\nOrigin: http://{bench.page.endpoint}\r\nHost: {bench.page.endpoint}\r\n"
    )
    first = f"{head}Content-Length: {len(body)}\r\n".encode()
    assert sent_raw(bench.page, first, b"\r\n", body[:10], body[10:]) == b"HTTP/1.1 200"
    assert bench.page.answers() == {"predictability": 4, "responsiveness": None}
    bench.page.ask(FORM, nothing)
    for length in ("99999999999", "-1", "x", ""):
        answer = sent_raw(bench.page, f"{head}Content-Length: {length}\r\n\r\n".encode(), b"y" * 9000)
        assert answer in (b"HTTP/1.1 431", b"HTTP/1.1 400", b"")
    assert bench.page.answers() is None and bench.fetch("/")[0] == 200


def test_answers_are_acknowledged_once_they_are_kept(bench: PageBench) -> None:
    kept: list[dict[str, int | None]] = []

    def keep(answers: Mapping[str, int | None]) -> None:
        if not is_full:
            kept.append(dict(answers))
            return
        raise ShareError("answers.jsonl: cannot be written: No space left on device")

    is_full = True
    bench.page.ask(FORM, keep)
    status, text = bench.send({"predictability": 7})
    assert status == 503 and "tell the researcher" in text and bench.page.answers() is None
    assert bench.shown()["form"] is not None and "No space left" in bench.page.trouble
    is_full = False
    assert bench.send({"predictability": 7})[0] == 200
    assert kept == [{"predictability": 7, "responsiveness": None}] == [bench.page.answers()]
    assert bench.page.trouble == ""


def test_a_form_that_was_withdrawn_takes_no_answer(bench: PageBench) -> None:
    bench.page.ask(FORM, nothing)
    number = bench.shown()["number"]
    assert bench.page.withdraw() is None and bench.shown()["form"] is None
    assert bench.send({"predictability": 7}, number) == (409, "this is not asked here any more\n")
    bench.page.ask(FORM, nothing)
    bench.send({"predictability": 7})
    assert bench.page.withdraw() == {"predictability": 7, "responsiveness": None}


def test_a_tab_of_an_earlier_run_answers_nothing() -> None:
    numbers = []
    for _ in range(2):
        with closing(QuestionPage("127.0.0.1:0", PageWords())) as page:
            page.ask(FORM, nothing)
            numbers.append(PageBench(page).shown()["number"])
    assert abs(numbers[0] - numbers[1]) > 100
