# `make demo` and `make test` do their whole set-up on a machine that has Python 3.11+ and nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# What touches cv2: OpenCV 4 and 5 are asked alike.
OPENCV_TESTS := tests/io tests/features tests/report tests/simulate tests/test_rig.py

# Compiled modules are kept, also where that is off: every process would compile all of them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo demo-network test test-fast kernels test-slow test-opencv4 test-opencv5 browser web lint format dist bench bench-page bench-record bench-tracking bench-paper docs gallery clean

# The package's own file has the version.
$(VENV)/.installed: pyproject.toml src/sylpose/__init__.py
	$(PYTHON) -c 'import sys; sys.exit("sylpose needs Python 3.11 or newer; set PYTHON=...") if sys.version_info < (3, 11) else None'
	@echo "Setting up $(VENV): pip brings NumPy, Numba, OpenCV and others, some 200 MB, once."
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --editable .
	touch $@

# Python 3.11 came with a pip that knows no groups yet.
$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) install --quiet --upgrade 'pip>=25.1'
	$(PIP) install --quiet --editable . --group dev
	touch $@

# Without Ray, browsers, solvers and formats of others: their tests are skipped.
$(VENV)/.installed-dev-min: $(VENV)/.installed
	$(PIP) install --quiet --upgrade 'pip>=25.1'
	$(PIP) install --quiet --editable . --group dev-min
	touch $@

$(VENV)/.installed-bench: $(VENV)/.installed
	$(PIP) install --quiet --editable '.[bench]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(PIP) install --quiet --upgrade 'pip>=25.1'
	$(PIP) install --quiet --editable . --group docs
	touch $@

demo: $(VENV)/.installed
	$(BIN)/sylpose demo --out demo

# Four nodes, a process each, one of which is killed and started again in the middle.
demo-network: $(VENV)/.installed-dev
	$(BIN)/sylpose network demo --out demo-network

# Small matrices and images gain nothing from several threads, which would get into each other's way beside several
# workers.
test test-fast: export OPENBLAS_NUM_THREADS = 1
test test-fast: export OPENCV_FOR_THREADS_NUM = 1
test: browser
	$(MAKE) --jobs=2 lint kernels
	$(BIN)/python -m pytest -n auto --dist worksteal

# Between two edits, under a minute: files of plain functions, no whole runs, processes, drawings or pages.
test-fast: $(VENV)/.installed-dev-min
	$(BIN)/python -m pytest -n auto --dist worksteal --fast

# Beside lint: the last ones are compiled by one process, and mypy is another.
kernels: $(VENV)/.installed-dev
	$(BIN)/python -m tests.compile_kernels

# What processes of their own do beside each other, and the other cases of what `test` shows one or two of: minutes, on a
# machine that has time for it.
test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m slow

# For the tests of pages: Debian's, where we may install it; elsewhere these tests are skipped.
CHROMIUM := chromium-headless-shell
browser:
	@test -x /usr/bin/$(CHROMIUM) || ! command -v apt-get > /dev/null || test "$$(id -u)" != 0 \
		|| { apt-get update -qq && apt-get install -y -qq --no-install-recommends $(CHROMIUM); } \
		|| echo "$(CHROMIUM) could not be installed: the tests of pages have no browser" >&2

# The script of report.html, which is committed, from its sources; with Node.js and npm (web/README.md).
web:
	cd web && npm ci --no-audit --no-fund && npm run build

# With the newest OpenCV of another generation than the one in $(VENV), in an environment of its own.
define test-opencv
	test -x $(VENV)-opencv$(1)/bin/python || $(PYTHON) -m venv $(VENV)-opencv$(1)
	$(VENV)-opencv$(1)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'
	$(VENV)-opencv$(1)/bin/python -m pip install --quiet --editable . --group dev 'opencv-python-headless==$(1).*'
	OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=$(VENV)-opencv$(1)/kernels $(VENV)-opencv$(1)/bin/python -m pytest -n auto \
		--dist loadfile $(OPENCV_TESTS)
endef

test-opencv4:
	$(call test-opencv,4)

test-opencv5:
	$(call test-opencv,5)

# Wheel and sdist in dist/: what is in them, and whether they work where there is no checkout.
dist: $(VENV)/.installed-dev
	$(PIP) install --quiet --group dist
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m tests.kernel_wheel dist
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	$(BIN)/python -m tests.installed dist

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# About 15 minutes. Quick, or a part of it: see `python benchmarks/two_frames.py --help`.
bench: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/two_frames.py --compare benchmarks/two_frames_baseline.json

# docs/benchmarks.md, from the results that `bench-record` stored.
bench-page: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/page.py

# Runs every benchmark of the page: two hours or more.
bench-record: $(VENV)/.installed-bench
	$(BIN)/python benchmarks/record.py

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
	rm -rf $(VENV) $(VENV)-opencv4 $(VENV)-opencv5 dist web/node_modules demo demo-network site .pytest_cache .mypy_cache .ruff_cache .hypothesis
