# zerobev: set-up, tests and the workbook. `make help` lists the targets.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

SCALE ?= reduced
SCENES ?=
TEXTURES ?=
FRESH ?=
SPOT ?=
PLAN ?=
export SCALE SCENES TEXTURES SPOT

PYTHON := .venv/bin/python
READY := .venv/.ready
RENDERER := .venv/.renderer
MESA := libegl1 libgl1 libgl1-mesa-dri

export TOKENIZERS_PARALLELISM ?= false
# Packages come only from .venv.
unexport PYTHONHOME PYTHONPATH

.PHONY: help setup reproduce check test unit integration static integrity nbval coverage lab notebooks clean distclean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' Makefile

# FRESH=1 computes all runs again; otherwise one recorded run is computed again and compared with its record.
# PLAN=1 only prints a forecast of the cost; at the paper's scale it comes first, and ends the run if the machine is too small.
reproduce: setup ## run the workbook [SCALE=smoke|reduced|paper SCENES=dir TEXTURES=dir FRESH=1 SPOT=row PLAN=1]
	@fresh="$(filter-out 0,$(FRESH))"
	plan="$(filter-out 0,$(PLAN))"
	if [ -n "$$TEXTURES" ]; then export ZEROBEV_TEXTURES="$$(realpath -m "$$TEXTURES")"; fi
	if [ -n "$$plan" ] || [ "$$SCALE" = paper ]; then
	    $(PYTHON) -m zerobev plan --scale "$$SCALE" $${SCENES:+--scenes "$$SCENES"} $${TEXTURES:+--textures "$$TEXTURES"}
	fi
	[ -z "$$plan" ] || exit 0
	$(PYTHON) -m zerobev reproduce --scale "$$SCALE" $${SCENES:+--scenes "$$SCENES"} \
	    $${TEXTURES:+--textures "$$TEXTURES"} $${fresh:+--fresh}
	$(PYTHON) -m zerobev summary --scale "$$SCALE" $${SCENES:+--scenes "$$SCENES"}
	[ -n "$$fresh" ] || $(PYTHON) -m zerobev spot-check --scale "$$SCALE" $${SCENES:+--scenes "$$SCENES"} \
	    $${SPOT:+--row "$$SPOT"}

# Two parts at a time, the longest first: most of them use one core. The output of a part is printed at its end.
PARTS := $(MAKE) --jobs=2 --keep-going --output-sync=target

test: setup ## run all tests, and check every notebook against its committed outputs
	@$(PARTS) unit-2 integration nbval unit-1 integrity

check: setup ## the fast loop, about 3 min: style, types, layers, spelling, and the unit tests that are not slow
	@$(PARTS) fast-2 fast-1 static

# The unit tests in two halves, which run at once; not for the list of `make help`.
.PHONY: unit-1 unit-2 fast-1 fast-2

FIRST_HALF := $(addprefix tests/unit/,scenes rendering data experiments theory)
SECOND_HALF := tests/unit $(FIRST_HALF:%=--ignore=%)

unit: setup ## the unit tests alone
	@$(PYTHON) -m pytest tests/unit

unit-1 unit-2: setup
	@$(PYTHON) -m pytest $(if $(filter unit-1,$@),$(FIRST_HALF),$(SECOND_HALF))

fast-1 fast-2: setup
	@$(PYTHON) -m pytest $(if $(filter fast-1,$@),$(FIRST_HALF),$(SECOND_HALF)) -m "not slow"

integration: setup ## the tests of several rooms or processes
	@$(PYTHON) -m pytest tests/integration

static: setup ## style, types, layers and spelling
	@$(PYTHON) -m pytest tests/integrity/test_static.py

integrity: setup ## style, types, layers, records, dependencies, and the form of notebooks
	@$(PYTHON) -m pytest tests/integrity

nbval: setup ## check the notebooks alone
	@$(PYTHON) -m pytest --nbval notebooks

coverage: setup ## run the tests and print their coverage of each file of zerobev/
	@$(PYTHON) -m coverage run -m pytest tests
	$(PYTHON) -m coverage report --skip-covered --sort=cover

lab: setup ## open the notebooks in JupyterLab
	@$(PYTHON) -c "$$OPEN_LAB" notebooks $$([ "$$(id -u)" != 0 ] || echo --allow-root)

define OPEN_LAB
import os
from jupyterlab.labapp import main
from zerobev.report.notebooks import kernel_settings
os.environ.update(kernel_settings())
main()
endef
export OPEN_LAB

notebooks: setup ## execute the committed notebooks again, in place
	@$(PYTHON) -m zerobev reproduce --in-place

setup: $(RENDERER) ## install the pinned environment into .venv (the other targets do it when needed)

clean: ## remove caches (shards and checkpoints too), executed notebooks and logs; records stay
	@rm -rf .cache .coverage .pytest_cache .ruff_cache .mypy_cache .hypothesis *.egg-info reports/*/notebooks reports/*/logs
	find zerobev tests notebooks -depth \( -name __pycache__ -o -name .ipynb_checkpoints \) -exec rm -rf {} +

distclean: clean ## as clean, and remove .venv
	@rm -rf .venv

# .venv contains `.unfinished` during a set-up: after an interruption, the next set-up starts from nothing.
$(READY): environment.txt pyproject.toml
	@if [ -e .venv/.unfinished ]; then rm -rf .venv; fi
	if [ ! -e $(PYTHON) ]; then
	    for python in python3.12 python3.11 python3 python; do
	        if "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
	            found=$$python
	            break
	        fi
	    done
	    if [ -z "$${found:-}" ]; then
	        echo "error: no Python 3.11 or newer with its venv module was found (Debian: python3 and python3-venv)" >&2
	        exit 1
	    fi
	    mkdir -p .venv
	    touch .venv/.unfinished
	    "$$found" -m venv .venv
	fi
	touch .venv/.unfinished
	echo "Setting up .venv from environment.txt; this takes some minutes, once."
	$(PYTHON) -m pip install --disable-pip-version-check -r environment.txt
	$(PYTHON) -m pip install --disable-pip-version-check --quiet --no-deps -e .
	touch .venv/.unfinished
	mv .venv/.unfinished $@

define OPEN_EGL
from zerobev.rendering.opengl import pyrender
scene = pyrender.Scene()
scene.add(pyrender.PerspectiveCamera(yfov=1.0))
pyrender.OffscreenRenderer(8, 8).render(scene)
endef
export OPEN_EGL

# Only an opened context, and no file, shows that photographs can be rendered here.
$(RENDERER): $(READY)
	@opens() { $(PYTHON) -c "$$OPEN_EGL" >/dev/null 2>&1; }
	if ! opens; then
	    if [ "$$(id -u)" = 0 ]; then root=; else root="sudo -n"; fi
	    if $${root:-true} true 2>/dev/null && command -v apt-get >/dev/null; then
	        echo "Installing $(MESA)."
	        install="env DEBIAN_FRONTEND=noninteractive apt-get install -qq $(MESA)"
	        $$root $$install >/dev/null 2>&1 || { $$root apt-get update -qq; $$root $$install; } >/dev/null 2>&1 || true
	    fi
	    if ! opens; then
	        echo "error: EGL does not open here; install the packages $(MESA)" >&2
	        exit 1
	    fi
	fi
	touch $@
