# The commands of this project; `make help` lists them.
NVSF_HOME    ?= $(CURDIR)/.nvsf
DAGSTER_HOME ?= $(NVSF_HOME)/dagster
SEED         ?= 0
PYTHON       ?= python3.11
PORT         ?= 3000
# Make splits lists at blanks: a path with one would be taken for several, and these be made.
ifneq ($(word 2,$(CURDIR)),)
$(error expected this checkout in a path without blanks, found "$(CURDIR)": move it; or make an environment elsewhere, `pip install .` here, and use `nvsf demo` instead of make)
endif
ifneq ($(word 2,$(NVSF_HOME))$(word 2,$(DAGSTER_HOME)),)
$(error expected NVSF_HOME and DAGSTER_HOME without blanks, found "$(NVSF_HOME)" and "$(DAGSTER_HOME)": name other folders; or use .venv/bin/nvsf instead of make, which takes any)
endif
override NVSF_HOME := $(abspath $(NVSF_HOME))
override DAGSTER_HOME := $(abspath $(DAGSTER_HOME))
export NVSF_HOME DAGSTER_HOME SEED SEEDS SCENES RECIPE RECIPES SPLITS MARKS NVSF_SCENES NVSF_KITTI360_ROOT NVSF_EXECUTOR
export DAGSTER_MODULE_NAME := pipelines.definitions
# Packages are installed without bytecode (PIP below): where none may be kept, each start would compile them anew.
unexport PYTHONDONTWRITEBYTECODE

BIN     := .venv/bin
STAMP   := .venv/.installed
KERNELS := .venv/.compiled
DEV     := .venv/.installed-dev
# Compiled where they are first imported: compiling every file of torch and Dagster ahead takes longer.
PIP     := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
# All that a start and the stages import: it is compiled with the kernels.
IMPORTS := import pipelines.definitions, nvsf_core.stages.benchmark_report; from nvsf_core.stages.flow import WORK_MODULES; [__import__(name) for name in WORK_MODULES]

.DEFAULT_GOAL := help
.PHONY: help install demo train test test-fast check style types contracts docs bench ablation stability chaos gpu contract ui clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  \1\t/' | expand -t 14

install: $(STAMP) $(KERNELS) ## make .venv with what the product needs: 3.1 GB, one to two minutes from a warm pip cache
$(STAMP): pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "installing into .venv: 3.1 GB; one to two minutes where pip has the packages, else as long as 1 GB takes to come"
	@$(PIP) -e .
	@touch $@

$(KERNELS): $(STAMP)
	@echo "compiling the kernels: a minute, once"
	@$(BIN)/python -c '$(IMPORTS)' & $(BIN)/python -m nvsf_core.stages.runner.compile_kernels && wait
	@touch $@

$(DEV): $(STAMP)
	@echo "installing what tests and checks need: another GB"
	@$(PIP) -e '.[dev]'
	@touch $@

# Made once. From then on the file is the user's own: a newer template must not replace a configuration of Postgres.
$(DAGSTER_HOME)/dagster.yaml: | $(STAMP)
	@$(BIN)/python -m pipelines.instance

# By `nvsf`, which runs `dagster job execute -j train_all_scenes` and ends it in plain words at Ctrl-C.
demo: install ## write a short analytic drive and train it: two minutes, 0.2 GB
	@$(BIN)/nvsf demo

train: install ## SCENES="a b" RECIPE=lean SEED=0: train catalogue scenes
	$(BIN)/nvsf train

# In the order of the files: by number of tests, the longest, of one test each, came last, and a core had nothing to do.
test: install $(DEV) ## the whole suite
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# What says most about a change in least time: no training, no process of its own but the contracts'.
FAST := architecture cameras drives encodings geometry losses metrics recipe rendering sampling sensors stores
test-fast: install $(DEV) ## the quick half of the suite, for the first green
	$(BIN)/python -m pytest -n 2 --dist loadfile $(FAST:%=tests/%)

check: style types contracts docs ## ruff, mypy strict on the core, import contracts, the documentation site
style: $(DEV)
	$(BIN)/ruff check .
types: $(DEV)
	$(BIN)/mypy
contracts: $(DEV)
	$(BIN)/lint-imports

# Both variables silence notices about future versions of the tools, which are pinned.
docs: $(DEV) ## build the documentation site into site/; any broken link is an error
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true PYTHONPATH=. $(BIN)/mkdocs build --quiet

bench: install $(DAGSTER_HOME)/dagster.yaml ## SCENES, RECIPES, SEEDS="0 1 2", SPLITS="full every2": error over training time and all metrics
	$(BIN)/python -m benchmarks.run

ablation: install ## the paper's ablation at a size for CPUs; docs/ablation.md
	$(BIN)/python -m benchmarks.paper.ablation

stability: install $(DEV) ## hard numerical cases, measured; docs/numerical_stability.md
	$(BIN)/python -m benchmarks.numerics.stability

chaos: install ## MINUTES=60 SEED=0: kill, fill, cut and flip a home at work; docs/chaos.md
	$(BIN)/python -m benchmarks.chaos

gpu: install ## on a machine with a GPU: its tests, kernels and `paper`, measured; docs/gpu.md
	$(BIN)/python -m benchmarks.gpu

contract: install ## write docs/data_contract.md from nvsf_core/stores/schemas.py
	$(BIN)/python -m nvsf_core.stores.contract_page > docs/data_contract.md

# With DAGSTER_MODULE_NAME set, Dagster refuses -w. Where the machine is busy, to launch a run takes longer than the
# minute that Dagster waits for; it then counts as failed.
ui: install $(DAGSTER_HOME)/dagster.yaml ## the Dagster UI on localhost, PORT=3000
	env -u DAGSTER_MODULE_NAME DAGSTER_GRPC_TIMEOUT_SECONDS=600 $(BIN)/dagster dev -w workspace.yaml -h 127.0.0.1 -p $(PORT)

clean: ## remove .venv and caches; outputs under NVSF_HOME stay
	rm -rf .venv site .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -prune -exec rm -rf {} +
