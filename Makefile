# `make help` lists the targets. Every target makes the virtual environment it needs.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
BIN := $(VENV)/bin

# Tests start hundreds of processes: with the package's byte code at hand, each starts sooner.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo paper test test-fast lint format fuzz bench docs web clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/.installed  ## align a set of sample models and show the result in demo/index.html
	$(BIN)/cadalign demo --out demo

paper: $(VENV)/.installed  ## make every table and figure of the AEPnP paper anew, in paper/ (QUICK=1: two minutes)
	$(BIN)/python scripts/reproduce_paper.py --out paper$(if $(QUICK),-quick --quick) $(if $(CADALIGN_DATA),--root $(CADALIGN_DATA)/keypointnet)

# The modules of tests are shared out among processes; what measures times runs alone, after them.
# A process whose test hangs is not replaced: xdist would let the new one wait for ever.
PARALLEL := -n $(or $(WORKERS),logical) --maxprocesses 8 --max-worker-restart 0 \
	--dist loadfile --no-loadscope-reorder

test: $(VENV)/.installed-dev  ## run the whole test suite (WORKERS=2)
	$(BIN)/python -m pytest $(PARALLEL) -m "not timing" --durations=20
	$(BIN)/python -m pytest -m timing $$(grep -rl mark.timing tests --include="test_*.py")

test-fast: $(VENV)/.installed-dev  ## run the tests that take a minute together
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow and not long and not timing"

fuzz: $(VENV)/.installed-dev  ## call fit, every reader and the commands with random input (COUNT=20000)
	for what in fits batches readers; do PYTHONPATH=tests $(BIN)/python -m fuzz $$what $(or $(COUNT),20000) || exit 1; done
	PYTHONPATH=tests $(BIN)/python -m fuzz commands $$(($(or $(COUNT),20000) / 20))

bench: $(VENV)/.installed-dev  ## measure accuracy and speed (SECTIONS="cold speed")
	$(BIN)/python scripts/bench.py $(SECTIONS)

lint: $(VENV)/.installed-dev  ## check style (ruff) and types (mypy)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed-dev  ## format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.installed-dev  ## build the documentation site in docs/_build
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build
	! grep -E '(src|href)="(https?:)?//[^"]+\.(js|css|woff2?)"' docs/_build/index.html

web:  ## bundle the scripts of the report and the annotator anew (needs Node)
	cd cadalign/web && npm ci --no-audit --no-fund && npm run build

clean:  ## remove the virtual environment and everything built
	rm -rf $(VENV) build *.egg-info demo .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "cadalign needs Python 3.11 or newer; name it with: make PYTHON=/path/to/python" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# Python compiles modules when they are first imported: compiling all of every package ahead takes
# half of the installation, and most are never imported.
$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --no-compile --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --no-compile --editable ".[dev]"
	@touch $@ $(VENV)/.installed
