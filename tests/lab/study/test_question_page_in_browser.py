"""The page of questions in a real browser: pressed as a participant does, on a phone."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from importlib.util import find_spec

import pytest

from share.lab.study.asking import PageWords, choice_form, trial_form
from share.lab.study.plan import QUESTIONS
from share.lab.study.question_page import QuestionPage

pytestmark = [
    pytest.mark.skipif(find_spec("websockets") is None, reason="websockets is not installed"),
    pytest.mark.long,
]
if find_spec("websockets") is not None:
    from helpers.browser import browser

_OPTION = "fieldset:nth-of-type({}) label:nth-child({}) input"


def soon(is_so: Callable[[], object]) -> None:
    end_s = time.monotonic() + 120
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def test_a_participant_answers() -> None:
    with browser() as chromium, closing(QuestionPage("127.0.0.1:0", PageWords(), "t" * 20)) as served:
        page = chromium.page(f"http://{served.endpoint}/?token={'t' * 20}", 390, 844)

        def shows(text: str) -> bool:
            return text in str(page.evaluate("document.body.innerText"))

        soon(lambda: shows("The questions come here after each round."))
        served.ask(trial_form(QUESTIONS, PageWords(), 3), lambda answers: None)
        soon(lambda: shows("After round 3") and shows("1: not at all") and shows("10: always"))
        page.click(_OPTION.format(1, 7))
        page.click("#send")
        soon(lambda: shows("Not all is answered. Press Send again"))
        assert served.answers() is None
        page.click(_OPTION.format(2, 10))
        assert not shows("Not all is answered")
        page.click("#send")
        soon(lambda: served.answers() == {"predictability": 7, "responsiveness": 10})
        soon(lambda: shows("Thank you."))
        served.ask(choice_form(PageWords(), [1, 2, 3, 4]), lambda answers: None)
        soon(lambda: shows("After the last round"))
        assert page.evaluate("document.querySelectorAll('input:checked').length") == 0
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390
        page.click(_OPTION.format(1, 2))
        page.click("#send")
        page.click("#send")
        soon(lambda: served.answers() == {"most": 2, "least": None})
        assert page.problems == []
