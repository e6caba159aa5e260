# Everything from a bare checkout: each target makes the virtual environment it needs and installs into it once.
#
#   make demo       simulate a flight, run the navigator on it, write its report
#   make test       the fast tests and a small set of real recordings
#   make test-all   all tests: statistics over many flights, every real recording
#   make bench      speed, accuracy, reading, start-up and memory beside peers and a C++ twin
#   make lint       style, types, import rules
#   make docs       the documentation, into docs/_build/html
#   make clean      remove what was built; `make distclean` removes the virtual environment too
#
# PYTHON=... picks the interpreter (3.11 or newer), PYTEST_ARGS=... goes to pytest, DEMO_ARGS=... to the demo.

SHELL := /bin/sh
.DEFAULT_GOAL := help
.PHONY: help demo test test-all bench lint docs clean distclean
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-input
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3 python3.14 python; do \
	if $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then echo $$p; break; fi; done)

help:
	@sed -n 's/^#   //p' Makefile

# The interpreter is checked by what it can do, so that the message can say what to install.
$(BIN)/python:
	@if [ -z "$(PYTHON)" ] || ! $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
		echo "haltere needs Python 3.11 or newer, and found none: install one (Debian, Ubuntu: apt install python3 python3-venv)" \
		     "or name it (make PYTHON=/path/to/python3 ...)" >&2; exit 1; fi
	@if ! $(PYTHON) -c 'import venv, ensurepip' 2>/dev/null; then \
		echo "$(PYTHON) cannot make virtual environments: install its venv module (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; fi
	$(PYTHON) -m venv $(VENV)

# One stamp a set of dependencies; a changed pyproject.toml installs again.
$(VENV)/.base: pyproject.toml | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(VENV)/.test $(VENV)/.lint $(VENV)/.docs $(VENV)/.bench: $(VENV)/.%: pyproject.toml | $(BIN)/python
	$(PIP) --editable ".[$*]"
	@touch $@

demo: $(VENV)/.base
	$(BIN)/haltere demo $(DEMO_ARGS)

test: $(VENV)/.test
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# An empty marker expression lifts the default "not slow".
test-all: $(VENV)/.test
	$(BIN)/python -m pytest -m "" $(PYTEST_ARGS)

bench: $(VENV)/.bench
	$(BIN)/python benchmarks/run.py $(BENCH_ARGS)

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -q -j auto -b html docs docs/_build/html

clean:
	rm -rf build dist docs/_build docs/jupyter_execute benchmarks/build demo.haltere
	rm -rf .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache .coverage
	find src tests benchmarks docs -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
