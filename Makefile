# Each target does all of its own set-up in a virtual environment here (.venv); Python 3.11 or newer is enough.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

.PHONY: demo test fuzz lint types package bench clean

demo: $(VENV)/.stamp
	$(BIN)/marcha demo -o demo --force $(if $(SHOW),--show)

test: $(VENV)/.stamp-dev
	$(BIN)/python -m pytest -n auto --dist worksteal

# Damaged inputs for all that reads; what failed is named with what reproduces it.
N ?= 10000
fuzz: $(VENV)/.stamp-dev
	$(BIN)/python -m tests.fuzz $(N)

lint: $(VENV)/.stamp-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# pyright reads `marcha.<folder>` of the tests through one link to this folder.
types: $(VENV)/.stamp-dev
	mkdir -p .pyright && ln -sfn .. .pyright/marcha
	$(BIN)/pyright --threads --pythonpath $(BIN)/python

package: $(VENV)/.stamp-dev
	$(BIN)/python tests/check_package.py

bench: $(VENV)/.stamp-dev
	$(BIN)/python -m benchmarks

$(VENV)/.stamp: pyproject.toml
	$(PYTHON) -c "import sys; sys.exit('marcha needs Python 3.11 or newer; set PYTHON=python3.x' if sys.version_info < (3, 11) else 0)"
	@echo "setting up $(VENV), once: some minutes without a word"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade "pip>=25.1"
	$(BIN)/python -m pip install -q -e .
	touch $@

$(VENV)/.stamp-dev: $(VENV)/.stamp
	$(BIN)/python -m pip install -q --group dev
	-$(BIN)/python -m pip install -q --group readers  # optional: some platforms have no wheels
	touch $@

clean:
	rm -rf $(VENV) demo build dist *.egg-info .pyright
