# Copyright 2026 The accerl-lerobot authors. SPDX-License-Identifier: Apache-2.0
#
# make quickstart   install what is missing, run recipes/quickstart.yaml
# make test         install what is missing, run the tests
# ARGS adds arguments: make quickstart ARGS="--seed=1", make test ARGS="tests/replay -x"

SHELL := /bin/bash
RUN ?= outputs/quickstart-$(shell date +%Y%m%d-%H%M%S)
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup quickstart test check lint format-check types format

help:
	@echo "make quickstart  demonstrations, SFT, asynchronous RL and evaluation on one MetaWorld task"
	@echo "make test        the tests"
	@echo "make check       lint, formatting and types"
	@echo "make format      rewrite the code as 'make check' wants it"
	@echo "make setup       only install: .venv, and OpenGL libraries where apt-get and root are at hand"

setup:
	@.ci/setup

quickstart: setup
	.venv/bin/accerl train --config_path=recipes/quickstart.yaml --output_dir=$(RUN) $(ARGS)
	@echo
	@echo "Look at  $(RUN)/success_curve.png   success over env steps"
	@echo "         $(RUN)/before_after.mp4    the policy before RL, and after"
	@echo "         $(RUN)/summary.json        the numbers"
	@echo "         $(RUN)/checkpoints/last/pretrained_model   the policy, a LeRobot checkpoint"
	@echo "TensorBoard: .venv/bin/tensorboard --logdir $(RUN)/tensorboard"

test: setup
	@.ci/browser
	.venv/bin/python -m pytest $(ARGS)

check: lint format-check types

lint: setup
	.venv/bin/ruff check .

format-check: setup
	.venv/bin/ruff format --check .

types: setup
	.venv/bin/mypy

format: setup
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .
