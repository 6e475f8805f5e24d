# Every target sets up what it needs in .venv; a second run installs nothing again.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Workers, tests and timings use one thread each: two cores shared by BLAS threads make times meaningless.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test test-slow bench lint format clean

demo: $(VENV)/.installed
	$(BIN)/horizonet demo

test: lint
	$(BIN)/python -m pytest -m "not slow and not serial and not browser" -n 2 --dist loadfile
	$(BIN)/python -m pytest -m "(serial or browser) and not slow"

# Exit code 5 says that no test is marked slow, which is no failure.
test-slow: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m slow || test $$? -eq 5

# The table is made also where a benchmark failed.
bench: $(VENV)/.installed-bench
	rm -f build/benchmarks.jsonl
	$(BIN)/python -m pytest benchmarks -s; status=$$?; $(BIN)/python benchmarks/performance_page.py && exit $$status

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(VENV)/.installed-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis demo

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"horizonet needs Python 3.11 or newer, {sys.executable} is {v[0]}.{v[1]}; run: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.installed: $(VENV)/.created pyproject.toml
	$(BIN)/python -m pip install --quiet -e .
	touch $@

$(VENV)/.installed-test: $(VENV)/.created pyproject.toml
	$(BIN)/python -m pip install --quiet -e ".[test]"
	touch $@ $(VENV)/.installed

$(VENV)/.installed-bench: $(VENV)/.created pyproject.toml
	$(BIN)/python -m pip install --quiet -e ".[test,bench]"
	touch $@ $(VENV)/.installed
