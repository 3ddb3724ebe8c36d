# `make demo` and `make test` work from a fresh clone: they first install everything into .venv.

PYTHON ?= python3
JOBS ?= 2
DEMO_STEPS ?= 30
DEMO_DIR ?= outputs/demo/$(shell date +%Y-%m-%d_%H-%M-%S)
DEMO_DIR := $(DEMO_DIR)# expanded once: every step of the demo uses the same folder

BIN := .venv/bin
STAMP := .venv/.installed
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check

# One thread per test process, or they fight over the cores. Tests never reach for the Hub.
PYTEST := OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1 $(BIN)/python -m pytest

.DEFAULT_GOAL := help
.PHONY: help setup demo sample test test-slow lint constraints clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' Makefile

setup: $(STAMP) ## install relmm and its dependencies into .venv

# Again only when the dependencies changed: relmm itself is installed editable.
$(STAMP): pyproject.toml constraints.txt
	@version=$$($(PYTHON) -c 'import platform; print(platform.python_version())' 2>/dev/null || echo missing); \
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null || { \
	  echo "relmm needs Python 3.12 or newer, $(PYTHON) is $$version; name another one: make setup PYTHON=python3.12" >&2; \
	  exit 1; }
	@echo "installing relmm and its dependencies into .venv (several minutes the first time: PyTorch is large)"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python $(PIP_INSTALL) -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP) ## a robot learns to clean a room from scratch, then shows it (some minutes)
	$(BIN)/relmm-train --robot.type=locobot_sim --robot.room=no_obstacles --dataset.repo_id=demo/no_obstacles \
	  --steps=$(DEMO_STEPS) --env_eval_freq=0 --seed=0 --output_dir=$(DEMO_DIR)/train
# An untrained robot grasps at everything: 30 navigation steps of that are enough to see.
	$(BIN)/relmm-eval --policy.path=$(DEMO_DIR)/train/checkpoints/000000/pretrained_model --env.room=no_obstacles \
	  --env.navigation_steps=30 --eval.n_episodes=1 --seed=0 --output_dir=$(DEMO_DIR)/before
	$(BIN)/relmm-eval --policy.path=$(DEMO_DIR)/train/checkpoints/last/pretrained_model --env.room=no_obstacles \
	  --eval.n_episodes=1 --seed=0 --output_dir=$(DEMO_DIR)/after
	@$(BIN)/python -m relmm.commands.demo $(DEMO_DIR)/before $(DEMO_DIR)/after $(DEMO_DIR)/before_and_after.mp4

sample: $(STAMP) ## make the dataset of datasets/ again, in outputs/sample/first_attempts (some minutes)
	$(BIN)/relmm-train --robot.type=locobot_sim --robot.room=diverse --curriculum.type=autonomous \
	  --policy.num_max=260 --steps=100 --pseudo_reset_steps=1 --env_eval_freq=0 --seed=0 \
	  --dataset.repo_id=relmm/first_attempts --output_dir=outputs/sample
	@$(BIN)/python -c "from pathlib import Path; from relmm.episodes.compact import compact; \
	  compact('outputs/sample/dataset', Path('outputs/sample/first_attempts'))"

test: $(STAMP) ## run the tests, but not the slow ones
	$(PYTEST) -n $(JOBS) --dist loadfile

test-slow: $(STAMP) ## run only the slow tests
	$(PYTEST) -n $(JOBS) --dist loadfile -m slow

lint: $(STAMP) ## check style, types and who imports whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

constraints: ## rewrite constraints.txt with the newest versions that fit together
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python $(PIP_INSTALL) -e '.[dev]'
	{ sed -n '/^#/p' constraints.txt; $(BIN)/python -m pip freeze --exclude-editable; } > constraints.new
	mv constraints.new constraints.txt
	touch $(STAMP)

clean: ## remove .venv and caches; outputs/ stays
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .import_linter_cache build dist *.egg-info
	find relmm tests -name __pycache__ -prune -exec rm -rf {} +
