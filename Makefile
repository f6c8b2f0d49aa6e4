# make demo: learn to park, then diagnose a concealed effect, over the whole emulated hardware path.   make test: linters, types, layers, tests.   make test-slow: the long studies.
# make docs: the documentation site in build/site.   make pictures: the pictures of the documentation.
# Each sets up .venv by itself on a fresh machine that has Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Bytecode is written, so that each process does not compile each module again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-slow lint ruff types layers computing driving docs pictures clean

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "carlab needs Python 3.11 or newer; run: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@# torch first and by its exact version, so that nothing else pulls in another build of it. Bytecode of all its
	@# modules would take half of the installation; the last line writes that of the modules in use.
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	@$(BIN)/python -c 'import torch, stable_baselines3, scipy.signal, matplotlib.pyplot, pyarrow, rerun'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/python -u examples/demo.py

# The parts run side by side, and each prints its output when it ends.
lint: $(VENV)/.installed
	$(MAKE) --jobs --output-sync ruff types layers

test: $(VENV)/.installed
	@echo "Linters, types, layers and all tests run side by side. Each part prints its output when it ends."
	$(MAKE) --jobs --output-sync ruff types layers computing driving

ruff:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types:
	$(YIELD) $(BIN)/mypy

layers:
	$(YIELD) $(BIN)/lint-imports

# Tests that drive against the clock mostly wait; tests that only compute take the processors whenever those wait.
# Each file runs in one process, which shares its fixtures; files with few long tests come first, so that none is last.
COMPUTING := tests/examples tests/diagnosis tests/cli tests/studies tests/benchmark tests/jobs tests/learning \
	$(addprefix tests/experiment/,test_child_process.py test_quick_check.py test_priors_and_predictions.py test_training.py test_cluster_training.py test_cluster_orders.py test_learning_on_a_device.py) \
	tests/prediction tests/sim_backends tests/api tests/recording tests/test_architecture.py
# One process more than processors: some of these tests also drive, and wait.
PROCESSES = $(shell $(PYTHON) -c 'import os; print((os.cpu_count() or 1) + 1)')
# In its own session: a session that mixes priorities can keep emulated cars from the processors (see the file).
YIELD := $(BIN)/python tests/helpers/low_priority.py
computing driving test-slow: export OMP_NUM_THREADS := 1

computing:
	$(YIELD) $(BIN)/pytest --numprocesses $(PROCESSES) --dist loadfile --no-loadscope-reorder $(COMPUTING)

driving:
	$(BIN)/pytest --numprocesses 2 --dist loadfile $(addprefix --ignore=,$(COMPUTING))

# Long studies, which `make test` leaves out. Each prints its duration.
test-slow: $(VENV)/.installed
	$(YIELD) $(BIN)/pytest --numprocesses 2 --dist loadfile -m slow --durations=0 --durations-min=1

docs: $(VENV)/.installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

pictures: $(VENV)/.installed
	$(BIN)/python docs/pictures.py

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
