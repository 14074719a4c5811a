# `make help` lists what this can do.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup data preview test lint bench bench-gpu compare twins figures demo weights weights-check clean

PYTHON ?= python3
CLUSTER ?=
ARGS ?=
CATEGORIES ?=
VIEWS ?=
METHODS ?=
SEEDS ?= 1

VIEW ?= complete
SOURCE ?= procedural
ROOT ?=
OUT ?= data
WORKERS ?=
SEED ?= 0
PROTOCOL ?=
JOBS ?= logical
# Each takes a gigabyte.
most_jobs := 8

bin := .venv/bin
packages := .venv/.packages
cluster := .venv/.cluster

# Only `make setup` compiles torch-scatter and torch-cluster unless told not to (CLUSTER=0); the other targets take
# about 6 minutes less on a fresh machine and need neither, so they compile them only when told to (CLUSTER=1).
demo_options := -c configs/laptop.yaml -c configs/profiles/cpu.yaml -c configs/profiles/smoke.yaml -c configs/profiles/depth_camera.yaml \
  --data.root build/demo/data --trainer.default_root_dir build/demo/run
# A real laptop, which no training saw. Depth views of an upright camera are what a robot has, and what carries over to
# real objects best; predicted is one, open by 34 degrees. A twin needs complete clouds, in several states.
demo_object := --category laptop --source urdf --root tests/data/real_objects/laptop --train-instances 0 --test-instances 1
demo_shard = build/demo/data/laptop/$(1)/test/shard-00000.npz

needs := $(packages) $(if $(filter 1,$(CLUSTER)),$(cluster))

ifneq ($(filter data preview compare twins figures,$(MAKECMDGOALS)),)
ifndef CAT
$(error make $(filter data preview compare twins figures,$(MAKECMDGOALS)) needs a category, as in: make data CAT=laptop)
endif
endif

help: ## List these targets.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s%s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo 'Options go behind the target, as in: make data CAT=laptop VIEW=partial'

setup: $(packages) $(if $(filter 0,$(CLUSTER)),,$(cluster)) ## Make .venv; compile torch-scatter and torch-cluster (about 6 minutes, once) unless CLUSTER=0. [PYTHON=python3]

$(packages): pyproject.toml .ci/setup
	@PYTHON='$(PYTHON)' .ci/setup packages
	@touch $@

$(cluster): $(packages)
	@.ci/setup cluster
	@touch $@

data: $(needs) ## Generate a data set: CAT=laptop [VIEW SOURCE ROOT OUT WORKERS SEED PROTOCOL ARGS].
	$(bin)/python -m render.generate --category '$(CAT)' --view '$(VIEW)' --source '$(SOURCE)' --out '$(OUT)' --seed '$(SEED)' $(if $(ROOT),--root '$(ROOT)') $(if $(WORKERS),--workers '$(WORKERS)') $(if $(PROTOCOL),--protocol '$(PROTOCOL)') $(ARGS)

preview: $(needs) ## Draw a contact sheet of a category into build/preview: CAT=laptop [SOURCE ROOT SEED ARGS].
	$(bin)/python -m render.preview --category '$(CAT)' --source '$(SOURCE)' --seed '$(SEED)' $(if $(ROOT),--root '$(ROOT)') $(ARGS)

# A process per core, and one thread in each: small tensors gain nothing from more. Files stay whole, for their fixtures.
test: $(needs) ## Set up without compiling (CLUSTER=1 compiles), then run the tests. [JOBS=logical ARGS="options of pytest"]
	@.ci/setup browser
	OMP_NUM_THREADS=1 $(bin)/python -m pytest --numprocesses '$(JOBS)' --maxprocesses $(most_jobs) --dist loadfile $(ARGS)

lint: $(needs) ## Check style and formatting.
	$(bin)/ruff check .
	$(bin)/ruff format --check .

bench: $(needs) ## Measure speed and memory: prints a table, writes build/bench.json. [ARGS="--device cuda"]
	$(bin)/python -m articulate_ssl.benchmark $(ARGS)

