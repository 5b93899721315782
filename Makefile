# Everything here works on a fresh machine with Python 3.11, pip, make and a C compiler.
PYTHON ?= python3.11
ifeq (, $(shell command -v $(PYTHON) 2>/dev/null))
PYTHON := python3
endif
VENV ?= .venv
BIN := $(VENV)/bin
# The public index of PyTorch's CPU wheels; where it cannot be reached, pip's configured index is used.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH := torch==2.13.0

.DEFAULT_GOAL := help
.PHONY: browser figures viewer-frames screenshots docs planning studies study-bases study-main study-everybody study-unseen study-growth study-wild study-seconds study-ablation coverage live peers where personal reproduce stream-check performance picture crowd faults help serve test lint types imports check-migrations unit clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 22

$(BIN)/python:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Kinecast needs Python 3.11 or newer"'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.torch: | $(BIN)/python
	@if $(BIN)/python -c "import urllib.request as u; u.urlopen('$(TORCH_INDEX)/torch/', timeout=5)" 2>/dev/null; \
	then echo "$(TORCH) from $(TORCH_INDEX)"; $(BIN)/pip install -q --index-url $(TORCH_INDEX) $(TORCH); \
	else echo "$(TORCH) from pip's configured index"; $(BIN)/pip install -q $(TORCH); fi
	@touch $@

