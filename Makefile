# `make render` and `make test` need nothing but python3 (3.10 or newer, with venv) and make.

SHELL := bash
.SHELLFLAGS := -o pipefail -c

PYTHON ?= python3
SCENE  ?= scenes/paper_room.xml

BIN    := .venv/bin
STAMP  := .venv/.installed
LLVM   := .venv/.llvm
SUDO   := $(if $(filter 0,$(shell id -u)),,sudo)

# Debian's and Ubuntu's names, best first. LLVM 16 and older make Dr.Jit abort.
LLVM_PACKAGES := libllvm19 libllvm20 libllvm21 libllvm18 libllvm17 libllvm17t64

.PHONY: render test docs lint clean
.DELETE_ON_ERROR:

render: $(LLVM)
	$(BIN)/python -m compare render $(SCENE) --equal time --runs 3 --reference-spp 128

test: $(LLVM)
	$(BIN)/python -m pytest

# The tutorial with its pictures, and pages of the interface in renders/api.
docs: $(LLVM)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/python -m nbconvert --to notebook --execute --inplace envmap_integrator/docs/tutorial.ipynb
	$(BIN)/python -m tests.api renders/api

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	rm -rf .venv build dist renders .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	    { echo "Python's venv module is missing: apt-get install python3-venv" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test,compare]'
	@touch $@

CHECK_LLVM := $(BIN)/python -c 'from envmap_integrator.system.llvm import ensure_llvm; print(ensure_llvm())'

define INSTALL_LLVM
command -v apt-get >/dev/null && $(SUDO) true 2>/dev/null && $(SUDO) apt-get update -qq && \
for package in $(LLVM_PACKAGES); do \
    $(SUDO) apt-get install -y -qq --no-install-recommends $$package && break; \
done
endef

# The last line of a failed check says which package is missing.
$(LLVM): $(STAMP)
	@$(CHECK_LLVM) >/dev/null 2>&1 || { $(INSTALL_LLVM); } || true
	@$(CHECK_LLVM) 2>&1 | tail -n 1
	@touch $@