bench-gpu: $(needs) ## Measure training and prediction at the paper's size on all GPUs of this machine. [ARGS="--json build/gpu.json"]
	$(bin)/python -m articulate_ssl.benchmark.paper_size $(ARGS)

compare: $(needs) ## Train and test every method on the same clouds, can be interrupted: CAT=laptop or all [VIEW SEEDS METHODS="npcs_epn staged" ROOT OUT=build/compare WORKERS=1 ARGS].
	$(bin)/python -m articulate_ssl.comparison --categories $(CAT) --view '$(VIEW)' --seeds '$(SEEDS)' $(if $(METHODS),--methods $(METHODS)) $(if $(ROOT),--root '$(ROOT)') $(if $(filter command,$(origin OUT)),--build '$(OUT)') $(if $(WORKERS),--workers '$(WORKERS)') $(ARGS)

twins: $(needs) ## Find single objects from scans of each, and score them by labels, can be interrupted: CAT=laptop [SOURCE ROOT OUT=build/twins SEED ARGS].
	$(bin)/python -m articulate_ssl.comparison.twins --category '$(CAT)' --source '$(SOURCE)' --seed '$(SEED)' $(if $(ROOT),--root '$(ROOT)') $(if $(filter command,$(origin OUT)),--out '$(OUT)') $(ARGS)

figures: $(needs) ## Draw accuracy against noise, and part-level features, into build/figures: CAT=laptop [VIEW=partial ROOT=data ARGS].
	$(bin)/python -m articulate_ssl.paper_figures --category '$(CAT)' --view '$(if $(filter partial,$(VIEW)),depth,complete)' $(if $(ROOT),--root '$(ROOT)') $(ARGS)

demo: $(needs) ## Set up without compiling, predict a real laptop, make its twin, train briefly: 10 min after the set-up.
	rm -rf build/demo
	$(bin)/python -m render.generate $(demo_object) --view partial --states 5 --views 1 --out build/demo/data
	$(bin)/python -m datamodules.scans $(call demo_shard,urdf-partial-honest) build/demo/views
	cp build/demo/views/shard-00000-0002.npy build/demo/scan.npy
	$(bin)/articulate-ssl predict build/demo/scan.npy --category laptop --view depth --html --check --out build/demo/prediction
	$(bin)/python -m render.generate $(demo_object) --states 12 --rotations 1 --out build/demo/data
	$(bin)/python -m datamodules.scans $(call demo_shard,urdf-complete) build/demo/scans
	$(bin)/articulate-ssl twin build/demo/scans/*.npy --parts 2 --joint revolute --html --out build/demo/twin
	$(bin)/python -m render.generate --category laptop --view partial --train-instances 24 --test-instances 4 --states 20 --views 2 --out build/demo/data
	$(bin)/lightning fit $(demo_options)
	$(bin)/lightning test $(demo_options)
	@echo 'A real laptop (tests/data/real_objects/laptop), by the weights of the package, and its twin of 12 scans:'
	@printf "  $$PWD/build/demo/%s\n" prediction/picture.png prediction/view.html twin/picture.png twin/view.html
	@echo 'Metrics of laptops that the short training never saw, and their picture:'
	@find "$$PWD/build/demo/run" -name metrics.json -o -name '*.png' | sed 's/^/  /'
	@echo 'A view.html opens in any browser, without a network. With a server: .venv/bin/articulate-ssl view build/demo/twin'

weights: $(needs) ## Make all shipped weights anew: 12 to 45 minutes each on a CPU, can be interrupted. [CATEGORIES="laptop oven" VIEWS="depth complete"]
	$(bin)/articulate-ssl weights rebuild $(if $(CATEGORIES),--categories $(CATEGORIES)) $(if $(VIEWS),--views $(VIEWS))

weights-check: $(needs) ## Test shipped weights on fresh data and compare with their cards. [CATEGORIES="laptop oven-depth" SEED=12]
	$(bin)/articulate-ssl weights check $(CATEGORIES) $(if $(filter-out 0,$(SEED)),--seed $(SEED))

clean: ## Remove build/, caches and the set-up; data/, runs/ and compiled wheels stay.
	rm -rf build .venv *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
