# Each target does its own set-up: on a fresh machine `make demo` and `make test` need nothing before them.

PYTHON ?= python3
TORCH ?= default
BIN := .venv/bin
READY := .venv/ready
PEERS := build/peers/ready
TSC := node_modules/typescript/bin/tsc
BIOME := node_modules/@biomejs/biome/bin/biome
INPUTS := Makefile pyproject.toml constraints.txt CMakeLists.txt $(shell find renderer/csrc -type f) \
	$(wildcard */__init__.py */*/__init__.py)
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

ifeq ($(TORCH),cpu)
export PIP_EXTRA_INDEX_URL := $(PIP_EXTRA_INDEX_URL) https://download.pytorch.org/whl/cpu
endif

# Most tests wait for processes that they started: four more of them than cores keep two cores busy.
WORKERS ?= 6
PYTEST = $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder

# What pip cannot install, reported before anything is downloaded.
define CHECK
import importlib.util, os, shutil, sys, sysconfig
if sys.version_info < (3, 10):
    sys.exit(f"Python {sys.version.split()[0]} is too old: PanoLOG needs 3.10. Try: make PYTHON=python3.12 ...")
if not all(map(importlib.util.find_spec, ("venv", "ensurepip"))):
    sys.exit("This Python has no venv. On Debian or Ubuntu: sudo apt install python3-venv")
if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
    sys.exit("The headers of this Python are missing. On Debian or Ubuntu: sudo apt install python3-dev")
if not (os.environ.get("CXX") or any(map(shutil.which, ("c++", "g++", "clang++")))):
    sys.exit("There is no C++ compiler. On Debian or Ubuntu: sudo apt install g++")
endef
export CHECK

# Keep bytecode where a container's environment forbids it: else each process compiles PanoLOG's sources anew.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: setup demo test check unit nightly stress lint types wheel wheel-check bench clean help

setup: $(READY)  ## make .venv with everything to run, test and lint (TORCH=cpu: without CUDA)

demo: $(READY)  ## reconstruct a small town end to end, on the CPU, into runs/demo
	$(BIN)/panolog demo -o runs/demo

test: $(READY)  ## run the tests
	$(PYTEST) -m "not nightly" $(OPTIONS)

check:  ## lint, and run the unit tests: those without Ray, browser and whole runs
	@$(MAKE) --jobs=2 lint unit

# These compute: a process for each core.
unit: WORKERS = logical
unit: $(READY)
	$(PYTEST) -m "not system and not nightly"

nightly: $(READY) $(if $(findstring tests/deploy,$(or $(FILES),tests/deploy)),$(PEERS))  ## run the heavy tests that `make test` leaves out (FILES=... some of them)
	@$(PIP) --group nightly
	$(PYTEST) -m nightly $(OPTIONS) $(FILES)

stress: $(READY)  ## run the tests under load, in random order and on one core (FILES=... some of them)
	$(BIN)/python -m tests.stress $(OPTIONS) $(FILES)

lint: $(READY) $(TSC)  ## check style and types of Python and of the scripts, and the direction of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run --Werror $$(find renderer/csrc tests/renderer/cuda -name '*.cpp' -o -name '*.h' -o -name '*.cu*')
	$(BIN)/mypy
	$(BIN)/vermin --quiet --no-tips --violations --target=3.10- --exclude str.decode src/panolog/*/ tests benchmarks examples
	$(BIN)/lint-imports
	$(BIN)/node $(TSC)
	$(BIN)/node $(BIOME) check --error-on-warnings

types: $(READY)  ## write what the dashboard's scripts know of its API
	$(BIN)/python -m tests.orchestrator.watch.dashboard.api_types

wheel: $(READY)  ## build a wheel for this Python and any Linux with the same or a newer glibc, into dist/
	@$(PIP) --group wheel
	rm -rf build/wheel
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir build/wheel .
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/auditwheel repair --wheel-dir dist build/wheel/panolog-*.whl

wheel-check: wheel  ## install the newest wheel of dist/ into an empty environment and run `panolog doctor` there
	rm -rf build/wheel-venv
	$(PYTHON) -m venv build/wheel-venv
	build/wheel-venv/bin/pip install --quiet --constraint constraints.txt "$$(ls -t dist/*.whl | head -1)[all]"
	cd build/wheel-venv && bin/panolog doctor

bench: $(READY)  ## measure what is claimed to be fast
	$(BIN)/python -m benchmarks.rasterizer

clean:  ## remove everything that the other targets made, except runs/
	rm -rf .venv node_modules build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## show this
	@sed -n 's/^\([a-z-]*\):[^#]*##  *\(.*\)/  make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14

$(READY): $(INPUTS)
	@command -v $(PYTHON) >/dev/null || { echo "There is no $(PYTHON): try make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c "$$CHECK"
	@echo "Setting up .venv (the first time: some minutes, most of them for torch)"
	@rm -f $@
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(PIP) --upgrade pip
	@$(PIP) --group build
	@$(PIP) --group dev --no-build-isolation --editable '.[all]'
	@touch $@

# Launchers that read files of deploy/ in tests. They pin versions of what PanoLOG needs too, so they have a place of their own.
$(PEERS): pyproject.toml
	$(PYTHON) -m venv build/peers
	build/peers/bin/pip --disable-pip-version-check install --quiet --upgrade pip
	build/peers/bin/pip --disable-pip-version-check install --quiet --group launchers
	@touch $@

# For lint alone: running and testing PanoLOG needs nothing from npm.
$(TSC): package-lock.json $(READY)
	@PATH="$(CURDIR)/$(BIN):$$PATH" npm ci --silent --no-audit --no-fund
	@touch $@
