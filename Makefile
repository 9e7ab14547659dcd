# `make demo` and `make test` need only Python >= 3.11, git and make; the environment is created on first use.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lint types doctest docs smoke bench measured paper clean

demo: NUM_FRAMES ?= 64
demo: $(VENV)/.ready  ## evaluate a built-in rig in city traffic; writes to out/demo
	$(BIN)/torchcover evaluate front_roof_128 --scenario urban --num-frames $(NUM_FRAMES) --num-workers 2 --out out/demo

# Without cached bytecode, every test process would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

# One thread per process: pytest starts as many processes as there are cores.
test: $(VENV)/.ready  ## every test
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive $(BIN)/python -m pytest --numprocesses auto --dist worksteal

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.ready
	$(BIN)/mypy
	$(BIN)/mypy tests/typing

doctest: $(VENV)/.ready  ## examples in docstrings; tests/test_documentation.py runs those of the documentation
	OMP_WAIT_POLICY=passive TORCHCOVER_CACHE_GB=0 $(BIN)/python -m pytest --doctest-modules torchcover

docs: $(VENV)/.ready  ## documentation with the generated reference, in out/site
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

smoke: $(VENV)/.ready  ## the built wheel, in an empty environment outside the repository
	TORCHCOVER_CACHE_GB=0 PYTHON="$(PYTHON)" bash .ci/smoke $(BIN)/python

bench: $(VENV)/.ready  ## docs/measured/speed.md: speed and memory
	$(BIN)/python -m benchmarks speed

measured: $(VENV)/.ready  ## tables and figures of docs/measured that are older than the code, cheapest first
	$(BIN)/python -m benchmarks

paper: NUM_FRAMES ?= 128
paper: $(VENV)/.ready  ## the paper's experiments, with the assumed LiDARs and both fits (docs/measured/paper.md)
	$(BIN)/python -m examples.paper --num-frames $(NUM_FRAMES)
	$(BIN)/python -m examples.paper tables --rigs 'paper_fit_b_{}' --reference-range 120 --origin -1.4 \
	  --num-frames $(NUM_FRAMES) --out out/paper_b

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

# The marker file is written last, so that an interrupted installation is repeated.
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) .ci/make_venv.py $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@
