.DEFAULT_GOAL := help
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# or each of the many processes that tests start compiles the product anew
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup demo test test-all run-tests test-peers bench lint docs linkcheck dist ledger clean

help:  ## Say what the targets do
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

# the newest pip takes half the time of Python 3.11's, and bytecode is compiled on all cores
$(BIN)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "hairstage needs Python 3.11 or newer; set PYTHON=python3.x"; exit 1; }
	@$(PYTHON) -m venv $(VENV) 2>/dev/null || { \
	  echo "installing python3-venv (Debian ships Python without it)"; \
	  deploy/install-debian-package.sh python3-venv && $(PYTHON) -m venv $(VENV); }
	$(BIN)/python -m pip install -q --disable-pip-version-check -U pip
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -e '.[dev]'
	-@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib reconstruction appearance stage_service simulators
	@touch $@

setup: $(BIN)/.installed  ## Make .venv, install everything, find or install libLLVM >= 16 and libatomic
	@deploy/ensure-libraries.sh

demo: setup  ## Capture, reconstruct, fit and relight; QUICK=1 SUBJECT=strands HEAD=mesh OUT=folder
	$(BIN)/hairstage demo --out $(or $(OUT),runs/demo) $(if $(SUBJECT),--subject $(SUBJECT)) $(if $(HEAD),--head $(HEAD)) $(if $(QUICK),--quick)

test: setup test-peers  ## Run the tests, and beside them lint and docs (under 12 minutes on 2 cores)
	@$(MAKE) --no-print-directory -k -j 2 lint docs run-tests

test-all: setup test-peers  ## Run the slow tests too (under 60 minutes)
	@$(MAKE) --no-print-directory -k -j 2 lint run-tests WHICH='slow or not slow'

run-tests:
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder -m '$(or $(WHICH),not slow)'

test-peers:  ## Install the programs that tests talk to, where that needs no password
	@for program in mbpoll chromium; do command -v $$program >/dev/null \
	  || { { [ "$$(id -u)" = 0 ] || sudo -n true; } && deploy/install-debian-package.sh $$program; } 2>/dev/null \
	  || echo "no $$program here: the tests that need it are skipped"; done

bench: setup  ## Run every benchmark
	$(BIN)/hairstage bench all

lint: setup  ## Style, types, floors
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: setup  ## Build the documentation into docs/_build; warnings are errors
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build

linkcheck: setup  ## Check the links of the documentation, other hosts' too
	$(BIN)/sphinx-build -q -b linkcheck docs docs/_build/linkcheck

dist: setup  ## Build sdist and wheel into dist/
	rm -rf dist
	$(BIN)/python -m build -q

ledger: setup  ## Print lines, words, circles of imports, old vocabulary; OPTIONS='--parts --words'
	$(BIN)/python tests/tools/ledger.py $(OPTIONS)

clean:  ## Remove what the targets made
	rm -rf $(VENV) runs build dist docs/_build docs/reference/generated *.egg-info
