# Two commands: `make demo` shows the whole workflow on this machine, `make test` runs every check.
# Both make their own virtual environment first; nothing else is needed but Python 3.11 to 3.13 with venv, and make.

# Asked once, when an environment is made: python3, or the system's own if it is the faster one by far.
ifndef PYTHON
PYTHON = $(eval PYTHON := $(shell scripts/choose-python))$(PYTHON)
endif
VENV ?= .venv
BIN := $(VENV)/bin
# Compiled modules are kept: each of five pytests would else rewrite every assert again, 13 s of CPU each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo demo-page page-picture test test-system lint types unit compiled quick bench bench-teds bench-handover bench-measure bench-ncap bench-page bench-scale bench-short test-rclpy test-smp fuzz faults pairs model house words man coverage mutants redundant soak api test-other vectors-c sbom firmware firmware-faults firmware-zephyr firmware-arm firmware-coverage firmware-soak test-c room clean

demo: $(VENV)/.run
	@$(BIN)/teds-provision demo

# A base station that runs, with its page, two virtual sensors and a virtual gripper; ends with Ctrl-C.
demo-page: $(VENV)/.run
	@$(BIN)/teds-provision demo --page

# The picture of the page in README: made from demo --page, by the chromium of this system.
page-picture: $(VENV)/.dev
	$(BIN)/python -m tests.page.picture docs/page.png

# With its packages there, no test marked system may be skipped; without root it goes on, and says at the end what it left out.
test: $(VENV)/.dev
	@sh scripts/install-test-packages || { test -z "$$CI" && echo "Going on without them: the tests marked system are skipped."; }
	@$(MAKE) --no-print-directory lint
	@$(MAKE) --no-print-directory -j2 types compiled
	@sh scripts/install-test-packages >/dev/null 2>&1 && export TEST_PACKAGES=installed; $(MAKE) --no-print-directory unit

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

# Four times the cores: half of the time that a test takes is waiting for a node, a reader, a lock; tests/dealing.py.
# What holds a rule about time then runs five at a time: it waits for three quarters of its time.
WORKERS ?= 8
PUNCTUAL ?= 5
USUAL := not soak and not machine and not rclpy and not nightly
# Of what fails, up to three tests that run other processes get a second try, alone (tests/second_try.py).
unit: $(VENV)/.dev
	@mkdir -p build && rm -f build/not-tested build/second-tries
	$(BIN)/python -m tests.second_try -n $(WORKERS) --dist worksteal -rs --hypothesis-profile=gate -m '$(USUAL) and not realtime'
	$(BIN)/python -m tests.second_try -n $(PUNCTUAL) --dist worksteal -rsR -m '$(USUAL) and realtime' \
	  $$(grep -rl --include='test_*.py' 'mark\.realtime' tests)
	@cat build/not-tested build/second-tries 2>/dev/null || true

# Every test module compiled once, its asserts rewritten, beside mypy: the workers begin together, and each would do it for
# itself.
compiled: $(VENV)/.dev
	@mkdir -p build
	@$(BIN)/python -m compileall -q teds_provision tests benchmarks
	@$(BIN)/python -m pytest --collect-only -qq -m '$(USUAL)' >build/collected 2>&1 || { cat build/collected; exit 1; }

# The inner loop: the rooms without a link or a process, the rules of the house, one case of each link, one provisioning
# by command. CONTRIBUTING.md says what that leaves out.
# These wait for seconds of the clock.
WAITING := tests/test_one_core.py tests/provisioning/test_identify_at.py
QUICK := $(filter-out $(WAITING),$(wildcard tests/test_[!m]*.py tests/provisioning/test_*.py)) \
  tests/teds tests/protocol tests/station tests/trace \
  tests/measure/test_clock.py tests/measure/test_grid.py \
  'tests/links/nfc/test_nfc_exchange.py::test_frames_of_every_size_come_back_whole[4]' \
  tests/links/can/test_can_exchange.py::test_a_node_answers_an_fd_station_in_fd_and_a_classic_one_in_classic \
  tests/links/ble/test_port.py::test_the_address_may_be_named \
  'tests/e2e/test_whole_runs.py::test_a_tapped_node_is_provisioned_and_a_second_run_finds_nothing_to_do[python-4]'
