# `make demo` and `make test` do all set-up: Python packages in .venv (or the active environment), a working libLLVM.
ACTIVE := $(or $(VIRTUAL_ENV),$(CONDA_PREFIX))
BIN := $(or $(ACTIVE),.venv)/bin
OUT ?= out/demo

.PHONY: help demo test quick attack bench bench-full notebooks docs lint package clean

help:
	@echo "make demo       fit a small capture made on the spot and write $(OUT)/report.html"
	@echo "make test       all tests"
	@echo "make quick      the tests that take seconds"
	@echo "make attack     all damaged and hostile inputs, kills and full disks (an hour)"
	@echo "make bench      every quoted benchmark in reduced size, within an hour"
	@echo "make bench-full the same in full size, in a night"
	@echo "make notebooks  runs the notebooks in reduced size"
	@echo "make docs       builds the documentation into site/"
	@echo "make lint       ruff and mypy"
	@echo "make package    builds wheel and sdist and tries the wheel in an empty environment"

demo:
	@.ci/setup
	$(BIN)/mifit demo --out $(OUT)
	@echo "The command is $(BIN)/mifit; two clips of a face: $(BIN)/mifit fit left.mp4 right.mp4 --out me"

test:
	@.ci/setup test cluster view bench sound
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

quick:
	@.ci/setup test
	$(BIN)/python -m pytest -m "not slow"

attack:
	@.ci/setup test
	$(BIN)/python -m tests.hostile.attack
	$(BIN)/python -m tests.hostile.endure

bench:
	@.ci/setup bench
	$(BIN)/python -m benchmarks

bench-full:
	@.ci/setup bench
	$(BIN)/python -m benchmarks --full

notebooks:
	@.ci/setup notebooks
	$(BIN)/python notebooks/run.py

docs:
	@.ci/setup docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint:
	@.ci/setup test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

package:
	@.ci/setup test
	@.ci/package

clean:
	rm -rf .venv build dist site *.egg-info
