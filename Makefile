# make view   set up and show a policy that comes with the program in the browser, at once
# make demo   set up, train the quickstart, evaluate it, export it
# make rig-demo  a policy for rallies plays five minutes with a virtual player on the emulated robot, over real sockets in
#             real time
# make study-quick  the whole study in small: five virtual players, all methods, a report (16 to 30 minutes on two
#             cores; resumable)
# make test   set up and run the tests but for the slow ones (docs/how-to/run-the-tests.md)
# make test-changed  those that a change since the last commit (BASE=...) can affect
# make test-slow  a quarter of the slow tests, another quarter at each commit
# make test-all  all tests
# make check  set up and check style, types and imports
# make exam   hide causes in logs and let the diagnosis find them: the large examination (hours; resumable)
# make docs   set up and build the documentation into docs/_build/html; a dead link is an error
# make bench  set up and measure speed against MJX and MuJoCo C
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: view demo rig-demo study-quick test test-changed test-slow durations test-all check exam docs bench setup clean

view: $(READY)
	$(BIN)/mjx-tt view

demo: $(READY)
	$(BIN)/mjx-tt train quickstart.yaml --out runs

rig-demo: $(READY)
	$(BIN)/mjx-tt run rallies --robot rig --rallies 20 --seconds 300 --player player1 --log runs/rig-demo

study-quick: $(READY)
	$(BIN)/mjx-tt is2r study_quick.yaml --out runs

# Files of tests are spread over processes, two unless WORKERS says otherwise; tests in real time run after them, one by
# one.
WORKERS  ?= 2
PYTEST   := $(BIN)/python -m pytest
PARALLEL := -n $(WORKERS) --dist loadfile --no-loadscope-reorder
FAST     := -m "not slow and not deferred and not realtime"

# Where arrays are computed: every annotation is checked, types and ranks of arrays change only where the code says so.
# The longest come first, so that neither process waits for the other at the end.
STRICT   := $(addprefix tests/mjx_tt/,rally env gradient) tests/ballmodel tests/bgs $(addprefix tests/mjx_tt/,sim robot viz)
ALL_ELSE := tests/robot_io/safety tests $(addprefix --ignore=,$(STRICT))
REALTIME  = $(shell grep -rl --include="test_*.py" "mark.realtime" tests)

test: $(READY)
	STRICT_ARRAYS=1 $(PYTEST) $(PARALLEL) $(STRICT) $(FAST)
	$(PYTEST) $(PARALLEL) $(ALL_ELSE) $(FAST)
	$(PYTEST) $(REALTIME) -m "not slow and not deferred and realtime"

# What differs from the commit BASE, and all that imports it.
BASE     ?= HEAD
test-changed: $(READY)
	$(BIN)/python -m tests.support.changed $(BASE) | xargs -r $(PYTEST) $(PARALLEL) -m "not slow and not realtime"

# The slow and the deferred tests in SHARDS parts of equal time, by the times in tests/durations.json; each commit's turn
# is another part, so that they all run within as many landings. SHARDS=1 runs all.
SHARDS   ?= 4
TURN     ?= $(shell git rev-list --count HEAD 2>/dev/null || echo 0)
PART      = --splits $(SHARDS) --group $(shell echo $$(($(TURN) % $(SHARDS) + 1))) --durations-path tests/durations.json
STUDY    := tests/experiments/study
test-slow: $(READY)
	$(PYTEST) $(PARALLEL) $(STRICT) -m "deferred and not realtime" $(PART)
	$(PYTEST) $(PARALLEL) $(ALL_ELSE) -m "deferred and not realtime" $(PART)
	$(PYTEST) $(PARALLEL) tests --ignore=$(STUDY) -m "slow and not realtime" $(PART)
	USERS_FUSION=1 $(PYTEST) $(PARALLEL) $(STUDY) -m "slow and not realtime" $(PART)
	$(PYTEST) $(REALTIME) -m "(slow or deferred) and realtime" $(PART)

test-all: test
	$(MAKE) test-slow SHARDS=1

# Times every test anew, one by one; the record says which are deferred and how the parts are cut. Some 50 minutes.
durations: $(READY)
	rm -f .cache/durations.json
	-STRICT_ARRAYS=1 $(PYTEST) $(STRICT) -m "not slow" --store-durations --durations-path .cache/durations.json
	-$(PYTEST) $(ALL_ELSE) -m "not slow" --store-durations --durations-path .cache/durations.json
	-$(PYTEST) tests -m slow --store-durations --durations-path .cache/durations.json
	$(BIN)/python -m tests.support.durations .cache/durations.json

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

exam: $(READY)
	$(BIN)/python -m tests.exam

docs: $(READY)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[docs]"
	$(BIN)/mjx-tt view --export docs/_static/view.html
	$(BIN)/python -m sphinx -W --keep-going -q -E -a -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

bench: $(READY)
	$(BIN)/python -m benchmarks.bench

setup: $(READY)

# The stamp is made last, so an interrupted set-up is repeated; a change of the dependencies renews it.
$(READY): pyproject.toml constraints.txt
	@echo "set-up: a virtual environment in $(VENV), with what constraints.txt names (minutes, about 2 GB); once only"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $(READY)
	@echo "set-up: done; $(BIN)/mjx-tt --help shows the commands"

clean:
	rm -rf $(VENV) .cache docs/_build docs/reference/generated build *.egg-info
