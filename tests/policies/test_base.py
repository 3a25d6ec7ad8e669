# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Policy and world are compared before anything starts; observations are batched as they came."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.base import check_fit, stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_lerobot_config
from tests.conftest import write_smolvla
from tests.policies.tiny import requests


@pytest.fixture(scope="module")
def spec() -> WorldSpec:
    world = make_world(SimulatedConfig())
    world.close()
    return world.spec


@pytest.fixture
def config(tiny_checkpoint: Path) -> Any:
    return load_lerobot_config(PolicyConfig(path=str(tiny_checkpoint)))


def test_what_fits(config: Any, spec: WorldSpec):
    check_fit(config, spec, {})
    check_fit(config, spec, {"observation.state": "observation.state"})


def test_a_camera_the_world_does_not_have(config: Any, spec: WorldSpec):
    front = config.input_features.pop("observation.images.front")
    config.input_features["observation.images.top"] = front
    with pytest.raises(InputError) as caught:
        check_fit(config, spec, {})
    assert str(caught.value).startswith(
        "policy.path='observation.images.top': the policy wants this camera but the world offers "
        "observation.images.front; "
    )
    check_fit(config, spec, {"observation.images.front": "observation.images.top"})
    config.input_features["observation.images.empty_camera_0"] = front
    check_fit(config, spec, {"observation.images.front": "observation.images.top"})


def test_an_observation_that_no_world_makes(config: Any, spec: WorldSpec):
    from lerobot.configs.types import FeatureType, PolicyFeature

    privileged = PolicyFeature(type=FeatureType.ENV, shape=(6,))
    config.input_features["observation.environment_state"] = privileged
    with pytest.raises(InputError, match="^policy.path='observation.environment_state': the policy reads it"):
        check_fit(config, spec, {})


def test_a_rename_of_nothing(config: Any, spec: WorldSpec):
    with pytest.raises(InputError) as caught:
        check_fit(config, spec, {"observation.images.frnt": "observation.images.front"})
    assert str(caught.value) == (
        "policy.rename_map='observation.images.frnt': the world has no such feature; it offers "
        "observation.images.front, observation.state"
    )


@pytest.mark.parametrize(
    ("sizes", "sentence"),
    [
        ({"state_dim": 3}, r"policy.path=\(3,\): the policy's observation.state .* the world's \(4,\)"),
        ({"action_dim": 1}, r"policy.path=\(1,\): the policy's action .* the world's \(2,\)"),
    ],
)
def test_other_sizes(tmp_path: Path, spec: WorldSpec, sizes: dict, sentence: str):
    path = write_smolvla(tmp_path / "policy", **sizes)
    with pytest.raises(InputError, match=f"^{sentence}"):
        check_fit(load_lerobot_config(PolicyConfig(path=str(path))), spec, {})


def test_observations_are_stacked_in_the_order_of_the_requests():
    asked = requests(3)
    arrays, tasks = stack_observations(asked)
    assert tasks == [r.observation["task"] for r in asked] and "task" not in arrays
    for key, array in arrays.items():
        assert all(np.array_equal(array[i], r.observation[key]) for i, r in enumerate(asked))
        assert array.dtype == asked[0].observation[key].dtype