KERNEL := $(wildcard models/runtime/native/*)
$(VENV)/.serve: pyproject.toml .constraints.txt $(KERNEL) $(VENV)/.torch
	$(BIN)/pip install -q -c .constraints.txt -e .
	@touch $@

$(VENV)/.test: pyproject.toml .constraints.txt $(KERNEL) $(VENV)/.torch
	$(BIN)/pip install -q -c .constraints.txt -e '.[dev,docs]'
	@touch $@ $(VENV)/.serve

$(VENV)/.peers: $(VENV)/.test
	$(BIN)/pip install -q -c .constraints.txt -e '.[peers]'
	@touch $@

$(VENV)/.docs: pyproject.toml .constraints.txt | $(BIN)/python
	$(BIN)/pip install -q -c .constraints.txt $$($(BIN)/python -c \
	  'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])')
	@touch $@

serve: $(VENV)/.serve ## set up what is missing and start the service on http://127.0.0.1:8000
	@$(BIN)/kinecast serve $(ARGS)

test: $(VENV)/.test lint types imports check-migrations unit ## lint, types, layers, migrations and all tests

lint: $(VENV)/.test ## style and common errors
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.test ## mypy --strict; the client for the oldest Python that it takes as well
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 clients/python/src

imports: $(VENV)/.test ## the layers of the code, as contracts
	$(BIN)/lint-imports

check-migrations: $(VENV)/.test ## the migrations give exactly the tables of the code
	$(BIN)/kinecast db check

# One process per core, each with one thread of arithmetic; a file's tests stay together, as they share a service.
PYTEST_WORKERS ?= 2
unit: $(VENV)/.test ## all tests (ARGS="-k stream" for some)
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n $(PYTEST_WORKERS) --dist loadscope $(ARGS)

coverage: $(VENV)/.test ## all tests with branch coverage, at least 95 % (half as long again)
	$(MAKE) unit ARGS="--cov --cov-report=term $(ARGS)"

SHARED ?= ../shared/data
reproduce: $(VENV)/.test ## train the shipped base again, and kill and resume a shorter run (about 20 min)
	$(BIN)/python -m benchmarks.reproduce --data $(SHARED)/utd-mhad --mix $(SHARED)/more-people

stream-check: $(VENV)/.test ## stream real recordings in real time and compare with `evaluate` (about 2 min)
	UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} $(BIN)/python -m benchmarks.stream_check $(ARGS)

performance: $(VENV)/.test ## the figures of docs/performance.md; on an idle machine (about 15 min)
	$(BIN)/python -m benchmarks.performance $(ARGS)

where: $(VENV)/.test ## where a service's processor time goes; needs Linux's perf (20 s)
	$(BIN)/python -m benchmarks.where $(ARGS)

peers: $(VENV)/.peers ## beside LitServe, Ray Serve and PyTorch alone; on an idle machine (about 9 min)
	$(BIN)/python -m benchmarks.peers $(ARGS)

personal: $(VENV)/.test ## what personal versions give real people, through a running service (about 30 min)
	UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} $(BIN)/python -m benchmarks.personal $(ARGS)

crowd: $(VENV)/.test ## 200 people record at once: fair order, memory, jobs per minute (about 25 min)
	$(BIN)/python -m benchmarks.crowd $(ARGS)

live: $(VENV)/.test ## record a real person on a stream, check every answer, draw the timeline (about 4 min)
	UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} $(BIN)/python -m benchmarks.live --figure docs/figures/personalisation.svg $(ARGS)

planning: $(VENV)/.test ## a robot beside recorded people, with and without forecasts (about 15 min)
	OMP_NUM_THREADS=1 UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} $(BIN)/python -m benchmarks.planning $(ARGS)

faults: $(VENV)/.test ## kill, stop, fill and damage what can be, 20 times each (about 30 min; some of it as root)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.faults $(ARGS)

# The evidence for base and personal versions. Rows are kept in benchmarks/results and computed once (ARGS=--fresh: again);
# a run that was ended goes on where it was. ARGS=--list says what is missing, ARGS=--report sums up what is there.
STUDY := OMP_NUM_THREADS=1 UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} MORE_PEOPLE=$${MORE_PEOPLE:-$(SHARED)/more-people} \
	$(BIN)/python -m benchmarks.studies
studies: $(VENV)/.test ## all studies, those that give most evidence first (about 4 h)
	$(STUDY) all $(ARGS)

study-bases: $(VENV)/.test ## train the bases of the studies (about 2 h and a quarter)
	$(STUDY) bases $(ARGS)

study-main: $(VENV)/.test ## the protocol of the paper and its peers, three seeds (about 90 min with its bases)
	$(STUDY) main $(ARGS)

study-everybody: $(VENV)/.test ## each of seven subjects, by each trial: is anybody worse off? (about 30 min)
	$(STUDY) everybody $(ARGS)

study-unseen: $(VENV)/.test ## fitted to half of the actions, tested on the others (about 15 min)
	$(STUDY) unseen $(ARGS)

study-growth: $(VENV)/.test ## one, two and three trials (about 10 min)
	$(STUDY) growth $(ARGS)

study-wild: $(VENV)/.test ## new people, new collections, against zero velocity (about 20 min)
	$(STUDY) wild $(ARGS)

study-seconds: $(VENV)/.test ## errors by the seconds that a fit may take; on an idle machine (about 25 min)
	$(STUDY) seconds $(ARGS)

study-ablation: $(VENV)/.test ## what each part of net, objective and data brings (about 55 min with its bases)
	$(STUDY) ablation $(ARGS)

docs: $(VENV)/.docs ## these pages as HTML in build/site, without anything from elsewhere (10 s)
	$(BIN)/python docs/site/build.py

figures: $(VENV)/.test ## draw docs/figures from the studies' rows and recordings (about 5 min the first time)
	UTD_MHAD=$${UTD_MHAD:-$(SHARED)/utd-mhad} $(BIN)/python -m benchmarks.figures $(ARGS)

picture: $(VENV)/.test ## draw docs/figures/demo.svg
	$(BIN)/python -m benchmarks.picture $(ARGS)

browser: $(VENV)/.test ## every button of the viewer in a real Chromium; screenshots in build/ (about 3 min)
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -m "browser or not browser" --timeout 300 tests/browser $(ARGS)

viewer-frames: $(VENV)/.test ## pictures per second of the viewer, drawn in software; on an idle machine (40 s)
	$(BIN)/python -m benchmarks.viewer_frames $(ARGS)

screenshots: $(VENV)/.test ## the pictures of the viewer in docs/figures (about 4 min)
	$(BIN)/python -m benchmarks.viewer_pictures $(ARGS)

clean: ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build *.egg-info
