# POSIX sh and make. `make reproduce` and `make test` are all that most people need; both make the environment first.

PYTHON ?= python3
OUT ?= results
VENV = .venv
BIN = $(VENV)/bin
STAMP = $(VENV)/stamp

# Compiled programs are kept between runs: the second run of the tests or of an experiment starts at once.
export JAX_COMPILATION_CACHE_DIR = $(CURDIR)/.jax_cache
export JAX_PERSISTENT_COMPILATION_CACHE_MIN_COMPILE_TIME_SECS = 0.2
# Compiling is most of what the tests cost; with these it takes a quarter (measured: 5.6 to 1.3 s for one gradient, the
# Monte-Carlo tests run no slower). `make test-all` compiles as users do. The flags are those of the jax that is locked.
QUICKLY = XLA_FLAGS='--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false'

.PHONY: help env reproduce reproduce-all test test-all docs docs-short lint format lock clean

help:
	@echo 'make reproduce      the main job at full size, the other experiments in their quick form; writes results/'
	@echo 'make reproduce-all  every experiment at its published size'
	@echo 'make test           the tests            make test-all   the slow ones too'
	@echo 'make docs           executes the notebooks and builds the site (docs-short: small notebooks)'
	@echo 'make lint           ruff and pyright     make format     ruff, mending what it can'
	@echo 'make env            only the environment, .venv'
	@echo 'make lock           the newest packages into requirements.lock'
	@echo 'make clean          removes what make made'

env: $(STAMP)

# An interrupted or outdated environment is made anew; the time it took goes into the reports (first-time total).
# Byte code is made at first import, not for all packages at once: that halves the time.
$(STAMP): pyproject.toml requirements.lock
	rm -rf $(VENV)
	start=$$(date +%s) && \
	$(PYTHON) -m venv $(VENV) && \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c requirements.lock -e '.[dev]' && \
	echo $$(($$(date +%s) - start)) >$@

reproduce: env
	$(BIN)/python -m experiments reproduce --out $(OUT)

reproduce-all: env
	$(BIN)/python -m experiments run all --out $(OUT)

test: env
	$(QUICKLY) $(BIN)/python -m pytest -n 2 --dist loadgroup

test-all: env
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m 'slow or not slow'

docs: env
	$(BIN)/python docs/run_notebooks.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

docs-short: env
	$(BIN)/python docs/run_notebooks.py --short
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: env
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: env
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# All that make installs and the peers that only benchmarks use; `pip install -c` ignores what is not asked for.
lock:
	rm -rf build/lock
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --no-compile -e '.[dev,peers]'
	build/lock/bin/python -m pip freeze --exclude-editable >requirements.lock
	rm -rf build/lock

clean:
	rm -rf $(VENV) .jax_cache results site build dist .pytest_cache .ruff_cache .hypothesis
	find jaxfilt experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +
