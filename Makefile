# One command each; all of them make the workspace ready first (tools/set_up.sh: venv, pinned
# packages, colcon build), which costs nothing where nothing changed. What only tests, linters and
# documentation need is installed with the first of them.
#
#   PYTHON=/path/to/python3.X   interpreter for the venv (3.10 to 3.13; default: python3)
#   ARGS='...'                  more arguments for what is started

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

RUN := . tools/workspace.bash;
SOURCES := $(wildcard src test tools bench)
ARGS ?=
# two workers more than there are cores: tests of nodes wait more than they compute; all share one
# cache of bytecode, also where the shell has it switched off; they begin in the order of test/conftest.py
PYTEST := $(RUN) PYTHONDONTWRITEBYTECODE= exec python -m pytest --timeout 600 -n $$(($(shell nproc) + 2)) --dist loadgroup --no-loadscope-reorder

.PHONY: build-test build-lint build-docs build-others help demo flight qemu pictures app-picture test test-qemu test-browser test-others test-long build lint firmware-table bench bench-effects bench-log bench-tuning bench-watch bench-mixer bench-link bench-effects-speed bench-peers bench-likelihood bench-intervals bench-outside bench-twice bench-ablation bench-demo bench-fleet bench-results wheel docs lock shell clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-19s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: build $(if $(findstring --qemu,$(ARGS)),qemu)  ## the whole loop on a virtual quadrotor, results in demo_out/ (4 minutes)
	@$(RUN) exec python -c 'import sys; from quad_tuning.start import demo; sys.exit(demo())' $(ARGS)

qemu: build  ## the STM32's ELF for demo ARGS=--qemu (needs gcc-arm-none-eabi, qemu-system-arm)
	@for name in arm-none-eabi-gcc qemu-system-arm; do command -v $$name >/dev/null || { \
	    echo "no $$name: on Debian and Ubuntu apt install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm" >&2; \
	    exit 2; }; done
	@$(RUN) make -s -C firmware PYTHON=python stm32 && arm-none-eabi-size firmware/build/stm32f405.elf

firmware-table: qemu  ## measure the STM32's ELFs in QEMU: the table of docs/results/firmware.md
	@$(RUN) exec python tools/firmware_table.py firmware/build

flight: build  ## two simulated flights as bags, my_flight and another_flight (seconds; ARGS=FOLDER)
	@$(RUN) exec python tools/flight.py $(ARGS)

pictures:  ## renew the pictures of README and docs from the last demo_out/
	@[ -d demo_out/report ] || { echo 'no demo_out/report: run make demo first' >&2; exit 2; }
	@cp demo_out/square_wave.png docs/images/square_wave.png
	@cp demo_out/report/pictures/roll_effect_shape.png docs/images/missing_torque.png
	@ls -l docs/images/*.png

app-picture: build  ## renew the picture of the app (a minute; needs Chromium)
	@$(RUN) exec python tools/app_picture.py

test: build-test  ## all tests but those below, two more at once than there are cores
	@$(PYTEST) $(ARGS)

test-qemu: build-test  ## the STM32's ELF in QEMU: gains under faults, and the whole loop (two minutes)
	@$(PYTEST) -m qemu $(ARGS)

test-browser: build-test  ## the pages and the app in Debian's Chromium (a minute or two)
	@$(PYTEST) -m browser $(if $(ARGS),$(ARGS),test/quad_sysid/test_app.py)

test-others: build-others  ## with an S3 server, pandas, polars, xarray and duckdb, which nothing else needs (a minute)
	@export PYTHONPATH=$$PWD/.venv/others; $(PYTEST) -n 0 -m others $(if $(ARGS),$(ARGS),test/quad_sysid/test_fleet.py test/quad_sysid/test_arrays.py)

test-long: build-test  ## soaks, studies and sweeps alone (an hour or more)
	@$(PYTEST) -m long $(ARGS)

build:  ## venv with the pinned packages and colcon build into install/
	@tools/set_up.sh

build-test build-lint build-docs:
	@tools/set_up.sh $(@:build-%=%)

build-others:
	@tools/set_up.sh test others

lint: build-lint  ## ruff, mypy --strict, mypy for benchmarks, the import rules; the firmware's C with clang and cppcheck
	@$(RUN) status=0; \
	ruff check --output-format concise $(SOURCES) || status=1; \
	mypy || status=1; \
	mypy --config-file bench/mypy.ini bench tools || status=1; \
	lint-imports --no-logo || status=1; \
	make -s -C firmware PYTHON=python lint || status=1; \
	exit $$status

bench: build  ## black-box accuracy and speed (ten minutes; ARGS='--quick --peers PYTHON')
	@$(RUN) exec python bench/blackbox.py $(ARGS)

bench-effects: build  ## planted effects against named ones (half an hour; ARGS='--seeds 1 --nothing 6')
	@$(RUN) exec python bench/effects.py $(ARGS)

bench-effects-speed: build  ## a likelihood beside plain and other filters, a whole axis (a minute; ARGS="--peers PYTHON")
	@$(RUN) exec python bench/effects_speed.py $(ARGS)

bench-peers: build  ## one axis from arrays by other packages, beside ours (20 minutes; ARGS="--peers PYTHON")
	@$(RUN) exec python bench/array_peers.py $(ARGS)

bench-likelihood: build  ## the fit against the Cramer-Rao bound, the evidence against the truth (15 minutes)
	@$(RUN) OPENBLAS_NUM_THREADS=1 python bench/accuracy.py; exec python bench/evidence.py

bench-intervals: build  ## gain, lag and damping of random axes beside their intervals (10 minutes; ARGS='--plants 6')
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/intervals.py $(ARGS)

bench-outside: build  ## effects that others wrote from textbooks, two levels of noise (two hours; ARGS='--only rigs')
	@$(RUN) export OPENBLAS_NUM_THREADS=1; python bench/effects_outside.py --noise 0.3 $(ARGS); exec python bench/effects_outside.py $(ARGS)

bench-ablation: build  ## groups of candidates left out where they matter (two hours; ARGS='--flights 20')
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/effects_ablation.py $(ARGS)

bench-twice: build  ## each aircraft flown twice: does the answer come again? (an hour; ARGS='--plants 12')
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/effects_twice.py $(ARGS)

bench-demo: build  ## the demo's first flight with other noise each time (five minutes; ARGS='--flights 8')
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/demo.py $(ARGS)

bench-fleet: build  ## what a fleet costs beside its bags, one worker and two (ten minutes; ARGS=--drift)
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/fleet.py $(ARGS)

bench-results: build  ## the tables of the pages of results from bench/results
	@$(RUN) exec python bench/results.py

bench-tuning: build  ## gains on 100 virtual airframes, and peers (20 minutes; ARGS='--count 12')
	@$(RUN) OPENBLAS_NUM_THREADS=1 exec python bench/tuning.py $(ARGS)

bench-watch: build  ## good and bad updates in flight on 100 airframes (20 minutes; ARGS='--count 12')
	@$(RUN) exec python bench/watch.py $(ARGS)

bench-mixer: build  ## the firmware's mixer beside plain clipping at hard manoeuvres (a minute)
	@$(RUN) exec python bench/mixer.py $(ARGS)

bench-link: build  ## decoder fuzzed, clock studied, link under load (15 minutes; ARGS='--seconds 250=60')
	@$(RUN) python bench/link_fuzz.py; python bench/link_clock.py; exec python bench/link_load.py $(ARGS)

bench-log: build  ## what the log loses under load and when killed, how fast bags are read (10 min)
	@$(RUN) exec python bench/log.py $(ARGS)

docs: build-docs  ## the documentation as a site in site/, links checked
	@$(RUN) exec python -m mkdocs build --clean --quiet

# from the last commit, and the same bytes each time: its files, its date, one order, owner and umask
wheel: build  ## wheels and source packages of the part that needs no ROS, of the last commit, in dist/
	@$(RUN) umask 022; dist=$$PWD/dist; at=$$(mktemp -d); trap 'rm -rf "$$at"' EXIT; mkdir -p "$$dist"; \
	export SOURCE_DATE_EPOCH=$${SOURCE_DATE_EPOCH:-$$(git log -1 --format=%ct)}; \
	git archive HEAD src LICENSE | tar -x -C "$$at"; for package in quad_sysid quad_tuning; do \
	    cd "$$at/src/$$package"; rm -f "$$dist"/$$package-*; \
	    python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$$dist" .; \
	    python setup.py --quiet sdist --formats=tar --dist-dir "$$at" 2>/dev/null; \
	    name=$$(basename "$$at"/$$package-*.tar .tar); tar -x -C "$$at" -f "$$at/$$name.tar"; \
	    tar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner -C "$$at" -c "$$name" \
	        | gzip -9n >"$$dist/$$name.tar.gz"; done; ls "$$dist"

PIN := uv pip compile -q --no-annotate --no-header --no-emit-index-url --no-emit-find-links
FOR_ALL := $(PIN) --universal --python-version 3.10
OURS := sed -E "/(; |and )[a-z_]+ == '(win32|darwin|pypy)'$$/d"
lock:  ## pin anew what requirements/*.in ask for (needs uv and a network)
	@cd requirements && every=$$(mktemp) common=$$(mktemp) && trap 'rm "$$every" "$$common"' EXIT && \
	$(FOR_ALL) ros-wheels.in test.in lint.in docs.in >"$$every" && \
	$(FOR_ALL) -c "$$every" ros-wheels.in | $(OURS) >ros-wheels.txt && \
	$(FOR_ALL) -c "$$every" build.in >"$$common" && \
	for name in test lint docs; do \
	    $(FOR_ALL) -c "$$every" build.in $$name.in | grep -vxFf "$$common" | $(OURS) >$$name.txt; done && \
	$(FOR_ALL) -c <(grep -v '^python-dateutil' "$$every") others.in | grep -vxFf "$$every" | $(OURS) >others.txt && \
	$(PIN) --python-version 3.12 jazzy.in >jazzy.txt

shell: build  ## a shell with the venv and the workspace sourced
	@$(RUN) if [ -t 0 ]; then bash --norc || :; else exec bash --norc; fi  # the last command typed is no failure of make

clean:  ## remove what make made, demo_out*/ excepted
	rm -rf .venv build install log dist site firmware/build .pytest_cache .mypy_cache .ruff_cache .hypothesis
