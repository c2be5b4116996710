# Each target makes its own environment in .venv first; a second call finds it ready.
PYTHON ?= python3
WORKERS ?= 2
BIN := .venv/bin
# A worker takes whole files, so that what the tests of a file share (a training, a study) is made once.
SIDE_BY_SIDE = -n $(WORKERS) --dist loadfile
# Python keeps the bytecode of what it imports, also where the caller's environment forbids it: without it each worker and
# each of the tests' hundreds of child processes compiles some thousand sources anew, which takes as long as they run.
export PYTHONDONTWRITEBYTECODE :=
READY := .venv/.ready
INSTALL := pip install --quiet --no-deps
BENCHMARKS = $(shell grep -l '^@benchmark' benchmarks/*.py)

.DEFAULT_GOAL := help
.PHONY: help setup lock demo docs english reading-test docs-test check test test-slow lint bench system-packages clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY) ## make .venv with the pinned packages of requirements.lock

# torch comes first and by plain pip: which of its builds fits depends on the machine, so no hash can be locked.
# uv is itself installed by the hash of the lock. Without uv, pip installs the same files.
$(READY): pyproject.toml constraints.txt requirements.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if (3, 11) <= v < (3, 15) else \
		"EDP needs Python 3.11 to 3.14, $(PYTHON) is %d.%d; for example: make PYTHON=python3.12 setup" % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet $(shell sed -n '/^torch==/p' constraints.txt)
	@sed -n '/^uv==/,/[^\\]$$/p' requirements.lock > .venv/uv.lock
	@if $(BIN)/python -m pip install --quiet --no-deps --require-hashes -r .venv/uv.lock && $(BIN)/uv --version; then \
		set -x; $(BIN)/uv $(INSTALL) --python $(BIN)/python --require-hashes -r requirements.lock; \
	else \
		echo "uv cannot be installed here: pip installs instead, which takes longer"; \
		set -x; $(BIN)/python -m $(INSTALL) --require-hashes -r requirements.lock; \
	fi
	$(BIN)/python -m $(INSTALL) --no-build-isolation -e .
	@$(BIN)/edp doctor --compile > /dev/null || echo "compiling ahead failed: code is compiled at its first use"
	@touch $@

lock: ## write requirements.lock from pyproject.toml and constraints.txt; give the result to a review
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header \
		--extra dev --constraint constraints.txt --no-emit-package torch pyproject.toml --output-file requirements.lock
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header \
		--group docs --output-file requirements-docs.lock

demo: $(READY) ## the main job, small: simulate, train, evaluate, write a report page
	$(BIN)/edp demo --out demo

# The builder has an environment of its own: whoever trains models needs none of it.
docs: $(READY) .venv-docs/.ready ## the documentation site in site/, offline; with VERSION=0.1 beside others in site/0.1; with the pages of demo/ where `make demo` made them
	PYTHONPATH=website$(if $(PYTHONPATH),:$(PYTHONPATH)) $(BIN)/python -m edp_site build/docs --demo demo $(if $(VERSION),--version '$(VERSION)')
	cd build/docs && ../../.venv-docs/bin/zensical build --clean --strict --config-file mkdocs.yml
	PYTHONPATH=website$(if $(PYTHONPATH),:$(PYTHONPATH)) $(BIN)/python -m edp_site.built build/docs/site
	$(if $(VERSION),PYTHONPATH=website $(BIN)/python -m edp_site.versions build/docs/site site '$(VERSION)',rm -rf site && mv build/docs/site site)

.venv-docs/.ready: requirements-docs.lock
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m $(INSTALL) --require-hashes -r requirements-docs.lock
	@touch $@

english: $(READY) ## the language: constructions and names that the style guide excludes, against tests/language/allowed.toml
	$(BIN)/python tests/language/english.py

reading-test: $(READY) ## samples for a reader without the repository in build/reading/SEED; SEED=1
	$(BIN)/python tests/language/reading.py --seed $(or $(SEED),0)

docs-test: $(READY) ## every code block, command line, link, figure and length of the documentation
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) tests/site tests/examples tests/unit/test_language.py

check: lint english ## lint, language, contracts and unit tests that start no process and train for no seconds
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) --no-processes tests/contracts tests/unit

test: $(READY) ## the fast tests
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

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
		gcc libc6-dev valgrind clang libclang-rt-dev cmake cppcheck gcc-mingw-w64-x86-64 wine64 gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm

clean: ## remove .venv and caches; runs, data and demo stay
	rm -rf .venv .venv-docs build dist site src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} +
