# The same commands for people and for CI.  Everything lands in .venv beside this file.
PYTHON ?= python3
# A further package index, only needed where the CPU build of torch is not on the configured ones:
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
SOURCES := sprung noxfile.py docs/*.py deploy/grafana/*.py model replay service benchmarks tests
# seconds of the demo's working day
DAY ?= 1200
DEMO := .demo/$(DAY)/day.blf
PORT ?= 8000
PYTEST ?=
# processes that the tests are shared among
JOBS ?= auto

.DELETE_ON_ERROR:
.PHONY: pictures lock licences schemathesis docs drawing help install install-dev demo test test-slow matrix ci lint format bench clean sbom audit bandit fuzz install-fleet fleet-demo

help:
	@echo "make demo       install, replay a piece of a working day, leave the service running"
	@echo "make fleet-demo the same as a fleet: PostgreSQL, Ray Serve, vehicles that send estimates"
	@echo "make test       install, run the tests"
	@echo "make test-slow  the tests that take minutes"
	@echo "make matrix     the fast tests on Python 3.11, 3.12 and 3.13, those that are installed"
	@echo "make lint       ruff and mypy"
	@echo "make ci         lint, then the tests with coverage, as CI does"
	@echo "make docs       the documents as a site in site/"
	@echo "make bench      list the benchmarks; make bench NAME=replay runs one"

install: $(VENV)/.installed

install-dev: $(VENV)/.installed-dev

install-fleet: $(VENV)/.installed-fleet

$(VENV)/.installed-fleet: $(VENV)/.installed requirements-fleet.lock requirements-fleet.hashes.lock
	$(PIP) --no-deps --require-hashes -r requirements-fleet.hashes.lock
	@touch $@

# torch comes first and by itself: with the exact CPU build there, nothing pulls the CUDA packages
$(VENV)/.installed: requirements.lock requirements.hashes.lock pyproject.toml
	@echo "installing into $(VENV) (a few minutes the first time)"
	$(PYTHON) -m venv $(VENV)
	$(PIP) "$$(grep '^torch==' requirements.lock)"
	$(PIP) --no-deps --require-hashes -r requirements.hashes.lock
	$(PIP) --no-deps --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.lock requirements-dev.hashes.lock
	$(PIP) --no-deps --require-hashes -r requirements-dev.hashes.lock
	@touch $@

fleet-demo: install-fleet
	$(BIN)/sprung fleet demo --port $(PORT)

# a piece of a working day, always the same
$(DEMO): | install
	$(BIN)/python -m sprung.benchmarks.generator --day $(DAY) --seed 11 --clock 0.0002 --formats blf --out $(@D) \
		--fault secondary_2r.damping,420,0.7,240 --fault bogie1_1l.gain,780,1.06,180

demo: install $(DEMO)
	$(BIN)/sprung serve --replay $(DEMO) --port $(PORT) --data-dir .demo

test: install-dev
	$(BIN)/python -m pytest -n $(JOBS) --maxprocesses 4 --dist worksteal $(PYTEST)

test-slow: install-dev
	$(BIN)/python -m pytest -m slow

matrix: install-dev
	$(BIN)/nox

# what CI runs: lint, types, tests with the documented examples, coverage
ci: lint
	$(MAKE) test PYTEST="--cov --cov-report=term:skip-covered"

lint: install-dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

format: install-dev
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

# what is installed, with licences; what is known against it; what bandit finds in the source
sbom: install
	$(PYTHON) -m venv .sbom
	.sbom/bin/python -m pip --disable-pip-version-check install --quiet "cyclonedx-bom>=7,<8"
	.sbom/bin/cyclonedx-py environment $(BIN)/python --of JSON -o sbom.json

# the SHA-256 of every file of the packages in the locks; torch comes from an index of the user's choice
# (needs only uv: works also before what was added to a lock is installed)
lock: install
	$(BIN)/python -m pip --disable-pip-version-check install --quiet "uv>=0.5,<1"
	for lock in requirements requirements-dev requirements-fleet; do \
		grep -v -e "^torch==" -e "^#" $$lock.lock > .lock.in; \
		(grep "^#" $$lock.hashes.lock; $(BIN)/uv pip compile .lock.in --no-deps --generate-hashes --no-annotate --no-header \
			--quiet --python-version 3.11) > .lock.out && mv .lock.out $$lock.hashes.lock || exit 1; \
	done
	rm .lock.in

# which licence each installed package has
licences: install-dev
	$(BIN)/python docs/licences.py

# the API against its own description; needs no running service
schemathesis: install-dev
	$(BIN)/python -m pytest -q -m "slow or not slow" tests/deploy/test_schemathesis.py

# readers under coverage-guided fuzzing, FUZZ_SECONDS each; needs Linux
FUZZ_SECONDS ?= 60
fuzz: install-dev
	$(BIN)/python -m pip --disable-pip-version-check install --quiet "atheris>=3,<4"
	$(BIN)/python -m tests.fuzz.guided --seconds $(FUZZ_SECONDS)

# AUDIT="--vulnerability-service osv" asks the other database
audit: install-dev
	$(BIN)/python -m pip --disable-pip-version-check install --quiet "pip-audit>=2.7,<3"
	$(BIN)/python docs/audit.py $(AUDIT)

bandit: install-dev
	$(BIN)/python -m pip --disable-pip-version-check install --quiet "bandit>=1.8,<2"
	$(BIN)/bandit --quiet --recursive model replay service --severity-level medium --skip B104,B608

docs: install-dev
	$(BIN)/python docs/reference.py
	$(BIN)/mkdocs build --quiet --strict --site-dir site

# the pictures of docs/pages.md, and in build/pictures those of every page, width and scheme; needs Debian's chromium
pictures: install-dev
	mkdir -p build/pictures
	SPRUNG_SHOTS=build/pictures $(BIN)/python -m pytest -m slow tests/deploy/test_browser.py tests/deploy/test_morning.py
	for picture in docs/img/pages/*.png; do cp "build/pictures/$${picture##*/}" "$$picture" || exit 1; done

bench: install
	$(BIN)/sprung bench $(NAME)

clean:
	rm -rf $(VENV) .demo build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache

# the picture of docs/architecture.md; fails where folders import each other in a circle
drawing:
	$(PYTHON) docs/imports.py
