# The whole of graspd's housekeeping; `make help` lists it.
SHELL := /bin/bash
VENV ?= .venv
PYTHON ?=
STAMP := $(VENV)/.graspd-setup
RUN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help setup test check format demo bench-foundation clean

help:  ## list the targets
	@grep -hE '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 20

setup: $(STAMP)  ## build .venv (Python 3.11 or 3.12; PYTHON=... names one)

$(STAMP): pyproject.toml setup.py setup.cfg constraints.txt scripts/setup.sh
	@scripts/setup.sh $(VENV) $(PYTHON)
	@touch $@

test: setup  ## run the fast tests
	$(RUN)/python -m pytest

check: setup  ## lint, formatting and types
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/pyright

format: setup  ## format and sort imports in place
	$(RUN)/ruff check --fix .
	$(RUN)/ruff format .

demo: setup  ## the main job over DDS: a mug in, verified grasps, a picture and figures out, in demo/
	$(RUN)/python examples/demo.py

bench-foundation: setup  ## make the README's results table anew
	$(RUN)/python benchmarks/foundation.py --readme README.md $(if $(MESHES),--meshes $(MESHES))

clean:  ## remove what was made, the environment excepted
	rm -rf demo results build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
