# `make` alone lists the targets. Everything installs itself into .venv on first use; Python 3.11 is all it asks for.

PYTHON ?= python3.11
VENV ?= .venv
JOBS ?= 2
WORK ?= quickstart
BIN := $(VENV)/bin
SETUP := $(VENV)/.setup-complete
MANIFESTS := $(wildcard packages/*/pyproject.toml) ci/requirements-dev.txt ci/constraints.txt

# One software-rendering thread per test process is faster than all of them fighting for the cores.
export LP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup venv quickstart test test-fast coverage check lint types format docs objects clean

help: ## This list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1|/' | awk -F'|' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: $(SETUP) ## Install everything into .venv: system libraries where missing, the four packages, the tools
venv: setup

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is not on the PATH: install Python 3.11 (Blender 4.5 LTS needs exactly that), or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(SETUP): $(MANIFESTS) | $(BIN)/python
	bash ci/system_libraries.sh
	$(BIN)/python -m pip install -q -c ci/constraints.txt setuptools wheel
	$(BIN)/python -m pip install -q --no-build-isolation -c ci/constraints.txt -r ci/requirements-dev.txt
	@touch $@

quickstart: $(SETUP) ## Render, train, refine and report on the example object, in WORK (quickstart/)
	$(BIN)/python examples/quickstart.py $(WORK)

# The run-time check of shapes and types costs two fifths of the fast tests' time; the slow ones run the same functions.
# pytest ends with 5 where PYTEST selects no test of a kind.
test: $(SETUP) ## All tests, and what the slowest cost
	$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal --durations=10 -m "not slow" $(PYTEST) || [ $$? -eq 5 ]
	$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal --durations=25 -m slow --jaxtyping-packages=none,typecheck.checked $(PYTEST) || [ $$? -eq 5 ]

test-fast: $(SETUP) ## The tests without the slow ones
	$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal -m "not slow"

coverage: $(SETUP) ## The fast tests, and which lines of the packages they do not reach
	$(BIN)/python -m pytest -q -n $(JOBS) -m "not slow" --cov --cov-report=term:skip-covered --cov-report=html:site/coverage

lint: $(SETUP) ## Formatting, lint and structure (ci/structure.py), without changing anything
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/python ci/structure.py

types: $(SETUP) ## Static types
	$(BIN)/mypy
	$(BIN)/mypy benchmarks examples experiments

check: lint types test docs ## What has to pass before a change goes in: lint, types, tests, documentation

format: $(SETUP) ## Format the code and mend what lint can mend
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(SETUP) ## The documentation, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

objects: $(SETUP) ## The example objects, from their script
	$(BIN)/python examples/objects/make_objects.py

clean: ## Remove what can be made again (not .venv, not quickstart/)
	rm -rf site .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find packages -name build -prune -exec rm -rf {} + -o -name '*.egg-info' -prune -exec rm -rf {} +
	find packages tests examples benchmarks docs -name __pycache__ -prune -exec rm -rf {} +
