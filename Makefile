PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# Two worker processes; one that runs out of tests takes some of the other's.
PYTEST := $(BIN)/python -m pytest --numprocesses 2 --dist worksteal
INSTALL := $(BIN)/python scripts/install.py
# Packages are installed without byte code; Python writes and keeps it for the modules that are used. Container images often
# forbid that by this variable, and then each start of the program would compile all its modules again: 8 CPU-seconds.
unexport PYTHONDONTWRITEBYTECODE

# Makes libraries that choose their instructions by the processor choose the plainest. Compiled kernels have a cache for each
# processor, so the ordinary ones are kept.
GENERIC := NUMBA_CPU_NAME=generic OPENBLAS_CORETYPE=Prescott ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 \
	DNNL_MAX_CPU_ISA=SSE41 NPY_DISABLE_CPU_FEATURES='X86_V3 X86_V4 AVX512_ICL'
# Tests of all code that computes: the paths in tests/core.txt, which the workflows also run on other systems.
CORE_TESTS := @tests/core.txt

# The next version of Hydra, or its newest release candidate, installed beside .venv for the tests of configurations and sweeps.
NEXT_HYDRA := 'hydra-core>=1.4.0rc1,<1.5' 'omegaconf>=2.4.1rc1,<2.5'
HYDRA_PLUGINS := 'hydra-optuna-sweeper==1.3.*' 'optuna<3' cliff cmaes 'hydra-ray-launcher==1.2.*' 'ray<3' 'cloudpickle<3' boto3 msgpack
NEXT_HYDRA_TESTS := tests/app tests/config tests/end_to_end/test_hydra.py

.DEFAULT_GOAL := help
.PHONY: help install demo test test-slow test-all test-generic next-hydra test-next-hydra hydra-plugins test-hydra-plugins promises lint docs notebooks picture lock

help: ## show this
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

install: $(VENV)/.stamp-dev ## set up .venv with gsbench and the development tools

demo: $(VENV)/.stamp-run ## baseline against two ideas on the courtyard: nine trials, the table, the report
	$(BIN)/gsbench +experiment=demo
	$(BIN)/gsbench tables demo
	$(BIN)/gsbench report demo

test: $(VENV)/.stamp-dev ## run the quick tests: every unit, every contract, the program as a user runs it
	$(PYTEST) -m 'not slow'

test-slow: $(VENV)/.stamp-dev
	$(PYTEST) -m slow

test-all: test test-slow ## run all tests; the slow ones start processes, train, or compile for long

test-generic: $(VENV)/.stamp-dev ## run core tests as on the plainest processor of this architecture
	$(GENERIC) $(PYTEST) -m 'not slow' $(CORE_TESTS)

next-hydra: $(VENV)/.stamp-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --pre --no-deps --upgrade --target $(VENV)/next-hydra $(NEXT_HYDRA)

# Plug-ins of others that need older packages than gsbench does (Optuna 2, cloudpickle 2), beside .venv.
hydra-plugins: $(VENV)/.stamp-dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade --target $(VENV)/hydra-plugins $(HYDRA_PLUGINS)

test-hydra-plugins: hydra-plugins ## run the tests of Hydra's sweepers and launchers of others (Optuna, Ray)
	PYTHONPATH=$(abspath $(VENV)/hydra-plugins) $(PYTEST) tests/end_to_end/test_hydra_plugins.py

test-next-hydra: next-hydra ## run the tests of configurations and sweeps on the next version of Hydra
	PYTHONPATH=$(abspath $(VENV)/next-hydra) $(PYTEST) $(NEXT_HYDRA_TESTS)

promises: $(VENV)/.stamp-dev ## simulate every promised error rate and power, into findings/simulations.md
	$(BIN)/python scripts/promises.py

lint: $(VENV)/.stamp-dev ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.stamp-docs ## write the documentation as a site to site/; fails for a broken link
	$(BIN)/python scripts/build_site.py
	$(BIN)/zensical build --clean

notebooks: $(VENV)/.stamp-dev ## run the notebooks and keep their outputs in the .ipynb files
	$(BIN)/python scripts/notebooks.py

picture: $(VENV)/.stamp-run ## draw the README's picture from the trials of `make demo`
	$(BIN)/python scripts/readme_picture.py

lock: $(VENV)/.stamp-run ## bring uv.lock to the versions of constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv lock --no-config --default-index https://pypi.org/simple $$(sed 's/^/--upgrade-package /' constraints.txt)

# Only what running needs; the development tools are added by the next target.
$(VENV)/.stamp-run: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "gsbench needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	@echo making the environment $(VENV)
	@$(PYTHON) -m venv --without-pip $(VENV)
	@$(INSTALL) -e .
	@touch $@

$(VENV)/.stamp-dev: $(VENV)/.stamp-run
	@$(INSTALL) -e . --group dev
	@touch $@

$(VENV)/.stamp-docs: $(VENV)/.stamp-run
	@$(INSTALL) -e . --group docs
	@touch $@
