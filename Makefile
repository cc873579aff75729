# Two commands do everything: `make demo` and `make test`. Needs python3 >= 3.11, make and a package registry.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# A stamp per extra: an edit of pyproject.toml reinstalls, nothing else does.
BASE := $(VENV)/.installed
DEV := $(VENV)/.installed-dev
BENCH := $(VENV)/.installed-bench
DOCS := $(VENV)/.installed-docs

# A worker is about a gigabyte. Stealing keeps tests of a file together, and no worker idle.
WORKERS := --numprocesses auto --maxprocesses 8 --dist worksteal

# Editable installs get no compiled kernels, so that their build needs none of the packages that compile them.
export HATCH_BUILD_NO_HOOKS := true

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help demo test test-deep check format bench docs clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile

demo: ## build the demo scene and render it to pictures under out/, installing Lumisplat if it is missing
	@test -x $(BIN)/lumisplat || $(MAKE) --no-print-directory $(BASE)
	$(BIN)/lumisplat demo -o out

test: $(DEV) ## run the daily suite, a process for each core
	$(BIN)/python -m pytest $(WORKERS)

test-deep: $(DEV) ## run all tests, with the long ones marked deep: studies, seeds, every stored twin
	$(BIN)/python -m pytest $(WORKERS) -m "" --recompute-twins

check: $(DEV) ## formatting, lint, types, spelling and sizes; .pre-commit-config.yaml has the same list
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/typos
	git ls-files -z | xargs -0 $(BIN)/check-added-large-files --enforce-all --maxkb=1024

format: $(DEV) ## format the code and fix what lint can
	$(BIN)/ruff check --fix --exit-zero .
	$(BIN)/ruff format .

bench: $(BENCH) ## run the benchmarks beside Mitsuba, and write their tables in docs/benchmarks.md
	$(BIN)/python -m bench.run --write
	$(BIN)/python -m bench.path_rate --write

docs: $(DOCS) ## build the documentation under docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -q -j auto -b html docs docs/_build/html

clean: ## remove the environment and everything that was built
	rm -rf $(VENV) out docs/_build .pytest_cache .ruff_cache .hypothesis

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "error: Lumisplat needs Python 3.11 or newer as $(PYTHON); give another: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "error: $(PYTHON) cannot make virtual environments: install its venv module (Debian: apt install python3-venv)" >&2; \
	  exit 1; }
	@echo "Making the environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(BASE): pyproject.toml | $(VENV)/.created
	@echo "Installing Lumisplat"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/.installed-%: pyproject.toml | $(VENV)/.created
	@echo "Installing Lumisplat with the extra [$*]"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[$*]"
	@touch $@
