# `make help` lists what this can do.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup data preview test lint bench demo weights weights-check clean

PYTHON ?= python3
CLUSTER ?=
ARGS ?=
CATEGORIES ?=
VIEWS ?=

VIEW ?= complete
SOURCE ?= procedural
ROOT ?=
OUT ?= data
WORKERS ?=
SEED ?= 0
PROTOCOL ?=

bin := .venv/bin
packages := .venv/.packages
cluster := .venv/.cluster

# Only `make setup` compiles torch-scatter and torch-cluster unless told not to (CLUSTER=0); the other targets take
# about 6 minutes less on a fresh machine and need neither, so they compile them only when told to (CLUSTER=1).
demo_options := -c configs/laptop.yaml -c configs/profiles/cpu.yaml -c configs/profiles/smoke.yaml -c configs/profiles/depth_camera.yaml \
  --data.root build/demo/data --trainer.default_root_dir build/demo/run
# Depth views of an upright camera are what a robot has, and what carries over to real objects best. One view of the
# real laptop, half open, in the metres of its model.
demo_shard := build/demo/data/laptop/urdf-partial-honest/test/shard-00000.npz
demo_scan := import numpy as np; s = np.load("$(demo_shard)"); np.save("build/demo/scan.npy", s["points"][2] * s["scale"][2] + s["center"][2])

needs := $(packages) $(if $(filter 1,$(CLUSTER)),$(cluster))

ifneq ($(filter data preview,$(MAKECMDGOALS)),)
ifndef CAT
$(error make $(filter data preview,$(MAKECMDGOALS)) needs a category, as in: make data CAT=laptop)
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

test: $(needs) ## Set up without compiling (CLUSTER=1 compiles), then run the tests. [ARGS="options of pytest"]
	@.ci/setup browser
	$(bin)/python -m pytest $(ARGS)

lint: $(needs) ## Check style and formatting.
	$(bin)/ruff check .
	$(bin)/ruff format --check .

bench: $(needs) ## Measure speed and memory: prints a table, writes build/bench.json. [ARGS="--device cuda"]
	$(bin)/python -m articulate_ssl.benchmark $(ARGS)

demo: $(needs) ## Set up without compiling, make data, train briefly, test, predict on a real laptop: within 20 min of a clone.
	rm -rf build/demo
	$(bin)/python -m render.generate --category laptop --view partial --train-instances 24 --test-instances 4 --states 20 --views 2 --out build/demo/data
	$(bin)/lightning fit $(demo_options)
	$(bin)/lightning test $(demo_options)
	$(bin)/python -m render.generate --category laptop --source urdf --root tests/data/real_objects/laptop --view partial --train-instances 0 --test-instances 1 --states 5 --views 1 --out build/demo/data
	$(bin)/python -c '$(demo_scan)'
	$(bin)/lightning predict build/demo/scan.npy --ckpt "$$(find build/demo/run -name last.ckpt)" --out build/demo/prediction
	@echo 'Metrics of the laptops that training never saw, and their picture:'
	@find "$$PWD/build/demo/run" -name metrics.json -o -name '*.png' | sed 's/^/  /'
	@echo 'Picture of the real laptop (tests/data/real_objects/laptop):'
	@echo "  $$PWD/build/demo/prediction/picture.png"

weights: $(needs) ## Make all shipped weights anew: 12 minutes each on a CPU, can be interrupted. [CATEGORIES="laptop oven" VIEWS="depth complete"]
	$(bin)/articulate-ssl weights rebuild $(if $(CATEGORIES),--categories $(CATEGORIES)) $(if $(VIEWS),--views $(VIEWS))

weights-check: $(needs) ## Test shipped weights on fresh data and compare with their cards. [CATEGORIES="laptop oven-depth" SEED=12]
	$(bin)/articulate-ssl weights check $(CATEGORIES) $(if $(filter-out 0,$(SEED)),--seed $(SEED))

clean: ## Remove build/, caches and the set-up; data/, runs/ and compiled wheels stay.
	rm -rf build .venv *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
