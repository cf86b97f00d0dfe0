# Everything from a fresh clone: `make demo`, `make test`. Needs Python 3.10 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Compiled once, not by each of some hundred processes of the tests.
unexport PYTHONDONTWRITEBYTECODE
# uv takes an eighth of pip's time; pip stands in where uv does not run or finds no index. Like pip
# it trusts the certificates of the system, as behind a company's proxy.
export UV_SYSTEM_CERTS := 1
define packages
{ $(BIN)/uv pip install --quiet --python $(or $(2),$(BIN)/python) $(1) \
	|| $(or $(2),$(BIN)/python) -m pip install --quiet --disable-pip-version-check $(1); }
endef

.PHONY: demo prepared collected test fuzz mutants lint oldest screenshots docs clean

demo: $(VENV)/commands
	$(BIN)/calib_ros demo --out demo --force
	@echo
	@echo 'Now open demo/report.html in a browser. To go on:'
	@echo '  . $(VENV)/bin/activate'
	@echo '  calib_ros                  # what there is to do'
	@echo '  calib_ros robots           # is your arm among these?'
	@echo '  calib_ros identify demo/bag --chain ur10e'

prepared: $(VENV)/installed $(VENV)/tf2_msgs/installed $(VENV)/mocap4r2_msgs/installed

# Modules are compiled, and asserts of tests rewritten, once: else by each worker of `make test`.
collected: prepared
	-$(BIN)/python -m pytest --collect-only --quiet > /dev/null

test: prepared
	$(BIN)/python -m pytest -n auto --dist worksteal $(PYTEST_ARGUMENTS)

FUZZ_SECONDS ?= 600
fuzz: $(VENV)/installed
	$(call packages,--only-binary :all: atheris) \
	    || echo 'no atheris for this Python: random variants only'
	OMP_NUM_THREADS=1 $(BIN)/python test/fuzz/fuzz_run.py --seconds $(FUZZ_SECONDS)

# Changes one thing at a time in numeric modules and tells what no test near them notices: COUNT
# mutants, chosen at random by SEED, of PART: modules, folders or names of mutants, as printed; if
# not given, the modules that the last commit and later work changed. Minutes; not part of CI.
COUNT ?= 40
SEED ?= 0
mutants: $(VENV)/installed
	$(call packages,mutmut==3.8.1)
	OMP_NUM_THREADS=1 $(BIN)/python test/mutants.py $(PART) --count $(COUNT) --seed $(SEED)

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The oldest versions that setup.py allows: those of Ubuntu 24.04, and its Python.
OLDEST_PYTHON ?= python3.12
OLDEST := .venv-oldest
# Without modules that draw for minutes what commands of others call, too, or that hardly meet the
# packages: processes that are killed, full disks, names of columns.
OLDEST_TESTS ?= test/apply test/cli test/files test/kinematics \
	$(foreach module,apply/chart apply/iso_9283 apply/placement apply/planning \
	apply/stated_noise apply/verification cli/output files/atomic files/killed_results \
	files/names,--ignore=test/$(dir $(module))test_$(notdir $(module)).py) \
	test/decision/test_delays.py test/identification/test_identification.py \
	test/report/test_report_files.py test/ros/test_node.py

oldest: $(OLDEST)/installed
	$(OLDEST)/bin/python -m pytest -n auto --dist worksteal $(OLDEST_TESTS) $(PYTEST_ARGUMENTS)

$(OLDEST)/installed: setup.py pyproject.toml test/oldest.txt | $(BIN)/python
	$(OLDEST_PYTHON) -m venv --clear $(OLDEST) || { echo 'needs $(OLDEST_PYTHON) with venv'; exit 1; }
	$(call packages,--constraint test/oldest.txt --editable '.[$(TESTS)]',$(OLDEST)/bin/python)
	touch $@

COMMANDS := bags,report,terminal
TESTS := ros,test

# With a dot every 2 s.
define install
	@echo "installing calib_ros[$(1)] into $(VENV)"
	@while sleep 2; do printf .; done & dots=$$!; trap "kill $$dots" EXIT INT TERM; \
	$(call packages,--editable '.[$(1)]')
	touch $@
endef

$(BIN)/python:
	$(PYTHON) -m venv $(VENV) || { echo 'needs venv: apt install python3-venv'; exit 1; }
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

# What the commands need without ROS; what the tests need holds all of it.
$(VENV)/commands: setup.py pyproject.toml | $(BIN)/python
	$(call install,$(COMMANDS))

$(VENV)/installed: setup.py pyproject.toml | $(BIN)/python
	$(call install,$(TESTS))
	touch $(VENV)/commands

# Packages of messages that ROS has and PyPI has not.
$(VENV)/%_msgs/installed: $(VENV)/installed test/messages.cmake test/%_msgs/msg/*.msg
	mkdir -p $(@D)
	export PATH="$(CURDIR)/$(BIN):$$PATH" CMAKE_PREFIX_PATH="$(CURDIR)/$(VENV)" \
	AMENT_PREFIX_PATH="$(CURDIR)/$(VENV)" && { \
	cmake -S test/$*_msgs -B $(@D) -DBUILD_TESTING=OFF \
	-DCMAKE_INSTALL_PREFIX="$(CURDIR)/$(VENV)" -DPython3_EXECUTABLE="$(CURDIR)/$(BIN)/python" && \
	cmake --build $(@D) --target install; } > $(@D)/log 2>&1 \
	|| { tail $(@D)/log; echo 'needs a C++ compiler: apt install g++'; exit 1; }
	touch $@

# Pictures of the report for docs/; needs Chromium and CALIB_ROS_DATA.
screenshots: $(VENV)/installed
	$(BIN)/python benchmarks/report.py --screenshots docs

# The site, into build/site.
docs: $(VENV)/installed
	$(call packages,--editable '.[docs]')
	$(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) $(OLDEST) demo mutants build install log *.egg-info