quick: $(VENV)/.dev
	@$(BIN)/ruff check --quiet .
	$(BIN)/python -m pytest -n 2 --dist worksteal -m 'not slow and $(USUAL)' --hypothesis-profile quick $(QUICK)

bench: $(VENV)/.dev
	$(BIN)/python -m benchmarks.provisioning
	$(BIN)/python -m benchmarks.commands
	$(BIN)/python -m benchmarks.verifying
	$(BIN)/python -m benchmarks.handover
	$(BIN)/python -m benchmarks.teds_codec --images 0
	$(BIN)/python -m benchmarks.scale
	$(BIN)/python -m benchmarks.radio
	$(BIN)/python -m benchmarks.updating
	$(BIN)/python -m benchmarks.plant
	$(BIN)/python -m benchmarks.plant --local 120
	$(BIN)/python -m benchmarks.line
	$(BIN)/python -m benchmarks.line_readers --pace

bench-teds: $(VENV)/.dev
	$(BIN)/python -m benchmarks.teds_codec

# SECONDS=600 is the ten minutes of a large machine (50,000 values a second); sizes below it run a tenth of that.
bench-measure: $(VENV)/.dev
	$(BIN)/python -m benchmarks.measure
	$(BIN)/python -m benchmarks.measure_load --seconds $(SECONDS)
	$(BIN)/python -m benchmarks.sinks
	$(BIN)/python -m benchmarks.sensor
	$(BIN)/python -m benchmarks.wrapped
	$(BIN)/python -m benchmarks.measure_time

# The base station under load; SECONDS=3600 is the soak.
SECONDS ?= 20
bench-ncap: $(VENV)/.dev
	$(BIN)/python -m benchmarks.ncap --seconds $(SECONDS)
	$(BIN)/python -m benchmarks.newcomers
	$(BIN)/python -m benchmarks.crowd
	$(BIN)/python -m benchmarks.footprint

bench-page: $(VENV)/.dev
	$(BIN)/python -m benchmarks.page --seconds $(SECONDS)

bench-handover: $(VENV)/.dev
	$(BIN)/python -m benchmarks.handover

bench-scale: $(VENV)/.dev
	$(BIN)/python -m benchmarks.scale

# A kernel with CAN and Bluetooth in qemu, over this checkout: SocketCAN, ISO-TP, bluetoothd. Slow; never for timings.
test-system: $(VENV)/.dev
	@sh scripts/install-test-machine || { test -z "$$CI" && echo "Going on without: the tests are skipped."; }
	$(BIN)/python -m pytest tests/system -m machine -rs --durations=5

# ROS 2 by the real rclpy of PyPI: 251 MB, in an environment of their own.
ROS_PYTHON ?= $(PYTHON)
RCLPY := ros-jazzy-rclpy[fastrtps] ros-jazzy-std-msgs ros-jazzy-sensor-msgs ros-jazzy-geometry-msgs ros-jazzy-diagnostic-msgs
test-rclpy: $(VENV)/.dev .venv-rclpy/.made
	$(BIN)/python -m pytest tests/measure -m rclpy -rs

.venv-rclpy/.made:
	$(ROS_PYTHON) -m venv .venv-rclpy
	.venv-rclpy/bin/python -m pip install --quiet $(foreach each,$(RCLPY),'$(each)')
	@touch $@

# An SMP client in Rust (mcumgr-toolkit of PyPI, in an environment of its own) updates a virtual node and the host port.
test-smp: $(VENV)/.dev .venv-smp/.made
	$(MAKE) -C firmware host
	$(BIN)/python -m pytest tests/strangers/test_smp_peer.py tests/firmware/test_smp_peer.py -m soak -rs

.venv-smp/.made:
	$(PYTHON) -m venv .venv-smp
	.venv-smp/bin/python -m pip install --quiet 'mcumgr-toolkit>=0.20'
	@touch $@

