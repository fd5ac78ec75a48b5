# Two commands do everything on a machine with Python 3.11+ and make: `make run`, `make test`.
# make run CONFIG=path/to/config.yaml works on any set; its artefacts go where it says,
# or to OUT.

PYTHON ?= python3
VENV   ?= .venv
CONFIG ?= sample_runs/two_robots/two_robots.yaml
JOBS   ?= $(shell nproc 2>/dev/null || echo 1)

BIN    := $(VENV)/bin
GVPIPE := $(BIN)/gvpipe
STAMP  := $(VENV)/.installed
DEV    := $(VENV)/.installed-dev
OUT    ?=

# Where CONFIG says, unless OUT is given.
ARGUMENTS = "$(CONFIG)" $(if $(OUT),--out "$(OUT)")

OUTPUT    = $(BIN)/python -c 'import pathlib, gvpipe.configfile as c; \
	print(c.load_config(pathlib.Path("$(CONFIG)")).output)'
ARTEFACTS = match localize overlap slam mosaic reconstruct report .*.lock .*.checkpoints

.DELETE_ON_ERROR:
.SUFFIXES:
.PHONY: help run all install dev test lint format bench docs faults fuzz fuzz-coverage audit clean distclean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# gvpipe knows by content what is fresh, so it is always asked. Exit code 5 means "ran, no result":
# the artefact is written and says why, and so does the report.
run all: $(STAMP) ## run what has changed of the chain on CONFIG (default: the sample), and report
	$(GVPIPE) run $(ARGUMENTS) --jobs $(JOBS) || [ $$? -eq 5 ]
	$(GVPIPE) report $(ARGUMENTS) --jobs $(JOBS)

install: $(STAMP) ## set up gvpipe in $(VENV)

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(STAMP): pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable . --constraint constraints.txt
	@touch $@

dev: $(DEV) ## set up the development tools as well

$(DEV): pyproject.toml constraints.txt $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]' --constraint constraints.txt
	@touch $@

test: $(DEV) ## run the tests
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

lint: $(DEV) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(DEV) ## format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(DEV) ## measure speed against named peers
	@for f in tests/bench/bench_*.py; do echo "== $$f"; $(BIN)/python -m tests.bench.$$(basename $$f .py) || exit 1; done

docs: $(DEV) ## render docs/ as a web site in runs/site
	$(BIN)/mkdocs build --strict --quiet --site-dir runs/site

faults: $(DEV) ## kill, interrupt and starve runs at random (half an hour; mounting a full disk needs root)
	$(BIN)/python -m tests.faults.kills 200
	$(BIN)/python -m tests.faults.signals 60
	$(BIN)/python -m tests.faults.fulldisk 9
	$(BIN)/python -m tests.faults.same

fuzz: $(DEV) ## read 20,000 damaged configurations and 5,000 damaged artefacts
	$(BIN)/python -m tests.faults.fuzz 20000 5000

fuzz-coverage: $(DEV) ## search for configurations that break the reader, led by coverage
	$(BIN)/python -m pip install --quiet --disable-pip-version-check atheris
	$(BIN)/python -m tests.faults.coverage_fuzz -max_total_time=300 -max_len=4096 configs

audit: $(DEV) ## look the pinned packages up among known weaknesses
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip

clean: $(STAMP) ## remove the artefacts of CONFIG
	cd "$(or $(OUT),$(shell $(OUTPUT)))" && rm -rf $(ARTEFACTS)

distclean: ## remove all artefacts and the environment
	rm -rf runs $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
