# Everything from a fresh clone: `make demo`, `make test`. Needs Python 3.10 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test fuzz lint clean

demo: $(VENV)/installed
	$(BIN)/calib_ros demo --out demo --force

test: $(VENV)/installed
	$(BIN)/python -m pytest $(PYTEST_ARGUMENTS)

FUZZ_SECONDS ?= 600
fuzz: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: atheris \
	    || echo 'no atheris for this Python: hypothesis alone'
	OMP_NUM_THREADS=1 $(BIN)/python test/fuzz/fuzz_run.py --seconds $(FUZZ_SECONDS)

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/installed: setup.py pyproject.toml
	$(PYTHON) -m venv $(VENV) || { echo 'needs venv: apt install python3-venv'; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[ros,test]'
	touch $@

clean:
	rm -rf $(VENV) demo build install log *.egg-info
