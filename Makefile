# Python 3.11 or newer: python3.11 where there is one that starts, else python3.
PYTHON ?= $(shell python3.11 -c "" 2>/dev/null && echo python3.11 || echo python3)
BIN := .venv/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check

# Tests start hundreds of processes, and each of pytest's workers rewrites all tests: compiled once, not each time.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test unit lint type bench slow torture soak train-test freeze lock sbom licenses audit vio-figures docs

CHECK_PYTHON := $(PYTHON) -c "import sys; v = sys.version_info; v >= (3, 11) or sys.exit('SHARE needs Python 3.11 or newer; $(PYTHON) is %d.%d. Name another: make PYTHON=/path/to/python3.11' % v[:2])"

install: .venv/installed
.venv/installed: setup.cfg pyproject.toml
	@$(CHECK_PYTHON)
	$(PYTHON) -m venv .venv
	$(PIP) -e '.[dev]'
	touch $@

demo: .venv/for-demo  # without the developers' tools
	$(BIN)/share demo
.venv/for-demo: setup.cfg pyproject.toml
	@$(CHECK_PYTHON)
	@test -e .venv || $(PYTHON) -m venv .venv
	$(BIN)/pip install --disable-pip-version-check -e '.[emulate,view]'
	touch $@
WORKERS := $(shell expr 1 + $$(nproc))# one more than cores: many tests wait for a while
unit: install  # the inner loop: what decides, without what takes a second or more
	$(BIN)/pytest -n auto --maxprocesses 4 -m "not slow and not torture and not long" tests/geometry tests/vision tests/scheduling tests/metrics tests/wire tests/sensors tests/protocol tests/mapping tests/odometry
test: install
	$(BIN)/pytest -n $(WORKERS) --maxprocesses 4 --dist loadfile $(REAL_TIME:%=--ignore %)
	$(BIN)/pytest -n $(WORKERS) --maxprocesses 3 --dist loadfile $(REAL_TIME) $(BUSY:%=--ignore %)  # mostly waiting
	$(BIN)/pytest $(BUSY)  # with the cores to themselves
REAL_TIME := tests/run tests/net/test_transport_attacks.py
BUSY := tests/run/test_kitchen.py tests/run/test_streamed.py# their processes fill two cores
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
	$(BIN)/pytest tests/lab/train -m "slow or not slow"
lint: install
	$(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/lint-imports
type: install
	$(BIN)/mypy
bench: install
	$(BIN)/python tools/bench.py
docs: install  # the site, into build/site; once installed it needs no network
	@$(BIN)/python -c "import material" 2>/dev/null || $(PIP) -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/pytest tests/test_docs.py
vio-figures: install
	$(BIN)/python tools/experiments/measure_vio.py
# The frozen program is built in an environment of its own, of exactly what the lock file says.
LOCKS := tools/locks
LOCK := $(LOCKS)/$(shell $(PYTHON) -c "import platform, sys; print('%s-py%d.%d' % (platform.machine(), *sys.version_info[:2]))").txt
FREEZE := build/freeze-env/bin
freeze: $(FREEZE)/installed
	$(FREEZE)/pyinstaller --noconfirm --log-level ERROR tools/share.spec
$(FREEZE)/installed: $(LOCK) setup.cfg pyproject.toml
	rm -rf build/freeze-env
	$(PYTHON) -m venv build/freeze-env
	$(FREEZE)/pip install --quiet --disable-pip-version-check --require-hashes --only-binary :all: -r $(LOCK)
	$(FREEZE)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@
$(LOCKS)/%.txt:
	@echo "make: there is no $@; there are $(wildcard $(LOCKS)/*.txt): use one of those machines and Pythons, or add this one to LOCKED in the Makefile and run make lock" >&2; exit 1

LOCKED := x86_64-py3.11 x86_64-py3.12 aarch64-py3.12
# What setup.cfg asks for, as a list: uv would have to build SHARE to read it, which --only-binary forbids.
ASKED := $(PYTHON) -c "import configparser; c = configparser.ConfigParser(); c.read('setup.cfg'); e = c['options.extras_require']; print(c['options']['install_requires'], e['freeze'], e['realsense'])"
lock: install
	$(PIP) -e '.[release]'
	@for one in $(LOCKED); do echo "$(LOCKS)/$$one.txt"; $(ASKED) | $(BIN)/uv pip compile --quiet --upgrade - \
	    --python-version $${one#*-py} --python-platform $${one%-py*}-manylinux_2_28 --only-binary :all: --generate-hashes \
	    --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" -o $(LOCKS)/$$one.txt || exit 1; done
sbom: install $(FREEZE)/installed
	$(PIP) -e '.[release]'
	$(BIN)/python tools/sbom.py $(FREEZE)/python dist/share.cdx.json
licenses: install $(FREEZE)/installed
	$(BIN)/python tools/licenses.py $(FREEZE)/python docs/lookup/licenses.md
audit: install
	$(PIP) -e '.[release]'
	@for one in $(LOCKS)/*.txt; do echo "$$one"; $(BIN)/pip-audit --strict --disable-pip --require-hashes -r $$one || exit 1; done
