# Everything from a fresh clone on a Linux machine with Python 3.11+ and pip:
#   make demo     the main job on fake hardware; ends by saying where the report is
#                 (OUT=folder SEED=n ARGS='--full' are handed on)
#   make test     the tests, some eleven minutes on two idle cores (PYTEST='-k name' is handed on;
#                 PYTEST=test/unit/motion runs one folder, docs/first-change.md)
#   make qualify  all of them, and the campaigns that it leaves out; some two hours on two cores
#   make check    lint, types, layers; CI runs this and make test
#   make bench    the benchmarks, small (BENCH='bench_speed …' chooses, FULL=1 for all sizes)
#   make mutants FOLDER=remaster_ros/motion    which changes of the code its unit tests do not notice
#   make docs     the site, build/docs/index.html, and its pages that come from the code
#   make faults   the tables of test/faults/observed.md from what the tests observe (FAULTS=add keeps the old)
# The first of them makes a virtual environment. With ROS 2 Jazzy sourced its rclpy is used and the
# system's NumPy kept; else the ROS 2 wheels are installed. PYTHON=... chooses the interpreter.

SHELL := /bin/bash
.NOTPARALLEL:
.PHONY: help demo test qualify check bench mutants docs faults format clean

ifneq ($(and $(ROS_DISTRO),$(AMENT_PREFIX_PATH)),)
KIND := ros
VENV := .venv-ros
CONSTRAINTS := constraints-ros.txt
else
KIND := wheels
VENV := .venv
CONSTRAINTS := constraints.txt
endif
BIN := $(VENV)/bin
export PYTHON

# A process of another environment with ROS wheels leaves this behind; with it set, the wheels of
# ours would not set up their library path.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

help:
	@sed -n '1,13s/^# \{0,1\}//p' Makefile

$(VENV)/installed: setup.py setup.cfg $(CONSTRAINTS) tools/make-venv
	@tools/make-venv $(VENV) $(KIND)
	@touch $@

demo: $(VENV)/installed
	$(BIN)/remaster demo $(if $(OUT),--out '$(OUT)') $(if $(SEED),--seed $(SEED)) $(ARGS)

# Plugins that happen to be on the machine stay out: launch_testing of ROS breaks with pytest 9.
test: $(VENV)/installed
	tools/run-tests $(BIN)/python $(PYTEST)

# What make test leaves out as well, in the same two groups: repetitions, sweeps, campaigns, every row
# of test/faults/observed.md. Some two hours on two cores.
# PYTEST=test/… runs these files alone, PYTEST='-k name' those of all that have the name.
qualify: $(VENV)/qualify-installed
	tools/run-tests $(BIN)/python --qualify $(PYTEST)

$(VENV)/qualify-installed: $(VENV)/installed
	$(BIN)/python -m pip install -qq -c $(CONSTRAINTS) --no-build-isolation -e '.[qualify]'
	@touch $@

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Small sizes, some ten minutes on two idle cores; FULL=1 takes those of benchmarks/RESULTS.md,
# hours for the hidden world of bench_discovery. BENCH='bench_speed …' chooses.
BENCH ?= bench_real_data bench_discovery bench_halves bench_exactness bench_calibration \
	bench_speed bench_scaling bench_peers bench_compensation paper_tables
SMALL_bench_discovery := --only null pair --count 4 --results build/discovery_small.jsonl
SMALL_bench_halves := --only panda_left --splits 2 --results build/halves_small.jsonl
SMALL_bench_compensation := --robots iiwa7 --kinds length tilt --results build/commanded_small.jsonl
SMALL_paper_tables := --steps 10000
FULL_bench_discovery := --results build/discovery.jsonl
FULL_bench_halves := --results build/halves.jsonl
FULL_bench_calibration := --sessions 1000 --record build/calibration.jsonl
FULL_bench_exactness := --gold 1300000 --draws 60000
FULL_bench_speed := --full
FULL_bench_scaling := --sizes 50 173 1000 10000 100000
FULL_bench_peers := --seeds 10
FULL_bench_compensation := --results build/commanded.jsonl
FULL_paper_tables := --out benchmarks/PAPER.md
bench: $(VENV)/bench-installed
	@mkdir -p build
	@$(foreach name,$(BENCH),echo "== $(name)" && OMP_NUM_THREADS=1 $(BIN)/python \
		benchmarks/$(name).py $(if $(FULL),$(FULL_$(name)),$(SMALL_$(name))) &&) true

$(VENV)/bench-installed: $(VENV)/installed
	$(BIN)/python -m pip install -qq -c $(CONSTRAINTS) --no-build-isolation -e '.[bench]'
	@touch $@

# FOLDER is a folder of the package, or one module of it.
mutants: $(VENV)/mutants-installed
	tools/mutants $(BIN)/python $(or $(FOLDER),$(error say make mutants FOLDER=remaster_ros/motion))

$(VENV)/mutants-installed: $(VENV)/installed
	$(BIN)/python -m pip install -qq -c $(CONSTRAINTS) --no-build-isolation -e '.[mutants]'
	@touch $@

# A page that warns (a link to nowhere, a name that is not there) ends it with an error.
docs: $(VENV)/docs-installed
	$(BIN)/python docs/make_parameters.py
	$(BIN)/python docs/make_command_line.py
	$(BIN)/python docs/make_states.py
	$(BIN)/python -m sphinx -q -W --keep-going docs build/docs
	@echo "the site: build/docs/index.html"

$(VENV)/docs-installed: $(VENV)/installed
	$(BIN)/python -m pip install -qq -c $(CONSTRAINTS) --no-build-isolation -e '.[docs]'
	@touch $@

faults: $(VENV)/installed
	FAULTS_PAGE=$(or $(FAULTS),write) tools/run-tests $(BIN)/python -q -m '' \
		test/integration/test_device_faults.py test/system/test_fault_rows.py

format: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv .venv-ros .venv-bench build install log *.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
