# Everything from a bare checkout, with only Python 3.11+ and make.
#   make install PlushSense and PyTorch into .venv, for the tutorial
#   make demo    install, then the whole path on a virtual toy (a simulation)
#   make test    install, then all tests but the exhaustive ones, in four parts; one of them: make test-studio,
#                make test-deploy, make test-training, make test-other
#   make test-exhaustive   these: more pages, languages, chips, compilers, kills and trainings than in `make test`
#   make test-quick   install, then the tests that need no browser, compiler, emulator or cluster
#   make bench   measure the headline figures again, into docs/measurements/numbers.md: hours (ROWS=import,live: some rows)
#   make fuzz    hostile bundles, layouts, lines and models for the C, for some hours (FUZZ=10: some minutes)
#   make soak    24 hours of toy time through recorder, live and C; an hour of the studio; long fault drills (about a day)
#   make coverage   branch coverage of the base packages (tests of them, of deploy and of the command line; half an hour)
#   make check   formatting, lint, types, layers, rules of the code base
#   make docs    write docs/reference anew from the code, and build the documentation as a site, in build/site
#   make dist    wheel, source archive and list of components (SBOM), in dist; the wheel is tried in an empty environment

PYTHON ?= python3
VENV ?= .venv
DEMO_OUT ?= plushsense-demo
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
else
BIN := $(VENV)/bin
endif
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet $(PIP_FLAGS) -c constraints.txt
# uv takes a third of pip's time. It reads no settings of pip, such as a registry of one's own: if it fails, pip does it.
INSTALL = $(BIN)/uv pip install --quiet --python $(BIN)/python -c constraints.txt -e '.[$(EXTRAS)]' || $(PIP) -e '.[$(EXTRAS)]'

# Tests start hundreds of processes, each of which would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-studio test-deploy test-training test-other test-exhaustive test-quick fuzz check docs dist setup collect soak coverage install bench clean

$(VENV)/.python:
	@$(PYTHON) -c "import sys; sys.exit(0 if sys.version_info >= (3, 11) else 'PlushSense needs Python 3.11 or newer, this is ' + sys.version.split()[0] + ': run  make PYTHON=/path/to/python3.11 ...')"
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip uv
	@touch $@

# The registry's plain `torch` brings gigabytes of CUDA; an exact version takes a CPU build where one is at hand.
TORCH := $(shell sed -n 's/^torch==//p' constraints.txt)

$(VENV)/.torch: $(VENV)/.python pyproject.toml constraints.txt
	@echo "Installing PlushSense and PyTorch (once, a few minutes) ..."
	$(PIP) torch==$(TORCH)
	@touch $@

$(VENV)/.train: EXTRAS := train
$(VENV)/.train: $(VENV)/.torch
	$(INSTALL)
	@touch $@

$(VENV)/.dev: EXTRAS := train,baselines,ble,cluster,lsl,matlab,onnx,publish,studio,tables,tflite,dev,docs
$(VENV)/.dev: $(VENV)/.torch
	$(INSTALL)
	@touch $@ $(VENV)/.train

install: $(VENV)/.train

setup: $(VENV)/.dev

demo: $(VENV)/.train
	$(BIN)/plushsense demo --out $(DEMO_OUT) $(DEMO_FLAGS)

# The tests run in parts, because a worker loads and keeps what all tests of its run import.
PARTS := studio deploy training other
TESTS_studio := tests/studio
TESTS_deploy := tests/deploy tests/bench
TESTS_training := $(addprefix tests/,experiments models training workflow)
TESTS_other := $(filter-out $(TESTS_studio) $(TESTS_deploy) $(TESTS_training), \
  $(patsubst %/,%,$(wildcard tests/*/)) $(wildcard tests/test_*.py))

test: $(PARTS:%=test-%)

# Status 5: none of a part's tests was selected, as by PYTEST_FLAGS="-k NAME".
$(PARTS:%=test-%): test-%: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not exhaustive" $(TESTS_$*) $(PYTEST_FLAGS) || [ $$? -eq 5 ]

test-exhaustive: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m exhaustive $(PYTEST_FLAGS)

test-quick: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow" $(PYTEST_FLAGS)

# Several workers of pytest that begin together would each compile all the tests: 13 s of processor time each.
collect: $(VENV)/.dev
	@mkdir -p build
	$(BIN)/python -m pytest --collect-only -q > build/collected.txt || { cat build/collected.txt; false; }

# For tests that may take longer than the ten minutes after which a test is taken to hang.
UNLIMITED := -o faulthandler_timeout=0

FUZZ ?= 1000
fuzz: $(VENV)/.dev
	PLUSHSENSE_FUZZ=$(FUZZ) $(BIN)/python -m pytest $(UNLIMITED) -n auto --dist worksteal tests/deploy/test_fuzz.py \
	  tests/deploy/test_bundle_fuzz.py tests/core/test_toml.py tests/deploy/test_c_image.py::test_a_drill_of_bad_updates \
	  tests/deploy/test_firmware.py::test_computer_and_toy_read_one_grammar

# Hours of toy time, hours of the studio in real time, drills of each command with each fault.
SOAK_HOURS ?= 24
STUDIO_HOURS ?= 1
DRILLS ?= 30
soak: $(VENV)/.dev
	PLUSHSENSE_SOAK=1 PLUSHSENSE_DRILLS=$(DRILLS) $(BIN)/python -m pytest $(UNLIMITED) tests/faults tests/studio/test_live_long.py \
	  tests/recording/test_whole_session.py
	$(BIN)/python bench/soak.py --hours $(SOAK_HOURS) --studio-hours $(STUDIO_HOURS)

BASE := core devices recording dataset windows models runtime live tuning scoring
COVERED := $(addprefix tests/,$(BASE) deploy cli test_formats.py test_reference.py)
# A test that fails (some measure time) does not end it.
coverage: $(VENV)/.dev
	rm -rf build/coverage
	mkdir -p build/coverage
	-$(BIN)/python -m coverage run -m pytest $(UNLIMITED) -p no:xdist $(COVERED)
	$(BIN)/python -m coverage combine -q
	$(BIN)/python -m coverage report

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -p no:xdist tests/test_architecture.py

BENCH_OUT ?= build/numbers
bench: $(VENV)/.dev
	$(BIN)/python bench/measure.py --out $(BENCH_OUT) $(if $(ROWS),--rows $(ROWS)) $(if $(SEEDS),--seeds $(SEEDS)) $(BENCH_FLAGS)

# A warning is an error: a link that leads nowhere, a page that no other page lists.
docs: $(VENV)/.dev
	$(BIN)/python docs/reference/generate.py
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/site
	@echo "The documentation is build/site/index.html"

$(VENV)/.dist: EXTRAS := dist
$(VENV)/.dist: $(VENV)/.dev
	$(INSTALL)
	@touch $@

dist: $(VENV)/.dist
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --of JSON -o dist/plushsense-sbom.json $(BIN)/python
	$(BIN)/python .ci/check_wheel.py dist/*.whl

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
