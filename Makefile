# make demo   set up, then run the main job end to end: `make demo CAPTURE=file.npz` for your own
# make test   set up, then lint, type-check and test every behaviour
# make test-all   the same with the thorough tests, as before a release: docs/development.md
# make check  lint, type-check and test what you changed: docs/development.md
# make fidelity   measure errors: `make fidelity CAPTURE=file.npz`, else on the example
# make benchmark  time lifts; benchmark-load, -fit, -scaling, -runtimes: see benchmarks/README.md
# make performance   write all figures of docs/performance.md and evidence/speed.md anew
# make fuzz   send up to 5,000 generated requests to a running service (schemathesis)
# make serve  set up, then run the service, and print the address of its page
# make docs   build the site of docs/ into build/site
# make page   build the page that the service shows at its address; demo, serve and test do so too

PYTHON ?= python3
BIN := .venv/bin
CAPTURE ?=
ARGUMENTS ?=
IMAGE_SIZE ?=
# Python may keep what it compiles of each module: dozens of processes import the same ones.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo docs page test test-all tests check changed lint types fuzz serve openapi lock benchmark fidelity performance clean

demo: .venv/compiled .venv/page
	$(BIN)/python examples/demo.py $(if $(CAPTURE),"$(CAPTURE)")

test: lint
	$(MAKE) --jobs 2 types tests

# Those that are not thorough (pyproject.toml), or with `test-all` every one.
test-all: export MARKED := -m ''
test-all: test

# Four tests at a time: many wait for processes, so two cores are busy.
tests: .venv/compiled .venv/page
	$(BIN)/pytest --numprocesses 4 --dist worksteal $(MARKED)

check: lint
	$(MAKE) --jobs 2 --output-sync types changed

changed: .venv/ready .venv/page
	packages=$$($(BIN)/python tests/packages_changed.py) && if [ -z "$$packages" ]; \
	then echo "No file that has tests was changed."; \
	else $(BIN)/pytest --numprocesses 2 --dist worksteal tests/test_floors.py $$packages; fi

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/ready
	$(BIN)/mypy

fuzz: .venv/compiled
	$(BIN)/python -P -m tests.fuzz $(ARGUMENTS)

serve: .venv/compiled .venv/page
	$(BIN)/fewview serve

benchmark: .venv/ready
	$(BIN)/python benchmarks/lift.py $(ARGUMENTS)

benchmark-%: .venv/ready
	$(BIN)/python benchmarks/$*.py $(ARGUMENTS)

fidelity: .venv/ready
	$(BIN)/python benchmarks/fidelity.py $(if $(CAPTURE),"$(CAPTURE)")

# All figures of docs/performance.md. The model is fitted once and kept beside them.
FIGURES := build/performance
THIS := $(if $(CAPTURE),--capture "$(CAPTURE)") $(if $(IMAGE_SIZE),--image-size $(IMAGE_SIZE)) --model $(FIGURES)/model.safetensors
performance: .venv/ready
	mkdir -p $(FIGURES)
	$(BIN)/python benchmarks/lift.py $(THIS) --json $(FIGURES)/lift.json
	$(BIN)/python benchmarks/load.py $(THIS) --json $(FIGURES)/load.json
	$(BIN)/python benchmarks/runtimes.py $(THIS) --json $(FIGURES)/runtimes.json
	$(BIN)/python benchmarks/fit.py $(if $(CAPTURE),"$(CAPTURE)") $(if $(IMAGE_SIZE),--image-size $(IMAGE_SIZE)) --json $(FIGURES)/fit.json --plot $(FIGURES)/fit.png
	$(BIN)/python benchmarks/scaling.py --json $(FIGURES)/scaling.json --plot $(FIGURES)/scaling.png
	$(BIN)/python benchmarks/tables.py $(foreach name,lift load runtimes fit scaling,$(FIGURES)/$(name).json)

docs: .venv/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

openapi: .venv/ready
	$(BIN)/python -P -m service.openapi > docs/openapi.json

# What the image installs, and what .venv is made of, anew: the newest versions that pyproject.toml
# allows, with their hashes.
LOCK := build/lock/bin
COMPILE := $(LOCK)/uv pip compile --quiet --upgrade --universal --generate-hashes \
  --no-emit-package torch --no-emit-package fewview --custom-compile-command 'make lock' pyproject.toml
lock:
	$(PYTHON) -m venv build/lock
	$(LOCK)/pip install --quiet uv==0.13.9
	$(COMPILE) --python-version 3.12 --extra postgresql --group build --output-file requirements.lock
	$(COMPILE) --python-version 3.11 --extra dev --output-file requirements-dev.lock

INSTALL := $(BIN)/python -m pip install --quiet --no-compile
# Finished only once everything is installed: an interrupted set-up starts over. Of what is installed,
# most is never imported: Python compiles the others as it imports them.
# torch comes from the index that pip is set to, for processors or for GPUs: each has a wheel of its own.
TORCH = $(shell sed -n 's/^ *"\(torch==.*\)",$$/\1/p' pyproject.toml)
.venv/ready: pyproject.toml client/pyproject.toml requirements-dev.lock
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Fewview needs Python 3.11 or newer")'
	$(PYTHON) -m venv .venv
	$(INSTALL) --no-deps --require-hashes --requirement requirements-dev.lock
	$(INSTALL) $(TORCH)
	$(INSTALL) --no-deps --no-build-isolation --editable ./client --editable .
	$(BIN)/python -m pip check
	touch $@

# The inner loops as machine code, before several processes want it at a time.
.venv/compiled: .venv/ready $(shell find models -name '*.py')
	$(BIN)/fewview precompile
	touch $@

# Where node or its packages cannot be had this prints why; all else works, and the next call tries
# again.
page: .venv/page
.venv/page: .venv/ready $(shell find page -name node_modules -prune -o -type f -print)
	@$(BIN)/python page/build.py && touch $@ || true

clean:
	rm -rf .venv build dist page/node_modules service/page/built *.egg-info .mypy_cache .ruff_cache .pytest_cache
