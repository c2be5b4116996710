# Each target makes its own environment in .venv first; a second call finds it ready.
PYTHON ?= python3
WORKERS ?= 2
BIN := .venv/bin
READY := .venv/.ready
BENCHMARKS = $(filter-out benchmarks/common.py benchmarks/decoys.py benchmarks/m22_truth.py benchmarks/onnx_rivals.py benchmarks/score_worlds.py,$(wildcard benchmarks/*.py))

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow lint bench system-packages clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY) ## make .venv with the pinned packages of constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else \
		"EDP needs Python 3.11 or newer, $(PYTHON) is %d.%d; for example: make PYTHON=python3.12 setup" % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet $(shell sed -n '/^torch==/p' constraints.txt)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(READY) ## the main job, small: simulate, train, judge, write a report page
	$(BIN)/edp demo --out demo

test: $(READY) ## the fast tests
	$(BIN)/python -m pytest -n $(WORKERS)

test-slow: $(READY) ## the tests that take minutes
	$(BIN)/python -m pytest -m slow --timeout 3600

lint: $(READY) ## style, types and the import ladder
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY) ## every benchmark, quick
	@for file in $(BENCHMARKS); do echo "== $$file"; $(BIN)/python $$file --quick || exit 1; done

system-packages: ## packages of the system that only some checks need: chromium for pages, ffmpeg for films, octave for MAT fixtures and MATLAB code, compilers, QEMU and Wine for exported code
	-$(if $(filter 0,$(shell id -u)),,sudo) apt-get update --quiet --quiet
	$(if $(filter 0,$(shell id -u)),,sudo) apt-get install --yes --no-install-recommends chromium ffmpeg octave octave-dev wine \
		gcc libc6-dev clang libclang-rt-dev cmake cppcheck gcc-mingw-w64-x86-64 wine64 gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm

clean: ## remove .venv and caches; runs, data and demo stay
	rm -rf .venv build dist src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} +