# Coverage-guided fuzzing of every parser of octets: RUNS inputs each (a million take about an hour and a half on one
# core), or one of them: make fuzz TARGET=nfc RUNS=100000. atheris gets an environment of its own.
RUNS ?= 1000000
FUZZ_TARGETS := teds sheet security frames operation nfc can smp update about firmware bundle receipt backup whitelist calibration certificate profile image evidence plant line units
fuzz: .venv-fuzz/.ready
	@mkdir -p build/fuzz
	@set -e; for target in $(or $(TARGET),$(FUZZ_TARGETS)); do \
	  echo "== $$target"; .venv-fuzz/bin/python tests/fuzz/run.py $$target -runs=$(RUNS); done

# Cuts at every durable write and message of every changing command, failing disks, power loss, two commands at once,
# backups of 100,000 nodes; an hour and a half, or all (FULL=1).
faults: $(VENV)/.dev
	$(BIN)/python -m tests.faults.bench $(if $(FULL),--full,--minutes 60)
	$(BIN)/python -m pytest -q -m soak tests/provisioning/test_update.py
	$(BIN)/pytest -q -m "soak or not soak" tests/plant/test_cut.py tests/plant/test_line_cut.py \
	  tests/plant/test_server_faults.py

# Every changing command beside every long-running one, started before, during and after it (tests/pairs): about 150
# pairs, each at three times; 15 minutes on two cores. CELLS="vault rewrap": those whose name contains it. BUSY=1: beside
# other work, where no rule about time is held.
pairs: $(VENV)/.dev
	$(BIN)/python -m tests.pairs.bench $(if $(CELLS),--only '$(CELLS)') $(if $(BUSY),--busy)

# A service on bad days: its clock set, its disk filled, an adapter pulled, 10,000 invented nodes, in rounds.
MINUTES ?= 30
soak: $(VENV)/.dev
	$(BIN)/python -m tests.soak.run --minutes $(MINUTES)

# Does a test notice when the code is broken? Rules of the profile by pattern, and random mutants; prints the survivors.
# 300 within the hour on two cores: make mutants ROOM=steps COUNT=100, or ROOM=protocol/tim/teds_access.py
COUNT ?= 300
mutants: $(VENV)/.dev
	$(BIN)/python -m tests.mutants.run --count $(COUNT) $(if $(ROOM),--room $(ROOM))

# Which tests do others make redundant? Runs the gate with a probe at each statement and branch and measures each test,
# then prints the dearest whose every probe two others hit (CONTRIBUTING.md). PATHS="tests/cli tests/e2e" for a part. An hour on two cores.
redundant: $(VENV)/.dev
	$(BIN)/python -m tests.redundant.run -n $(WORKERS) $(PATHS)
	$(BIN)/python -m tests.redundant.choice --rooms
	$(BIN)/python -m tests.redundant.choice

# What follows from the command line's own definitions: option names, docs/configuration.md, the man page.
man: $(VENV)/.dev
	$(BIN)/python scripts/options.py

# The vectors for firmware as C constants, in build/vectors-c (docs/vectors.md).
vectors-c: $(VENV)/.made
	$(BIN)/python -m tests.vectors.c_arrays build/vectors-c

# Branch coverage of the suite, processes that it starts counted; the floor stands in pyproject.toml. TESTS names a part.
# Goes on where a test fails: those that give a program two seconds may, when it is measured as well.
coverage: $(VENV)/.dev
	@mkdir -p build
	$(BIN)/python -m coverage erase
	-$(BIN)/python -m coverage run -m pytest -n $(WORKERS) --dist worksteal $(TESTS)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report --skip-covered --sort=cover $(if $(TESTS),--fail-under=0)
	$(BIN)/python -m coverage html --quiet && echo "build/coverage/index.html"

# Pages of every public name, from the docstrings.
api: $(VENV)/.dev
	$(BIN)/python scripts/api.py build/api

# The suite on another Python, in an environment of its own: make test-other PYTHON=python3.13
test-other:
	@$(MAKE) --no-print-directory unit VENV=.venv-$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')

# The figures of the house: circles, late imports, modules, helpers used once, shared names, complexity, lines.
house: $(VENV)/.dev
	$(BIN)/python scripts/house.py

# How far docstrings and names are from the field's language, beside other codebases: a mirror, not a gate.
words: $(VENV)/.dev
	$(BIN)/python scripts/words.py

# The tests of a room and of the rooms that import it: make room ROOM=station
room: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 --dist worksteal --hypothesis-profile gate -m '$(USUAL)' $$($(BIN)/python scripts/room.py $(ROOM))

