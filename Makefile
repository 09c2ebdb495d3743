# Thin names for what start.py and pytest do; nothing here is needed to use the project.
PYTHON ?= python3
VENV := .venv/bin/python

.PHONY: run test lint bench calibration

run:
	$(PYTHON) start.py run

test:
	$(PYTHON) start.py test

lint:
	$(PYTHON) start.py setup
	$(VENV) -m pip install --quiet --only-binary :all: -r requirements/lock-lint.txt
	$(VENV) -m ruff check .
	$(VENV) -m mypy

bench:
	$(PYTHON) start.py setup
	$(VENV) -m benchmarks

calibration:
	$(PYTHON) start.py test -m slow
	$(VENV) -m studies.calibration
