# SPDX-License-Identifier: Apache-2.0
"""LIBERO's scripted experts: they solve their tasks."""

import re
from contextlib import closing
from pathlib import Path

import pytest

from accerl_lerobot.demos.libero_expert import PLANS, SKILLS, SUITES
from accerl_lerobot.demos.record import DemosConfig, disturbed, make_expert, played, record_demos
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.libero import LiberoConfig, bddl_file, suites
from accerl_lerobot.errors import InputError
from accerl_lerobot.seeds import eval_seed
from tests.envs.libero_assets import ASSETS, needs_assets

pytest.importorskip("libero", reason="LIBERO is not installed")


@needs_assets
@pytest.mark.parametrize(
    ("task", "seed"),
    [
        ("libero_object/1", 5),
        pytest.param("libero_spatial/7", 5, marks=pytest.mark.slow),
        pytest.param("libero_goal/3", eval_seed(0, 0), marks=pytest.mark.slow),
        pytest.param("libero_10/9", 5, marks=pytest.mark.slow),
    ],
)
def test_the_expert_solves_recorded_and_drawn_starts(task: str, seed: int):
    settings = LiberoConfig(task=task, assets=ASSETS, image_size=32, camera="agentview", rendering="fast")
    with closing(make_environment(settings)) as environment:
        expert = make_expert(settings, environment, task)
        actions = disturbed(expert, environment.spec, seed, noise=0.1, push=0, fail=False)
        assert played(environment, task, seed, actions).success


@pytest.mark.parametrize("suite", SUITES)
def test_plans_hold_the_goals_of_their_tasks_and_have_a_skill_for_every_step(suite: str):
    for task in suites()[suite]:
        goal = re.findall(r"\((\w+) ([\w ]+)\)", bddl_file(task).read_text().split("(:goal")[1])
        steps = [[verb.lower(), *names.split()] for verb, names in goal]
        plan = PLANS.get(task, steps)
        assert steps and all(step in plan for step in steps)
        assert all(step[0] in SKILLS or step[-1] in SKILLS for step in plan)


def test_a_task_without_an_expert_is_refused_before_any_work(tmp_path: Path):
    with pytest.raises(InputError, match="libero_object, libero_spatial, libero_goal, libero_10") as caught:
        record_demos(LiberoConfig(task="libero_90/0"), DemosConfig(), str(tmp_path / "demos"))
    assert caught.value.field == "env.task" and "\n" not in str(caught.value)
    assert not (tmp_path / "demos").exists()
