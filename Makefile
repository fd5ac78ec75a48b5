# Two commands do everything on a machine with Python 3.11+ and make: `make run`, `make test`.
# make run CONFIG=path/to/config.yaml works on any set; OUT is where its artefacts go.

PYTHON ?= python3
VENV   ?= .venv
CONFIG ?= sample_runs/two_robots/two_robots.yaml
JOBS   ?= $(shell nproc 2>/dev/null || echo 1)

BIN    := $(VENV)/bin
GVPIPE := $(BIN)/gvpipe
STAMP  := $(VENV)/.installed
DEV    := $(VENV)/.installed-dev
OUT    ?= runs/$(basename $(notdir $(CONFIG)))

# Exit code 5 means "ran, no result": the artefact is written and says why, so the chain goes on.
STAGE   = $(GVPIPE) $(1) $(CONFIG) --out $(OUT) --jobs $(JOBS) || [ $$? -eq 5 ]
SOURCES := $(shell find gvpipe -name '*.py' 2>/dev/null)
INPUTS  := $(CONFIG)

.DELETE_ON_ERROR:
.SUFFIXES:
.PHONY: help run all install dev test lint format bench docs faults fuzz fuzz-coverage audit clean distclean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

run all: $(OUT)/report/report.json ## run the whole chain on CONFIG (default: the sample)
	@echo "artefacts of $(CONFIG) are in $(OUT); look at $(OUT)/report/report.html"

$(OUT)/match/match.json: $(INPUTS) $(STAMP)
	$(call STAGE,match)

$(OUT)/localize/localize.json: $(OUT)/match/match.json
	$(call STAGE,localize)

$(OUT)/overlap/overlap.json: $(INPUTS) $(STAMP)
	$(call STAGE,overlap)

$(OUT)/slam/slam.json: $(OUT)/match/match.json $(OUT)/overlap/overlap.json
	$(call STAGE,slam)

$(OUT)/mosaic/mosaic.json: $(OUT)/slam/slam.json
	$(call STAGE,mosaic)

$(OUT)/reconstruct/obstacles.json: $(OUT)/mosaic/mosaic.json
	$(call STAGE,reconstruct)

$(OUT)/report/report.json: $(OUT)/reconstruct/obstacles.json $(OUT)/localize/localize.json
	$(GVPIPE) report $(CONFIG) --out $(OUT) --jobs $(JOBS)

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

clean: ## remove the artefacts of CONFIG
	rm -rf $(OUT)

distclean: ## remove all artefacts and the environment
	rm -rf runs $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
