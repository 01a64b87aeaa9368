PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: install demo test lint type bench slow freeze

install: .venv/installed
.venv/installed: setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

demo: install
	$(BIN)/share demo
test: install
	$(BIN)/pytest
slow: install
	$(BIN)/pytest -m slow
lint: install
	$(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/lint-imports
type: install
	$(BIN)/mypy
bench: install
	$(BIN)/python tools/bench.py
freeze: install
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[freeze]'
	$(BIN)/pyinstaller --noconfirm --log-level WARN tools/share.spec
