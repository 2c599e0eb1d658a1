# `make demo` and `make test` do their whole set-up on a machine that has Python 3.11+ and nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo demo-network test test-slow lint format bench bench-tracking bench-paper docs gallery clean

# The package's own file has the version.
$(VENV)/.installed: pyproject.toml src/sylpose/__init__.py
	$(PYTHON) -c 'import sys; sys.exit("sylpose needs Python 3.11 or newer; set PYTHON=...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

$(VENV)/.installed-bench: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@

demo: $(VENV)/.installed
	$(BIN)/sylpose demo --out demo

# Four nodes, a process each, one of which is killed and started again in the middle.
demo-network: $(VENV)/.installed-dev
	$(BIN)/sylpose network demo --out demo-network

# Small matrices gain nothing from several threads, which would get into each other's way beside several workers.
test: export OPENBLAS_NUM_THREADS = 1
test: lint
	$(BIN)/python -m tests.compile_kernels
	$(BIN)/python -m pytest -n auto --dist loadfile

# What processes of their own do beside each other, which takes minutes and a machine that has time for it.
test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# About 15 minutes. Quick, or a part of it: see `python benchmarks/two_frames.py --help`.
bench: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/two_frames.py --compare benchmarks/two_frames_baseline.json

# About an hour, most of it rendering, the peers and the two long ones; parts of it: `benchmarks/tracking.py --help`.
bench-tracking: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/tracking.py --compare benchmarks/tracking_baseline.json

# About 15 minutes: the paper's estimators.
bench-paper: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/paper_times.py
	$(BIN)/python benchmarks/certificate.py
	$(BIN)/python benchmarks/equations.py
	$(BIN)/python benchmarks/depth_plane.py
	$(BIN)/python benchmarks/consensus.py --seeds 2
	$(BIN)/python benchmarks/sensors.py --scenes 20 --turns 10

# The documentation as a site, in site/index.html. It stops at a link that leads nowhere.
docs: $(VENV)/.installed-docs
	$(BIN)/python -m pages.build --out site

# The gallery's pictures and its page, from scenes that are rendered and tracked: some minutes.
gallery: $(VENV)/.installed
	$(BIN)/python -m pages.gallery

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo demo-network site .pytest_cache .mypy_cache .ruff_cache .hypothesis
