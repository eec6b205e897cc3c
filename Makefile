# One command for each chore. Everything runs in .venv, which `make setup` makes from requirements.lock.
PYTHON ?= python3
BIN := .venv/bin
ALONE := $(PYTHON) -c 'import fcntl, os, sys; lock = os.open("Makefile", os.O_RDONLY); fcntl.flock(lock, fcntl.LOCK_EX); os.set_inheritable(lock, True); os.execvp(sys.argv[1], sys.argv[1:])'
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: setup fly race test test-long test-faults test-cluster test-soak check wheel docs docs-serve bench bench-returns tutorials lock clean

setup:  ## .venv; of two at once, one installs and the other waits for it
	@$(MAKE) --question .venv/.ready 2> /dev/null || $(ALONE) $(MAKE) --silent .venv/.ready

.venv/.ready: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; name one with make PYTHON=python3.12"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv what requirements.lock names: some minutes, in silence"
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

fly: setup  ## train a drone to fly the figure eight, fly it from unseen starts, draw it
	$(BIN)/lemniscate train ppo --env DroneFigureEightTrajectory-v0 --report

RACE := runs/race-$(shell date +%Y%m%d-%H%M%S)
race: setup  ## train a drone to race through gates, race from unseen starts, draw and record it
	$(BIN)/lemniscate train shac --env DroneGates-v0 --run $(RACE)
	$(BIN)/lemniscate train ppo --env DroneGates-v0 --preset gates-finish --warm-start $(RACE) --report

QUICKLY_COMPILED = --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true
test: setup  ## the whole suite but the long ones; what JAX compiles runs once, so that optimizing it does not pay
	XLA_FLAGS="$(QUICKLY_COMPILED)" $(BIN)/python -m pytest -n auto --dist worksteal -m "not long and not faults and not soak and not cluster"

test-long: setup  ## the tests that train for minutes, and those beside one of the same kind
	$(BIN)/python -m pytest -m long

test-faults: setup  ## every way to break a run, many times: half an hour; FAULTS_SHARE=1 for more than an hour
	$(BIN)/python -m pytest -n auto --dist load -m faults -rP

test-cluster: .venv/.ray  ## runs of several processes and of Ray (240 MB): the same bits for any number, kills, hangs; half an hour
	$(BIN)/python -m pytest -m cluster -rP

test-soak: setup  ## memory and open files of long runs, on every backend: two hours
	$(BIN)/python -m pytest -m soak -s

check: setup  ## style, types, floors
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

.venv/.ray: .venv/.ready
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --no-build-isolation --editable '.[ray]'
	touch $@

wheel: setup  ## dist/lemniscate-….whl
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .

docs: setup  ## the documentation site in build/site; warnings are errors
	$(BIN)/python docs/pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

docs-serve: docs  ## the site at http://localhost:8000
	$(BIN)/python -m http.server --directory build/site

bench: .venv/.peers  ## the drone in docs/results.md, and the tables of docs/speed.md: an hour on a quiet machine
	$(BIN)/python benchmarks/figure_eight.py
	$(BIN)/python benchmarks/speed.py

bench-returns: setup  ## the tables of docs/results.md, seed by seed: a day; returns.py takes some of them too
	$(BIN)/python benchmarks/returns.py reinforce a2c trpo ppo reppo pqn ddpg td3 sac

.venv/.peers: .venv/.ready
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --no-build-isolation --editable '.[bench]'
	touch $@

tutorials: setup  ## the notebooks with their outputs, from src/lemniscate/course/notebooks: some ten minutes
	$(BIN)/python docs/tutorial/execute.py

lock: setup  ## renew requirements.lock from pyproject.toml
	$(BIN)/pip-compile --quiet --strip-extras --extra box2d --extra classic-control --extra drone --extra envpool --extra export --extra hub --extra mujoco --extra tune --extra docs --extra dev --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header --allow-unsafe --annotation-style=line --constraint constraints.txt --output-file requirements.lock pyproject.toml
	sed -i 's/+cpu//' requirements.lock

clean:
	rm -rf .venv build dist
