# Python 3.11 or newer: python3.11 where there is one that starts, else python3.
PYTHON ?= $(shell python3.11 -c "" 2>/dev/null && echo python3.11 || echo python3)
BIN := .venv/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check

.PHONY: install demo test lint type bench slow torture soak train-test freeze vio-figures

install: .venv/installed
.venv/installed: setup.cfg pyproject.toml
	@$(PYTHON) -c "import sys; v = sys.version_info; v >= (3, 11) or sys.exit('SHARE needs Python 3.11 or newer; $(PYTHON) is %d.%d. Name another: make PYTHON=/path/to/python3.11' % v[:2])"
	$(PYTHON) -m venv .venv
	$(PIP) -e '.[dev]'
	touch $@

demo: install
	$(BIN)/share demo
test: install
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile --ignore tests/run
	$(BIN)/pytest tests/run  # real processes in real time: with the cores to themselves
SLOW_ALONE := tests/run tests/frozen tests/booted tests/tutorial tests/torture  # in real time, or with their own processes
slow: install
	$(BIN)/pytest -m slow -n auto --maxprocesses 4 --dist loadfile $(SLOW_ALONE:%=--ignore %)
	$(BIN)/pytest -m slow $(SLOW_ALONE)
torture: install  # an hour or more, in real time; results as JSON in share-torture
	TORTURE_OUT=$(or $(OUT),share-torture) $(BIN)/pytest -s -m torture tests/torture
soak: install  # HOURS=2.5 make soak: shorter; 20 min of warm-up come before
	$(BIN)/python tests/torture/soak.py --hours $(or $(HOURS),8) --out $(or $(OUT),share-soak)
train-test: install  # brings torch
	$(PIP) -e '.[train]'
	$(BIN)/pytest tests/train -m "slow or not slow"
lint: install
	$(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/lint-imports
type: install
	$(BIN)/mypy
bench: install
	$(BIN)/python tools/bench.py
vio-figures: install
	$(BIN)/python tools/measure_vio.py
freeze: install
	$(PIP) -e '.[freeze]'
	@$(PIP) -e '.[realsense]' || echo "make: no pyrealsense2 for this machine: the program will not capture"
	$(BIN)/pyinstaller --noconfirm --log-level ERROR tools/share.spec
