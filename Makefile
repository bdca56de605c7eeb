# `make train` and `make test` first set up .venv, if needed.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
ARGS ?=
# Processes that `make test` shares the tests among, 2 GB each. Plain `pytest -m 'not slow'` does without.
WORKERS ?= 2

.PHONY: setup train test test-slow test-gpu lint examples docs clean

setup: .venv/.ready

.venv/.ready: pyproject.toml setup.py constraints.txt
	@echo "Setting up .venv (a few minutes, 5.5 GB)"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

train: setup
	$(BIN)/python train.py env=gridworld algo=v2 $(ARGS)

test: setup lint
	$(BIN)/python -m pytest -m 'not slow' -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: setup
	$(BIN)/python -m pytest -m slow $(ARGS)

# What only a GPU can show; all of it is skipped without one.
test-gpu: setup
	$(BIN)/python -m pytest tests/gpu tests/test_devices.py $(ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# As tests/test_examples.py does, each as a program of its own.
examples: setup
	$(BIN)/python examples/reuse_transform.py --frames 2000
	$(BIN)/python examples/reuse_loss.py --updates 60
	$(BIN)/python examples/own_task/door_key.py --frames 512 --out $$(mktemp -d)/door_key

# The site, in docs/_build/html: notebooks run, warnings are errors, links inside are checked.
docs: .venv/.docs
	rm -rf docs/_build docs/api/generated
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

.venv/.docs: .venv/.ready
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	touch $@

clean:
	rm -rf docs/_build docs/api/generated
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
