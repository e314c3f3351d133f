# Everything runs in a virtual environment per Python version, made on first use.

# Prints the version of a Python that is new enough and can make environments.
PROBE := import sys, venv, ensurepip; assert sys.version_info >= (3, 11); \
	print("%d.%d" % sys.version_info[:2])

# The first that runs: a name on PATH may be a shim of a version that is switched off.
PYTHON ?= $(shell for python in python3.11 python3.12 python3.13 python3; do \
	"$$python" -c '$(PROBE)' >/dev/null 2>&1 && { echo "$$python"; break; }; done)
PYTHON := $(PYTHON)

SCENARIO ?= seven_joint_wall
SEED ?= 0
VERSION := $(shell "$(PYTHON)" -c '$(PROBE)' 2>/dev/null)
VENV := .venv-$(VERSION)
BIN := $(VENV)/bin
PICTURES := examples/pictures
BOOK ?= build/book

# Tests start some hundred processes, which compile all of the code again where none is kept.
unexport PYTHONDONTWRITEBYTECODE

# One process per core; one that has nothing left to do takes tests from another.
PYTEST := $(BIN)/python -m pytest -n auto --dist worksteal

# The tables that `make table` makes: each with its own environment, and its program.
TABLE_friction := examples/unknown_friction
TABLE_referee := -m referee
TABLE_robots := tests/campaign/real_robots.py
TABLE_equations := tests/support/equations.py
TABLE_peers := tests/benchmarks/contact_peers.py

.PHONY: help demo check test benchmark campaign docs pictures clean table
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

help:
	@echo 'make demo [SCENARIO=$(SCENARIO)]  simulate a scenario into runs/'
	@echo 'make check       lint, types and the quick tests: the daily round, some four minutes'
	@echo 'make test        lint, types and tests: a quarter of an hour on two cores'
	@echo 'make benchmark   speed, with ratios, beside peers that it installs; some 10 minutes'
	@echo 'make campaign    bad inputs, random robots, memory, the dearest tests: hours'
	@echo 'make table NAME=friction|referee|robots|equations|peers [ARGS=...]'
	@echo '    friction     contact whose friction the law does not know: some minutes'
	@echo '    referee      constraint forces of four engines and the right ones: some minutes'
	@echo '    robots       robots of packages, from drake-dae new to a run: an hour'
	@echo '    equations    from each equation of the paper to its line and its test'
	@echo '    peers        our law beside others on the same contact: half an hour'
	@echo 'make pictures    film the demo and a task, into $(PICTURES)/'
	@echo 'make docs        run the pages of the book and make its site, in $(BOOK)/site/'
	@echo 'make clean       remove environments, caches and packages; keeps runs/'
	@echo 'PYTHON=/path/to/python3.x chooses the interpreter; now $(or $(PYTHON),none found) $(VERSION)'

demo: $(VENV)/installed
	$(BIN)/drake-dae simulate $(SCENARIO) --out runs/$(SCENARIO)

define LINT
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
endef

check: $(VENV)/installed-dev
	$(LINT)
	$(PYTEST) -m 'not slow and not thorough'

test: $(VENV)/installed-dev
	$(LINT)
	$(PYTEST) -m 'not thorough'

benchmark: $(VENV)/installed-benchmark
	$(BIN)/python -m pytest tests/benchmarks -q

campaign: $(VENV)/installed-dev
	$(BIN)/python tests/campaign/run.py --inputs 1600 --files 2000 --robots 520 --seed $(SEED)
	$(BIN)/python tests/campaign/memory.py
	$(PYTEST) -m thorough

# Robots are those of example-robot-data, and of pybullet_data and robosuite where these are
# installed; engines of the referee that are not installed are left out: .[referee] brings them.
table: $(VENV)/installed-dev
	@test -n '$(TABLE_$(NAME))' || \
		{ echo 'NAME is friction, referee, robots, equations or peers' >&2; exit 1; }
	PYTHONPATH=tests/benchmarks $(BIN)/python $(TABLE_$(NAME)) $(ARGS)

pictures: $(VENV)/installed
	$(BIN)/drake-dae simulate wall_polish --out runs/polish
	$(BIN)/drake-dae plot --film runs/polish --force --out $(PICTURES)/wall_polish.gif
	$(BIN)/drake-dae simulate seven_joint_wall --set duration=8 --out runs/pictures
	$(BIN)/drake-dae plot --film runs/pictures --force --out $(PICTURES)/seven_joint_wall.gif

docs: $(VENV)/installed-docs
	$(BIN)/python examples/book --out $(BOOK)

clean:
	rm -rf .venv-3.* dist build .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -rf {} +

$(BIN)/python:
	@test -n '$(VERSION)' || \
		{ echo 'No usable Python >= 3.11: make ... PYTHON=/path/to/python' >&2; exit 1; }
	"$(PYTHON)" -m venv --clear $(VENV)

# An environment that was interrupted while it was made has a python and no pip.
WHOLE := @$(BIN)/python -m pip --version >/dev/null 2>&1 || "$(PYTHON)" -m venv --clear $(VENV)

$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(WHOLE)
	@echo 'Installing drake_dae and Drake into $(VENV): the first time this takes minutes.'
	$(BIN)/python -m pip install --disable-pip-version-check --editable .
	touch $@

$(VENV)/installed-%: pyproject.toml | $(BIN)/python
	$(WHOLE)
	@echo 'Installing drake_dae and tools ($*) into $(VENV): the first time this takes minutes.'
	$(BIN)/python -m pip install --disable-pip-version-check --editable '.[dev,$*]'
	touch $(VENV)/installed $(VENV)/installed-dev $@
