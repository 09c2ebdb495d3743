# Thin names for what start.py and pytest do; nothing here is needed to use the project.
PYTHON ?= python3
VENV := .venv/bin/python

.PHONY: run test lint bench calibration concealed

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

SEED ?= $(shell date +%s)
concealed:
	$(PYTHON) start.py setup
	$(VENV) -m studies.concealed generate --cases 120 --seed $(SEED) --out results/concealed/cases --answers results/concealed/answers
	$(VENV) -m studies.concealed run --cases results/concealed/cases --out results/concealed/runs
	$(VENV) -m studies.concealed score --results results/concealed/runs --answers results/concealed/answers --out results/concealed/table.md
