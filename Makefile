# Two commands for users, two more for developers; each works on a machine with python3 and make only.
VENV := .venv
STAMP := $(VENV)/.installed

.PHONY: demo test test-all lint bench board paper
demo: $(STAMP)
	$(VENV)/bin/jaxsat demo

test: $(STAMP) lint
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile -m "not slow"

test-all: $(STAMP) lint
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

$(STAMP): pyproject.toml
	python3 -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/python -m pip install --quiet --editable ".[dev]"
	touch $@

# The speed board; half an hour on a quiet machine, with the packages that it compares with.
bench: $(STAMP)
	$(VENV)/bin/python -m pip install --quiet --editable ".[bench]"
	$(VENV)/bin/python scripts/bench.py

# The accuracy board: every method on the real recordings in DATA; half an hour.
DATA := ../shared/data
board: $(STAMP)
	$(VENV)/bin/python -m pip install --quiet --editable ".[bench]"
	$(VENV)/bin/python scripts/accuracy.py $(DATA)

# The tables and figures of the paper; minutes once compiled programs are in the cache.
paper: $(STAMP)
	$(VENV)/bin/python scripts/reproduce_paper.py
