# make demo   set up, then run the main job end to end: `make demo CAPTURE=file.npz` for your own
# make test   set up, then lint, type-check and test
# make fidelity   measure errors: `make fidelity CAPTURE=file.npz`, else on the example
# make benchmark  time lifts; benchmark-load, -fit, -scaling, -runtimes: see benchmarks/README.md
# make serve  set up, then run the service on http://127.0.0.1:8000

PYTHON ?= python3
BIN := .venv/bin
CAPTURE ?=
ARGUMENTS ?=

.PHONY: demo test serve openapi benchmark fidelity clean

demo: .venv/ready
	$(BIN)/python examples/demo.py $(if $(CAPTURE),"$(CAPTURE)")

test: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest

serve: .venv/ready
	$(BIN)/fewview serve

benchmark: .venv/ready
	$(BIN)/python benchmarks/lift.py $(ARGUMENTS)

benchmark-%: .venv/ready
	$(BIN)/python benchmarks/$*.py $(ARGUMENTS)

fidelity: .venv/ready
	$(BIN)/python benchmarks/fidelity.py $(if $(CAPTURE),"$(CAPTURE)")

openapi: .venv/ready
	$(BIN)/python -m service.openapi > docs/openapi.json

# Finished only once everything is installed: an interrupted set-up starts over.
.venv/ready: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Fewview needs Python 3.11 or newer")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
