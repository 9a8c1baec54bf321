# Works on a machine with only Python >= 3.11, pip, make and git.
#   make train   sets up, then trains and evaluates the preset `cpu` in a new folder under runs/
#   make test    sets up, then runs the linters and the fast tests
# Another interpreter: make setup PYTHON=/path/to/python3.11

SHELL := /bin/bash
.DELETE_ON_ERROR:

# Prints the first of its arguments that is a Python of at least this minor version; a version manager's shim may exist and not run.
first_python = $(shell for python in $(2); do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, $(1)))' 2>/dev/null && echo "$$python" && break; done)

PYTHON ?= $(call first_python,11,python3 python3.11 python3.12 python3.13)
PYTHON_NEWEST ?= $(call first_python,12,python3.12 python3.13 python3 $(wildcard $(HOME)/.pyenv/versions/3.12*/bin/python))
PRESET ?= cpu
CONSTRAINTS_NEWEST ?= constraints-newest.txt
RUN ?= runs/$(PRESET)-$(shell date +%Y%m%d-%H%M%S)
PYTEST_ARGS ?= -n 2 --dist loadfile --no-loadscope-reorder

VENV := .venv
VENV_NEWEST := .venv-newest
SETUP := $(VENV)/.setup
SETUP_NEWEST := $(VENV_NEWEST)/.setup

.PHONY: help setup train test lint format test-slow test-newest clean

help:
	@sed -n '2,4s/^# *//p' Makefile

setup: $(SETUP)

$(SETUP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python >= 3.11 found; name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

train: setup
	$(VENV)/bin/vsearch train --preset $(PRESET) --out $(RUN)

lint: setup
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports

format: setup
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

test: lint
	$(VENV)/bin/python -m pytest $(PYTEST_ARGS)

test-slow: setup
	$(VENV)/bin/python -m pytest -m slow

test-newest: $(SETUP_NEWEST)
	$(VENV_NEWEST)/bin/python -m pytest $(PYTEST_ARGS)

$(SETUP_NEWEST): pyproject.toml $(CONSTRAINTS_NEWEST)
	@test -n "$(PYTHON_NEWEST)" || { echo "make: no Python >= 3.12 found; name one: make test-newest PYTHON_NEWEST=/path/to/python3.12" >&2; exit 2; }
	$(PYTHON_NEWEST) -m venv $(VENV_NEWEST)
	$(VENV_NEWEST)/bin/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS_NEWEST) -e '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) $(VENV_NEWEST) .cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis build dist
