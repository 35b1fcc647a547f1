# make demo   plans one query and draws it       make test      what CI checks
# make lint   style and types only               make docs      the site, in build/docs
# make clean  removes what these leave behind
PYTHON ?= python3
VENV ?= .venv

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --quiet
DEMO_INSTALLED := $(VENV)/.installed-demo
TEST_INSTALLED := $(VENV)/.installed-test
DOCS_INSTALLED := $(VENV)/.installed-docs

SCENE := assets/scenes/blocks

.PHONY: demo test lint docs clean

demo: $(DEMO_INSTALLED)
	mkdir -p demo
	$(BIN)/python -m gnnjax.plan --robot kuka_iiwa14 --scene $(SCENE).json \
	  --start $$(cat $(SCENE)_start.txt) --goal $$(cat $(SCENE)_goal.txt) \
	  --out demo/path.npz --image demo/plan.png

test: lint
	$(BIN)/python -m pytest

lint: $(TEST_INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(DOCS_INSTALLED)
	JAX_PLATFORMS=cpu $(BIN)/python -m sphinx -q -n -W --keep-going docs build/docs
	@echo wrote build/docs/index.html

# Installed anew only when pyproject.toml changes; the installs are editable.
$(DEMO_INSTALLED): pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[viz]'
	@touch $@

$(TEST_INSTALLED): pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[viz,experiments,docs,dev]'
	@touch $@

$(DOCS_INSTALLED): pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[viz,view,docs]'
	@touch $@

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf .venv .pytest_cache .ruff_cache build dist demo
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +
