# make demo   set up, train the quickstart, evaluate it, export it
# make test   set up and run the tests
# make bench  set up and measure speed against MJX, MuJoCo C and PyBullet
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test bench setup clean

demo: $(READY)
	$(BIN)/mjx-tt train quickstart.yaml --out runs

test: $(READY)
	$(BIN)/python -m pytest

bench: $(READY)
	$(BIN)/pip install -q --disable-pip-version-check -e ".[bench]" || echo "PyBullet has no wheel for this Python: measured without it"
	$(BIN)/mjx-tt bench

setup: $(READY)

# The stamp is made last, so an interrupted set-up is repeated; a change of the dependencies renews it.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(READY)

clean:
	rm -rf $(VENV) .cache build *.egg-info