# The models, by SPIN: the rules hold, each broken one is found. Then ten minutes of a key's life are replayed with the code.
model: $(VENV)/.dev
	$(BIN)/python model/check.py
	$(BIN)/python -m tests.model.run

# Stamps, not the files that are made: what was cut short is made anew.
$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' || \
	  { echo "Python 3.11 to 3.13 is needed; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@echo "Making the virtual environment $(VENV) with $(PYTHON) …"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --upgrade pip
	@touch $@

# Exactly what was tested, by hash; `make test-other LOCKED=` takes the newest that pyproject.toml allows.
LOCKED ?= yes
$(VENV)/.run: $(VENV)/.made pyproject.toml locks/ncap.txt
	@echo "Installing teds-provision with its service and page …"
	@$(if $(LOCKED),$(BIN)/python -m pip install --quiet --require-hashes --requirement locks/ncap.txt)
	@$(BIN)/python -m pip install --quiet $(if $(LOCKED),--no-deps) --editable '.[ncap]'
	@touch $@

$(VENV)/.dev: $(VENV)/.made pyproject.toml locks/dev.txt
	@echo "Installing teds-provision and what its tests need …"
	@$(if $(LOCKED),$(BIN)/python -m pip install --quiet --require-hashes --requirement locks/dev.txt)
	@$(BIN)/python -m pip install --quiet $(if $(LOCKED),--no-deps) --editable '.[dev]'
	@touch $@ $(VENV)/.run

.venv-fuzz/.ready: pyproject.toml
	$(PYTHON) -m venv .venv-fuzz
	.venv-fuzz/bin/python -m pip install --quiet --editable '.[fuzz,bench,update]'
	@touch $@

# The node in C: the host port over BearSSL and over Mbed TLS, and its C tests under the sanitizers (firmware/README.md).
# Under a minute, without a virtual environment.
firmware:
	@sh scripts/install-firmware-host
	@$(PYTHON) -m tests.vectors.c_arrays build/vectors-c
	$(MAKE) --no-print-directory -C firmware -j$$(nproc) all psa check

# Every faulty node in C, each found by its rule, builds of other sizes and options, each with every rule, and updates that are
# interrupted at every exchange and at every step of flash.
firmware-faults: $(VENV)/.dev
	@sh scripts/install-test-packages
	$(BIN)/python -m pytest -q -n $(WORKERS) -m 'soak or not soak' tests/firmware/test_faults.py tests/firmware/test_options.py \
	  tests/firmware/test_host_updates.py tests/firmware/test_update_interruptions.py

# Every test of whole runs whose needs the node in C meets, with it on the desk (tests/firmware/c_node.py).
OF_C := tests/e2e tests/cli/test_handover.py tests/cli/test_life.py tests/cli/test_messages.py tests/check/test_node_check_cli.py
test-c: $(VENV)/.dev
	@sh scripts/install-test-packages
	TEDS_NODE=c $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -rs -m '$(USUAL) and not realtime' $(OF_C)

# 10 kHz of 16 bits for ten minutes on CAN FD and on 1 Mbit/s, and 200 nodes in C on one bus. Wants a machine for itself.
firmware-soak: $(VENV)/.dev
	TEDS_C_WORDS=LEVEL=-O0 SECONDS_OF_SOAK=$${SECONDS_OF_SOAK:-600} $(BIN)/python -m pytest tests/firmware/test_soak.py -m soak -s -rs

# Lines and branches of firmware/src that its tests reach, by gcov: the C tests, those in one process and the host port.
# Three minutes; not the faulty nodes, which are copies. Goes on where a test fails; fails below 95 % of the branches.
COUNTED := LEVEL=-O0 --coverage,HOST_LEVEL=-O0 --coverage
firmware-coverage: vectors-c $(VENV)/.dev
	@sh scripts/install-test-packages
	rm -rf firmware/build/counted
	$(MAKE) --no-print-directory -C firmware BUILD=build/counted SANITIZED="-O0 -g --coverage" check
	-TEDS_C_BUILD=build/counted TEDS_C_WORDS="$(COUNTED)" $(BIN)/python -m pytest -q -m '$(USUAL)' \
	  --ignore tests/firmware/test_faults.py --ignore tests/firmware/test_c_tests.py tests/firmware
	$(BIN)/python -m tests.firmware.coverage firmware/build/counted

