# The environment's programs first, so that `python` and `dvc` in the stages are its own.
export PATH := $(CURDIR)/.venv/bin:$(PATH)
export OMP_NUM_THREADS := 1
PYTHON ?= python3.11
FILE ?=
CONSTRAINT ?=
STAGE ?=
FIRST_START = 1.329923 -0.584036 -3.766650 -2.008429 0.728803 -2.581396
FIRST_GOAL = 1.071549 -0.217480 -1.682647 -2.906655 -0.337949 1.348704

.PHONY: help env plan repro pretrained dag smoke bench bench-quick draw-queries measure test test-experiments test-faults soak lint format audit lock results readme \
	docs notebook plots experiments sweep ui replay clean test-browser screenshots first-screens

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 18

.venv/bin/python:
	@command -v $(PYTHON) >/dev/null || { echo "error: Python 3.11 is needed (PyBullet has no wheels for later ones); set PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { echo "error: $(PYTHON) is not Python 3.11, which PyBullet's wheels need"; exit 1; }
	$(PYTHON) -m venv .venv

INSTALL := -m pip install --quiet --disable-pip-version-check
# What is listed, to the byte, and nothing besides; what must be built is built with the setuptools that is listed.
HASHED := $(INSTALL) --no-compile --require-hashes --no-deps --no-build-isolation

.venv/planning: requirements.hashes pyproject.toml | .venv/bin/python
	@sed '/^# What the pipeline/,$$d' requirements.hashes > .venv/planning.txt
	.venv/bin/python $(HASHED) -r .venv/planning.txt
	.venv/bin/python $(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $@

.venv/installed: .venv/planning
	@# where pip finds one, torch's build for processors alone, of 190 MB and not 3 GB; its hash is listed with the others
	@sed -n '/^torch==/,/[^\\]$$/s/^torch==[^ ]*/&+cpu/p;/^torch==/,/[^\\]$$/{/--hash/p}' requirements.hashes > .venv/torch.txt
	@.venv/bin/python $(HASHED) -r .venv/torch.txt 2> /dev/null || true
	.venv/bin/python $(HASHED) -r requirements.hashes
	@# torch's build for graphics cards pins libraries of its own, which other machines need not have: they are in no lock
	@.venv/bin/python -m pip check > /dev/null || .venv/bin/python $(INSTALL) torch
	.venv/bin/python -m pip check
	@touch $@

env: .venv/installed  ## make .venv with every pinned package, those of the pipeline and the tests too, and compile the kernels
	@geodesics warmup

plan: .venv/planning  ## plan one path that keeps a cup level, at once: CSV, picture and recording in first_path/
	geodesics warmup
	geodesics plan --constraint level_cup --attach docs/examples/cup.yaml \
	  --start "$(FIRST_START)" --goal "$(FIRST_GOAL)" \
	  --out first_path/path.csv --picture first_path/path.png --record first_path/path.rrd
	geodesics check first_path/path.csv --attach docs/examples/cup.yaml
	@echo "Look at first_path/path.png, or replay it: make replay FILE=first_path/path.rrd"

repro: env  ## run all stages that are out of date, then print the results
	geodesics params
	geodesics recover
	dvc repro
	geodesics results

pretrained: env  ## copy the planner that was built into the package, for those who install it
	geodesics package

dag: env  ## the pipeline as a drawing, a name a script
	@python -m constraint_geodesics.pipeline.dag

smoke: env  ## the same pipeline on small parameters, in a copy of this checkout
	python tests/end_to_end/smoke.py .geodesics/smoke

bench: env  ## all planners on all queries, and the studies (hours; go on after an interruption by calling it again)
	geodesics params
	geodesics recover
	python stages/draw_benchmark_queries.py
	@# a study that can't be made, as that of problems from a file that is not here, stops no other
	dvc repro --keep-going stages/dvc.yaml stages/sweep/dvc.yaml; failed=$$?; \
	dvc repro --single-item --force report && exit $$failed

bench-quick: env  ## the same table on one query of each constraint and scene (minutes), after `make repro`
	geodesics bench

draw-queries: env  ## draw the benchmark's queries of constraints that have none, after `make repro`: CONSTRAINT=... draws those again
	python stages/draw_benchmark_queries.py $(CONSTRAINT)

measure: env  ## STAGE=...: one study of stages/dvc.yaml that needs the planner alone, or benchmark_geometry, again
	@test -n "$(STAGE)" || { echo "error: STAGE=measure_scenes, for example"; exit 1; }
	dvc repro $(if $(filter benchmark_geometry,$(STAGE)),label_joints train_manifold train_analytic,build_planner)
	dvc repro --single-item --force stages/dvc.yaml:$(STAGE)

TWO := -n 2 --dist loadgroup --no-loadscope-reorder
# what hangs outside Python hears no other limit: it is ended after longer than any test's own, and named
TESTS := python -m pytest $(TWO) \
	-o faulthandler_timeout=2100 -o faulthandler_exit_on_timeout=true
EXPERIMENTS := benchmark end_to_end geodesics geometry identification installation laws learning peers pipeline report studies tracking \
	$(addprefix faults/test_, kills.py load.py no_network.py random_requests.py)

test: env  ## run the tests of what people call: planner, shell, robots, scenes, goals, constraints, certificate, pages (5 minutes)
	$(TESTS) $(EXPERIMENTS:%=--ignore tests/%)

test-experiments: env  ## run all others: learning, laws, tracking, reports, baselines, studies, installing, a small pipeline, kills (under an hour)
	$(TESTS) $(EXPERIMENTS:%=tests/%)

.venv/servers: tests/faults/requirements.lock .venv/installed
	.venv/bin/python $(HASHED) -r tests/faults/requirements.lock
	@touch $@

FAULTS := GEODESICS_RELIABILITY=reports/reliability.json python -m pytest
TIMED := tests/faults/test_load.py tests/faults/test_scaling.py

test-faults: env .venv/servers  ## break things on purpose: kills, full disks, bad input, hostile files, load (about half an hour); writes reports/reliability.json
	$(FAULTS) $(TWO) tests/faults --faults $(TIMED:%=--ignore %)
	$(FAULTS) $(TIMED) --faults

soak: env .venv/servers  ## the same for hours, with more of each: 20 kills a stage, 100,000 requests; go on after an interruption by calling it again
	$(FAULTS) tests/faults --soak

.venv/browser: tests/browser/requirements.lock .venv/installed
	.venv/bin/python $(HASHED) -r tests/browser/requirements.lock
	@touch $@

test-browser: env .venv/browser  ## MLflow's dashboard, Rerun's viewer and the report in headless Chromium (minutes)
	@python tests/browser/chromium.py
	GEODESICS_BROWSER=1 python -m pytest tests/browser

screenshots: env .venv/browser  ## make the documentation's pictures again, from this checkout's runs and recordings
	@python tests/browser/chromium.py
	python -m tests.browser.hero
	python -m tests.browser.screenshots

first-screens: env .venv/browser plan docs  ## pictures of the first screens that people see, to be looked at, after `make repro` and `make bench`: .geodesics/screens
	@python tests/browser/chromium.py
	python -m tests.browser.first_screens

lint: env  ## format, lint, types, import directions
	ruff format --check .
	ruff check .
	mypy
	lint-imports

format: env  ## format and mend what can be mended
	ruff format .
	ruff check --fix .

TOOLS := .geodesics/tools-venv

$(TOOLS)/installed: .ci/requirements.lock | .venv/bin/python
	.venv/bin/python -m venv $(TOOLS)
	$(TOOLS)/bin/python $(HASHED) -r .ci/requirements.lock
	@touch $@

audit: $(TOOLS)/installed  ## ask for advisories against the locked packages; says of how many it could not ask
	@.venv/bin/python .ci/audit.py $(TOOLS)/bin/python

lock: env $(TOOLS)/installed  ## after a change of versions in a lock file: write the hashes of their files again
	.venv/bin/python .ci/lock.py $(TOOLS)/bin/python

results: env  ## print the result table
	geodesics results

readme: env  ## write README's tables and numbers again from the reports
	python tests/readme.py

DOCS := .geodesics/docs-venv
FROM ?= HEAD
TO ?= workspace

$(DOCS)/installed: docs/requirements.lock | .venv/installed
	.venv/bin/python -m venv $(DOCS)
	$(DOCS)/bin/python $(HASHED) -r docs/requirements.lock
	@touch $@

docs: $(DOCS)/installed  ## the documentation as a site with a search and the API, which opens offline: .geodesics/site/index.html
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict --quiet
	@echo "Open .geodesics/site/index.html"

notebook: env $(DOCS)/installed  ## run docs/first_path.ipynb again and store what it prints and draws
	$(DOCS)/bin/python docs/make/notebook.py

plots: env $(DOCS)/installed  ## learning curves of two commits, a line a seed, offline: make plots FROM=HEAD~1 TO=workspace
	$(DOCS)/bin/python docs/make/plots.py $(FROM) $(TO)

experiments: env  ## run the experiments of docs/experiments.md in a copy and write their tables there (half an hour)
	python docs/make/experiments.py

SPACE ?= stages/sweep/space.yaml

sweep: env  ## try settings of policies, ranked by `geodesics results --experiments`, after `make repro`: SPACE=... (minutes to hours; go on after an interruption by calling it again)
	geodesics params
	geodesics recover
	dvc repro --quiet digest_code
	python stages/run_sweep.py $(SPACE)
	geodesics results --experiments

ui: env  ## compare the runs in MLflow's dashboard, on this machine only
	geodesics ui

replay: .venv/planning  ## replay a path in Rerun: make replay FILE=data/recordings/...
	geodesics replay $(FILE)

clean:  ## remove unfinished work and what sweeps remember, not results
	@test ! -e .geodesics || geodesics recover  # what MLflow has not got yet lies in runs, and stays
	find .geodesics -mindepth 1 -maxdepth 1 ! -name runs ! -name bench -exec rm -rf {} + 2>/dev/null || true
	@rmdir .geodesics/runs .geodesics 2>/dev/null || true
