# Each target makes what it needs: the first one builds .venv with the versions of constraints.txt.
PYTHON ?= python3
# Modules are compiled when they are first imported, and kept, whatever the environment says: else each of the hundreds
# of processes that the tests start would compile them again.
unexport PYTHONDONTWRITEBYTECODE
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: setup demo test test-virtual-camera check check-style check-types check-docs bench docs format constraints clean help

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 24

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "bricktrack needs Python 3.11 or newer; $(PYTHON) is older. Try: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt \
	    -e '.[device,sim,host,dashboard,scale,analysis,view]' --group dev
	@touch $@

setup: $(READY)  ## make the virtual environment .venv, and no more

demo: $(READY)  ## record a simulated brick with the real daemon, pull it, process it, write the report
	$(BIN)/bricktrack demo --folder demo

# A third worker saves two minutes, but simulated cameras then starve each other: it is no default.
WORKERS ?= 2
test: $(READY)  ## all tests, two files at a time
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

test-virtual-camera: $(READY)  ## the picamera2 adapter under the real libraries, on the virtual Pi
	tests/virtual_pi/run_camera.sh

check: $(READY)  ## formatting, lint, import contracts, types, documentation
	+@$(MAKE) --no-print-directory --jobs 2 --output-sync=target check-docs check-types check-style

check-style: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

check-types: $(READY)
	$(BIN)/mypy

# All pages are read and all references resolved; writing them as HTML, which 'make docs' does, takes twice as long.
check-docs: $(READY)
	@rm -rf docs/reference/generated
	$(BIN)/sphinx-build -q -W -b dummy docs docs/_build/dummy

bench: $(READY)  ## measure speed and accuracy; ratios are taken side by side in one run
	$(BIN)/python scripts/bench.py

docs: $(READY)  ## build the documentation into docs/_build/html
	@rm -rf docs/reference/generated
	$(BIN)/sphinx-build -W -b html docs docs/_build/html

format: $(READY)  ## put the code into its form
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

constraints: $(READY)  ## write down the versions that are installed now
	{ echo '# Versions that are tested together. Refresh with: make constraints'; \
	  $(BIN)/python -m pip freeze --exclude-editable --exclude pip --exclude setuptools; } > constraints.txt

clean:  ## remove what the other targets made
	rm -rf $(VENV) demo docs/_build build dist
