# Everything happens in a virtual environment of the checkout's own, .venv; the first target that needs it makes it, in two
# stages: `make setup` installs what the demo needs, `make setup-dev` also all extras and what tests and documentation need.
#   make demo     one scan in, a panorama out          make test    the whole test suite
#   make test-released   every documented command on the released weights, a quarter of an hour; ONLY=README: README's
#   make lint     format, lint, types, spelling        make docs    the documentation, in site/
#   make generated   parts of pages that come from the program
#   make fuzz     seeded mutants through every reader, then atheris, guided by coverage; SECONDS=3600 each
#   make kills    every command that writes for long, killed at random instants and repeated, KILLS=20 times each
#   make dist     wheel and sdist, in dist/            make clean   remove what was made, .venv too
# PYTHON=python3.12 chooses the interpreter; TORCH_INDEX=URL another package index for torch, such as one of CPU builds
# (on Linux the usual index has large CUDA ones).

PYTHON ?= python3
TORCH_INDEX ?=
BIN := .venv/bin
STREETS := $(wildcard packages/lidar2pano-streets) # weights under another licence, which an sdist leaves out
SOURCES := src tests runs docs examples
# Python compiles what it imports; to compile all 20,000 installed files takes another minute and a half.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt

.PHONY: setup setup-dev demo test test-released fuzz kills lint format generated docs dist clean

setup: .venv/.ready
setup-dev: .venv/.ready-dev

.venv/.ready: pyproject.toml constraints.txt $(wildcard packages/*/pyproject.toml)
	@command -v $(PYTHON) >/dev/null && $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "lidar2pano needs Python 3.11 or newer and '$(PYTHON)' is not; try: make PYTHON=python3.11" >&2; exit 1; }
	test -x $(BIN)/pip || $(PYTHON) -m venv .venv
	$(INSTALL) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	$(INSTALL) --editable '.[fast]' $(addprefix --editable ./,$(STREETS))
	@touch $@

.venv/.ready-dev: .venv/.ready
	$(BIN)/python -m pip install --quiet 'pip>=25.1' # the first that knows dependency groups
	$(INSTALL) --editable '.[all]' --group dev
	@touch $@

demo: setup
	$(BIN)/lidar2pano demo

test: setup-dev # in the order of the folders: modules of many tests first would leave the long ones of few for the end
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadscope --no-loadscope-reorder

test-released: setup-dev
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadgroup --released -m released $(if $(ONLY),-k '$(ONLY)') tests/released

fuzz: setup-dev
	$(BIN)/python tests/fuzz/campaign.py --replay --seconds $(or $(SECONDS),3600) --seed $(or $(SEED),0)
	$(BIN)/python tests/fuzz/fuzz_readers.py --corpus build/fuzz
	$(BIN)/python tests/fuzz/fuzz_readers.py build/fuzz -max_total_time=$(or $(SECONDS),3600) -rss_limit_mb=700 -timeout=10 \
	  -artifact_prefix=build/ -print_final_stats=1

kills: setup-dev
	$(BIN)/python -m pytest --kills $(or $(KILLS),20) tests/robustness/test_kills.py

lint: setup-dev
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/pyright
	$(BIN)/codespell

format: setup-dev
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

generated: setup-dev
	$(BIN)/python docs/generated.py

docs: setup-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

dist: setup-dev
	rm -rf dist
	$(BIN)/hatchling build -t sdist
	$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist dist/lidar2pano-*.tar.gz
	$(foreach folder,$(STREETS),cd $(folder) && $(CURDIR)/$(BIN)/hatchling build -d $(CURDIR)/dist)

clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache
	find src tests -name __pycache__ -prune -exec rm -rf {} +
