# make demo   the whole chain on a small material, and its report    (sets everything up first)
# make test   the default test suite                                 (sets everything up first)
# make docs   the documentation as a site: output/site/index.html    (sets Python packages up first)

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PYTEST_ARGS ?=

# One stamp a job: the package with its Python dependencies, and the system libraries of the main job and of the
# tests. A stamp is out of date when pyproject.toml is newer; the system libraries are looked up on the machine each
# time, in some 50 ms, because a stamp cannot know that one was removed.
PACKAGE := $(VENV)/.package
TESTS := $(VENV)/.tests

.PHONY: help demo test test-long lint docs setup setup-tests clean
help:
	@sed -n 's/^# make/make/p' Makefile

demo: setup
	@$(BIN)/btfref demo

test: setup-tests
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

test-long: setup-tests
	@$(BIN)/python -m pytest -m "long or not long" $(PYTEST_ARGS)

lint: $(TESTS)
	@$(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/mypy

# Material for MkDocs prints a notice about MkDocs 2, which this project does not use (pyproject.toml: mkdocs < 2).
docs: $(TESTS)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --clean --config-file btfref/docs/mkdocs.yml
	@echo "output/site/index.html"

setup: $(PACKAGE)
	@$(BIN)/python -m btfref doctor --mend

setup-tests: $(TESTS)
	@$(BIN)/python -m btfref doctor --mend --for-tests

clean:
	rm -rf $(VENV) output build dist .pytest_cache .ruff_cache .hypothesis

$(PACKAGE): pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --editable .
	@touch $@

$(TESTS): pyproject.toml | $(BIN)/pip
	$(BIN)/pip install --quiet --editable '.[test]'
	@touch $@ $(PACKAGE)

# Debian and Ubuntu ship python3 without ensurepip; python3-venv brings it.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo "btfref needs Python 3.11 or later; set PYTHON=python3.11 (or newer)" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    if [ "$$(id -u)" = 0 ]; then as=; elif sudo -n true 2>/dev/null; then as='sudo -n'; else as=none; fi; \
	    if [ "$$as" = none ] || ! command -v apt-get >/dev/null; then \
	        echo "Python's venv module is missing; run: sudo apt-get install -y python3-venv" >&2; exit 2; fi; \
	    $$as apt-get update -qq && $$as env DEBIAN_FRONTEND=noninteractive \
	        apt-get install -y -qq --no-install-recommends python3-venv >/dev/null; }
	$(PYTHON) -m venv $(VENV)
