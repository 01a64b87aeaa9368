"""The page on which a participant answers, on a tablet, a phone or a headset: one form at a time.

Names of policies are not known here, and nothing is stored but what the study's log takes."""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from http import HTTPStatus
from pathlib import Path

from share.errors import ShareError
from share.files.json_file import parse_json
from share.files.reading import MB, read_bytes
from share.lab.study.asking import AskedForm, PageWords
from share.runtime.web import Response, WebServer, text_response

_FILE = Path(__file__).with_name("question_page.html")
_FORM, _ANSWERS = "/form.json", "/answers"


class QuestionPage:
    """Serves at an address, HOST:PORT or a PORT of this machine alone, until closed. token: needed where
    others reach it. Raises UsageError, TransportError.

    Forms are numbered from a random number on, so that a tab of an earlier run answers none of this one."""

    def __init__(self, address: str, words: PageWords, token: str | None = None) -> None:
        self._words, self._lock = words, threading.Lock()
        self._number = secrets.randbelow(2**48)  # exact in JavaScript
        self._form: AskedForm | None = None
        self._keep: Callable[[Mapping[str, int | None]], None] = lambda answers: None
        self._trouble = ""
        self._answers: dict[str, int | None] | None = None
        self._page = Response(HTTPStatus.OK, "text/html; charset=utf-8", read_bytes(_FILE, MB))
        self._server = WebServer(address, self._respond, token, self._take, "--page")
        self.endpoint = self._server.endpoint

    def close(self) -> None:
        self._server.close()

    def ask(self, form: AskedForm, keep: Callable[[Mapping[str, int | None]], None]) -> None:
        """Show a form. keep: stores its answers, from another thread, before the participant is thanked;
        where it raises ShareError, the form stays."""
        with self._lock:
            self._number, self._form, self._answers = self._number + 1, form, None
            self._keep, self._trouble = keep, ""

    def withdraw(self) -> dict[str, int | None] | None:
        """Ask nothing any more: later answers are refused. Return those that have come."""
        with self._lock:
            answers = self._answers
            if answers is None:
                self._number, self._form = self._number + 1, None
            return answers

    @property
    def trouble(self) -> str:
        """Why answers could not be stored last; empty: they could."""
        with self._lock:
            return self._trouble

    def answers(self) -> dict[str, int | None] | None:
        """Return the answers to the form; None before they have come."""
        with self._lock:
            return self._answers

    def _respond(self, path: str) -> Response:
        if path == "/":
            return self._page
        if path != _FORM:
            return text_response(HTTPStatus.NOT_FOUND, "there is no such page")
        with self._lock:
            is_open = self._form is not None and self._answers is None
            shown = asdict(self._form) if self._form is not None and is_open else None
            has_sent = self._answers is not None
        content = {"number": self._number, "form": shown, "has_sent": has_sent, "words": asdict(self._words)}
        return Response(HTTPStatus.OK, "application/json", json.dumps(content).encode())

    def _take(self, path: str, body: bytes) -> Response:
        if path != _ANSWERS:
            return text_response(HTTPStatus.NOT_FOUND, "there is no such page")
        try:
            sent = parse_json(body)
            number, given = int(sent["number"]), dict(sent["answers"])
        except (ValueError, TypeError, KeyError):
            return text_response(HTTPStatus.BAD_REQUEST, "these are no answers")
        with self._lock:
            if self._answers is not None and number == self._number:
                return text_response(HTTPStatus.CONFLICT, "this was answered before")
            if self._form is None or number != self._number:
                return text_response(HTTPStatus.CONFLICT, "this is not asked here any more")
            try:
                answers = self._form.checked(given)
                self._keep(answers)
            except ValueError as error:
                return text_response(HTTPStatus.BAD_REQUEST, str(error))
            except ShareError as error:
                self._trouble = str(error)
                text = "Not stored. Please tell the researcher, then press Send again."
                return text_response(HTTPStatus.SERVICE_UNAVAILABLE, text)
            self._answers, self._trouble = answers, ""
        return text_response(HTTPStatus.OK, "taken")
