# Every target sets up what it needs in .venv, on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGE := $(VENV)/.ready-package
READY := $(VENV)/.ready
# pip reports errors, and no warnings: it warns once for each package that a local index lacks. Python compiles a module
# when it is first imported, which is cheaper than compiling all of them now.
INSTALL := $(BIN)/python -m pip install --quiet --quiet --no-compile --constraint constraints.txt

.PHONY: demo test lint docs release-check campaign shrec07 bench clean

demo: $(PACKAGE)
	$(BIN)/igps demo --out build/demo

# One process per core, at most eight, because each loads torch. Neighbouring tests share fixtures, so --dist worksteal
# moves tests to another process only at the end.
test: $(READY)
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# make campaign [SMALL=1]: broken meshes and bodies, killed processes; less than half an hour on two cores. SMALL=1
# takes a minute.
campaign: $(READY)
	$(BIN)/python tests/campaign/campaign.py $(if $(SMALL),--small)

# make shrec07 DATA=folder-of-meshes-with-labels.csv [WRITE=1]: compares the scores of the named descriptors with the
# expected ones; WRITE=1 writes the scores as the expected ones.
shrec07: $(READY)
	@test -n "$(DATA)" || { echo "make shrec07 DATA=FOLDER: name the folder of the SHREC'07 meshes (with labels.csv)"; exit 2; }
	$(BIN)/python tests/campaign/shrec07.py "$(DATA)" $(if $(WRITE),--write)

# torch is installed first, pinned: the newest build would bring gigabytes of CUDA libraries.
$(PACKAGE): pyproject.toml constraints.txt
	@echo "Installing igps and the packages that it needs in $(VENV)"
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) torch
	@$(INSTALL) --editable .
	@touch $@

$(READY): $(PACKAGE)
	@echo "Installing the packages that tests and lint need in $(VENV)"
	@$(INSTALL) --editable ".[test,lint]"
	@touch $@

# make release-check: tests the wheel and the source archive in empty environments, with the lowest and the newest
# versions of the dependencies; needs some gigabytes of disk.
release-check: $(READY)
	$(BIN)/python tests/release_check.py

# make docs: the documentation as a site, in build/site; warnings are errors. The variable silences an advertisement.
docs: $(READY) $(VENV)/.ready-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

$(VENV)/.ready-docs: $(READY)
	@echo "Installing the packages that the documentation needs in $(VENV)"
	@$(INSTALL) --editable ".[docs]"
	@touch $@

# make bench [DATA=folder-of-meshes-with-labels.csv]
bench: $(READY)
	$(BIN)/python tests/benchmarks/bench.py $(if $(DATA),--data "$(DATA)")

clean:
	rm -rf build $(VENV)
