# Set-up is `make train` or `make test`: both build .venv from requirements.lock when needed.
# Variables: CONFIG=ml4.yaml ARGS="--train.minutes 45" VENV=.venv PYTHON=/path/to/python

VENV = .venv
CONFIG = ml4.yaml
ARGS =
PY = $(VENV)/bin/python
STAMP = $(VENV)/.cmrl-installed

.PHONY: train test test-all lint smoke bench parity docs lock env

train: $(STAMP)
	$(PY) train.py --config $(CONFIG) $(ARGS)

# Two processes, since a test that compiles keeps one core busy; tests of a file share fixtures.
# In the order that tests/conftest.py puts them. Those marked slow are left to `make test-all`: what
# takes a minute, and what takes twenty seconds where a quicker test has the same code run.
PYTEST = $(PY) -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(PYTEST) -m "not slow" $(ARGS)

test-all: $(STAMP)
	$(PYTEST) $(ARGS)

lint: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

smoke: $(STAMP)
	$(PY) train.py --config smoke.yaml $(ARGS)

bench: $(STAMP)
	$(PY) train.py bench --json bench.json $(ARGS)

parity: $(STAMP)
	$(PY) -m envs.parity --policies --json parity.json $(ARGS)

# The site, strictly: a link that leads nowhere or a name that the code has not fails.
docs: $(STAMP)
	$(PY) scripts/make_site.py

# The newest versions: make lock ARGS=--upgrade. Names and versions only, the same for 3.12 and
# 3.13 (checked by a dry run for each that uv finds); the cuda extra stays outside.
lock: $(STAMP)
	$(PY) -m uv pip compile pyproject.toml --extra dev --extra text --extra viz --extra wandb \
		--extra docs --extra notebook --python-version 3.12 \
		--python-platform linux --strip-extras --no-header --no-annotate --no-emit-index-url \
		--output-file requirements.lock --quiet $(ARGS)
	for version in 3.12 3.13; do \
		$(PY) -m uv pip compile requirements.lock --only-binary :all: --quiet \
			--python-version $$version --output-file /dev/null || exit 1; \
	done

env: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@VENV="$(VENV)" PYTHON="$(PYTHON)" sh scripts/make_env.sh
	@touch $(STAMP)
