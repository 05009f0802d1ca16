# Set-up, demo and checks of steerbench. `make help` lists the targets.
#
#   PYTHON=python3.12      the interpreter to build the environment from (3.11 or newer)
#   VENV=.venv             where the environment lives
#   PIP_ARGS="..."         further arguments for pip; without any, torch is the build for CPUs if there is no driver
#   DEMO_ARGS="..."        overrides for the demo, e.g. DEMO_ARGS="seed=1 scene=wires"
#   PAPER_ARGS="..."       overrides for the paper's tables, e.g. PAPER_ARGS="budget=full data=DIR"
#   GPU_ARGS="..."         of docs/gpu.py, e.g. GPU_ARGS="--data DIR/mic"
#   FIGURES_ARGS="..."     of docs/figures.py, e.g. FIGURES_ARGS="--data DIR" or FIGURES_ARGS=--check

SHELL := /bin/sh
.DEFAULT_GOAL := help
.PHONY: help install demo paper figures gpu test test-all fuzz lint format constraints clean

VENV ?= .venv
BIN := $(VENV)/bin
PYTHON ?=
PIP_ARGS ?=
DEMO_ARGS ?=
FIGURES_ARGS ?=
GPU_ARGS ?=
CONSTRAINTS_ARGS ?=
PAPER_ARGS ?= budget=paper protocol=paper-1 scene=totem,totem_hd

# A complete interpreter is one that is new enough and can make environments with pip in them.
SUITS := import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))

DRIVER := ls /proc/driver/nvidia/version /usr/lib/wsl/lib/nvidia-smi 2>/dev/null | grep -q .

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' Makefile

install: $(VENV)/.installed ## make $(VENV), install steerbench into it, compile the kernels of the demo

demo: install ## build a scene, train on it, render it, write outputs/demo/report.html
	@$(BIN)/steerbench run +experiment=demo $(DEMO_ARGS)

paper: install ## measure every table of the SteerNeRF paper, write outputs/paper/report.html
	@$(BIN)/steerbench paper $(PAPER_ARGS)

# A process for each core, a file of tests in one of them, in the order of tests/conftest.py.
PYTEST = $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder

test: lint $(VENV)/.compiled ## lint, then all tests that take no more than a few seconds
	$(PYTEST) -m "not slow"

test-all: lint $(VENV)/.compiled ## lint, then all tests: what continuous integration runs
	$(PYTEST)

figures: install ## measure all that the documents show, and put it there; in hours
	@$(BIN)/python docs/figures.py $(FIGURES_ARGS)

gpu: install ## check and measure all on the GPU of this machine, in 12 minutes; outputs/gpu/report.md
	-$(BIN)/python -m pip install --disable-pip-version-check -q $(PIP_ARGS) -c constraints.txt -e ".[tensorrt]"
	@$(BIN)/python docs/gpu.py $(GPU_ARGS)

fuzz: install ## loaders and settings on whatever comes, for some minutes
	$(BIN)/python -m pytest --hypothesis-profile=fuzz tests/bench/scenes/test_fuzz.py tests/sweeps/test_fuzz.py

lint: install ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: install ## let ruff put the sources in order
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

constraints: install ## pin what pyproject.toml needs; CONSTRAINTS_ARGS=--upgrade: in its newest versions
	$(BIN)/python -m pip install --disable-pip-version-check -q uv
	UV_CUSTOM_COMPILE_COMMAND="make constraints" $(BIN)/uv pip compile pyproject.toml --all-extras --no-annotate -q \
	  --python-version 3.11 --python-platform x86_64-manylinux_2_28 -o constraints.txt $(CONSTRAINTS_ARGS)
	sed -i '/^\(nvidia\|cuda\)-/d' constraints.txt  # torch itself pins those that it was built with

clean: ## remove the environment and caches; outputs/ stays
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find bench methods reports sweeps tests -name __pycache__ -prune -exec rm -rf {} +

# The stamp is written last: an interrupted installation is taken up again by the next call.
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
	  for candidate in $(or $(PYTHON),python3.11 python3.12 python3.13 python3 python); do \
	    if $$candidate -c '$(SUITS)' >/dev/null 2>&1; then found=$$candidate; break; fi; \
	  done; \
	  if [ -z "$$found" ]; then \
	    echo "steerbench needs Python 3.11 or newer with the venv and ensurepip modules;" \
	         "none of '$(or $(PYTHON),python3.11 python3.12 python3.13 python3 python)' is one." \
	         "Install it (Debian, Ubuntu: the package python3-venv too) or name one:" \
	         "make PYTHON=/path/to/python3" >&2; exit 1; \
	  fi; \
	  echo "making $(VENV) with $$($$found --version)"; \
	  $$found -m venv --clear $(VENV); }
	@$(BIN)/python -c 'import torch' 2>/dev/null || [ -n "$(PIP_ARGS)" ] || $(DRIVER) || { \
	  echo "no NVIDIA driver: torch for CPUs is tried first"; \
	  $(BIN)/python -m pip install --disable-pip-version-check -q --retries 0 --timeout 10 -c constraints.txt \
	    --extra-index-url https://download.pytorch.org/whl/cpu torch torchvision || true; }
	$(BIN)/python -m pip install --disable-pip-version-check $(PIP_ARGS) -c constraints.txt -e ".[dev,openvino,video,viewer,colmap]"
	-$(BIN)/steerbench compile ngp steernerf gaussians
	@touch $@

# All kernels, once, or several processes of the tests would compile the same.
$(VENV)/.compiled: $(VENV)/.installed
	-$(BIN)/steerbench compile
	@touch $@
