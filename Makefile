# SPDX-License-Identifier: Apache-2.0
#
# make quickstart   install what is missing, run recipes/quickstart.yaml
# make test         install what is missing, run the tests but for the slow ones
# make test-all     install what is missing, run all tests, as .ci/run does
# make gpu-check    install what is missing, measure what needs a GPU
# make docs         install what is missing, build the documentation into build/site
# ARGS adds arguments: make quickstart ARGS="--seed=1", make test ARGS="tests/replay -x -n 0"

SHELL := /bin/bash
RUN ?= outputs/quickstart-$(shell date +%Y%m%d-%H%M%S)
ARGS ?=

define LIST_INSTALLED
from importlib.metadata import distributions
found = {f"{d.name}=={d.version.partition('+')[0]}" for d in distributions()}
print(*sorted(x for x in found if not x.startswith("accerl-lerobot==")), sep="\n")
endef
export LIST_INSTALLED

.DEFAULT_GOAL := help
.PHONY: help setup quickstart test test-all gpu-check docs check audit lint format-check types format

help:
	@echo "make quickstart  demonstrations, SFT, asynchronous RL and evaluation on one MetaWorld task"
	@echo "make test        the tests but for the slow ones: a few minutes"
	@echo "make test-all    all tests, as continuous integration runs them"
	@echo "make gpu-check   likelihood, speed, memory and a short run on this machine's GPU; JSON and a table"
	@echo "make docs        the documentation as a site in build/site; a broken link is an error"
	@echo "make check       lint, formatting and types"
	@echo "make audit       known vulnerabilities of what is installed; asks the Python package index"
	@echo "make format      rewrite the code as 'make check' wants it"
	@echo "make setup       only install: .venv, and OpenGL libraries where apt-get and root are at hand"

setup:
	@.ci/setup

quickstart: setup
	.venv/bin/accerl train --config_path=recipes/quickstart.yaml --output_dir=$(RUN) $(ARGS)
	.venv/bin/accerl report $(RUN)
	@echo
	@echo "Look at  $(RUN)/report.html         all of it on a page"
	@echo "         $(RUN)/success_curve.png   success over env steps"
	@echo "         $(RUN)/before_after.mp4    the policy before RL, and after"
	@echo "         $(RUN)/summary.json        the numbers"
	@echo "         $(RUN)/checkpoints/last/pretrained_model   the policy, a LeRobot checkpoint"
	@echo "TensorBoard: .venv/bin/tensorboard --logdir $(RUN)/tensorboard"

test: setup
	.venv/bin/python -m pytest -n 2 --dist loadfile -m "not slow" $(ARGS)

test-all: setup
	.venv/bin/python -m pytest -n 2 --dist loadfile $(ARGS)

gpu-check: setup
	.venv/bin/python -m benchmarks gpu $(ARGS)

docs: setup
	.venv/bin/python -m mkdocs build --strict

check: lint format-check types

lint: setup
	.venv/bin/ruff check .

format-check: setup
	.venv/bin/ruff format --check .

types: setup
	.venv/bin/mypy

# Not in .ci/run: it needs a service that not every machine can reach. --strict, or what the service does not know
# would count as audited; that includes everything where a mirror of the Python package index stands in for it.
audit: setup
	@mkdir -p build
	.venv/bin/python -c "$$LIST_INSTALLED" > build/installed.txt
	.venv/bin/pip-audit --strict --progress-spinner=off --no-deps --disable-pip -r build/installed.txt

format: setup
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .
