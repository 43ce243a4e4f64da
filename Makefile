# Two commands do all the set-up on a fresh Linux machine with Python 3.11+ and pip:
#   make demo    the main job on fake hardware; ends by saying where the report is
#   make test    the tests
# With an installed ROS 2 Jazzy sourced, its rclpy is used; else the pip wheels are installed.

SHELL := /bin/bash
PYTHON ?= $(shell for v in python3 python3.12 python3.11 python3.13; do \
	$$v -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo $$v && break; done)
VENV := .venv
BIN := $(VENV)/bin
# A sourced ROS shows itself by ROS_DISTRO and an importable rclpy; the environment then sees the
# system's packages and keeps the NumPy that its messages were compiled against.
HAVE_ROS := $(shell test "$$ROS_DISTRO" = jazzy && $(PYTHON) -c 'import rclpy' 2>/dev/null && echo yes)

.PHONY: demo test check bench clean format

ifeq ($(HAVE_ROS),yes)
VENV_OPTIONS := --system-site-packages
EXTRAS := test,check
CONSTRAINTS := constraints-ros.txt
else
VENV_OPTIONS :=
EXTRAS := jazzy,test,check
CONSTRAINTS := constraints.txt
endif

$(VENV)/installed: setup.py $(CONSTRAINTS)
	@test -n "$(PYTHON)" || { echo 'error: no Python 3.11 to 3.13 found; install one, or set PYTHON=' >&2; exit 2; }
	$(PYTHON) -m venv $(VENV_OPTIONS) $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'setuptools<80' wheel
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c $(CONSTRAINTS) -e '.[$(EXTRAS)]'
	touch $@

demo: $(VENV)/installed
	$(BIN)/remaster demo $(if $(OUT),--out $(OUT)) $(if $(SEED),--seed $(SEED))

test: $(VENV)/installed
	$(BIN)/python -m pytest $(PYTEST)

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/installed
	for script in benchmarks/bench_*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

clean:
	rm -rf $(VENV) build install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