# The Zephyr module against a Zephyr tree, the folder zephyr of a west workspace: the load cell on native_sim, then both
# boards. Skipped with a line without ZEPHYR (firmware/docs/porting.md).
firmware-zephyr:
	@sh firmware/zephyr/build.sh "$(ZEPHYR)"

# The library on Cortex-M0+, M4 and M33: sizes, stack, instructions held; the M4 image under qemu is checked as a node.
# The C tests as 32 bits and big-endian, too, and what cppcheck and clang-tidy say.
firmware-arm: $(VENV)/.dev vectors-c
	@sh scripts/install-firmware-packages
	$(MAKE) --no-print-directory -C firmware arm others analyse
	$(BIN)/python -m pytest tests/firmware/test_arm.py -m machine -rs

.PHONY: dist locks docs test-versions test-all container-root
# What is released, in dist/: wheel and sdist (the wheel is built from the sdist), bills of materials (CycloneDX) of the tool and
# of the C library, checksums. No time of day and no folder gets into them: two builds of a commit are equal.
dist: .venv-release/.ready
	.venv-release/bin/python scripts/dist.py dist

# The documentation as a site, in build/site, with the references that follow from code. A dead link, a missing heading or a
# page without an entrance is an error; the gate builds the same.
docs: $(VENV)/.dev
	$(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python scripts/api.py build/site/python

# Before a release: the gate, and what proves the same at greater length.
test-all: test bench-short .venv-mujoco/.made
	$(BIN)/python -m pytest -n 2 --dist worksteal -rsR --hypothesis-profile=gate -m nightly
	$(BIN)/python -m pytest tests/release tests/test_core_alone.py tests/plant/test_returned_pages.py tests/ncap/test_by_topics.py tests/node/test_examples.py -m soak -rs

.venv-mujoco/.made:
	$(PYTHON) -m venv .venv-mujoco
	.venv-mujoco/bin/python -m pip install --quiet mujoco
	@touch $@

# Each benchmark at its smallest size, so that none breaks unseen; the figures mean nothing.
bench-short: $(VENV)/.dev
	$(BIN)/python -m benchmarks.short

# The steps of service/Containerfile on a Debian root, and the demo in it as its user on a read-only root. As root, with
# debootstrap; no container engine is needed. Keeps the bare root in build/container for the next time.
container-root:
	$(PYTHON) scripts/container_root.py build/container

# The tests with other versions than the locks have: RESOLUTION=lowest-direct takes the oldest that pyproject.toml
# allows, highest the newest there are.
RESOLUTION ?= lowest-direct
test-versions: .venv-release/.ready
	rm -rf .venv-versions
	.venv-release/bin/python -m uv venv --quiet --seed --python $(PYTHON) .venv-versions
	.venv-release/bin/python -m uv pip install --quiet --python .venv-versions --resolution $(RESOLUTION) --editable '.[dev]'
	.venv-versions/bin/python -m pytest -n $(WORKERS) --dist worksteal -m '$(USUAL) and not realtime and not system' \
		--deselect tests/cli/test_configuration.py::test_what_follows_from_the_command_line_is_up_to_date  # as the lock's click wraps

# The locks, by purpose: base, ncap, dev and the tools of a release. Resolves anew and shows what changed.
locks: .venv-release/.ready
	.venv-release/bin/python scripts/locks.py

# What is in an installation, as a CycloneDX bill of materials.
sbom: .venv-release/.ready $(VENV)/.run
	@mkdir -p build
	.venv-release/bin/cyclonedx-py environment $(VENV)/bin/python --output-format JSON --output-file build/sbom.json
	@echo "build/sbom.json"

.venv-release/.ready: locks/release.txt
	$(PYTHON) -m venv .venv-release
	.venv-release/bin/python -m pip install --quiet --require-hashes --requirement locks/release.txt
	@touch $@

clean:
	rm -rf $(VENV) .venv-mujoco .venv-fuzz .venv-smp .venv-release .venv-versions .mypy_cache .ruff_cache .pytest_cache
