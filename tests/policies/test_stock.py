# SPDX-License-Identifier: Apache-2.0
"""Policies of types without a likelihood act as LeRobot's own loop has them act, and are not trained."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from safetensors.torch import save_file

from accerl_lerobot import cli, load_policy
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request, stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_acting, load_adapter
from accerl_lerobot.seeds import noise_seed
from tests.policies.checkpoints import write_policy
from tests.policies.tiny import requests

KINDS: dict[str, dict[str, Any]] = {
    "vqbet": {
        "n_obs_steps": 3, "n_action_pred_token": 3, "action_chunk_size": 3, "use_group_norm": True,
        "pretrained_backbone_weights": None, "crop_shape": (56, 56), "spatial_softmax_num_keypoints": 4,
        "gpt_block_size": 60, "gpt_input_dim": 16, "gpt_output_dim": 16, "gpt_n_layer": 1, "gpt_n_head": 2,
        "gpt_hidden_dim": 16, "vqvae_n_embed": 4, "vqvae_embedding_dim": 8, "vqvae_enc_hidden_dim": 8,
    },
    "tdmpc": {
        "horizon": 3, "n_action_steps": 1, "use_mpc": True, "cem_iterations": 2, "n_gaussian_samples": 16,
        "n_pi_samples": 4, "n_elites": 4, "image_encoder_hidden_dim": 8, "state_encoder_hidden_dim": 16,
        "latent_dim": 8, "mlp_dim": 16, "q_ensemble_size": 2, "max_random_shift_ratio": 0.0,
    },
}  # fmt: skip


FRONT = "observation.images.front"
CAMERAS = {"vqbet": FRONT, "tdmpc": "observation.image"}  # LeRobot's TD-MPC knows this one only


def config_of(path: Path, kind: str) -> PolicyConfig:
    return PolicyConfig(
        path=str(path), device="cpu", rename_map={FRONT: CAMERAS[kind]} if kind == "tdmpc" else {}
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    made: dict[str, Path] = {}

    def write(kind: str) -> Path:
        if kind not in made:
            folder = tmp_path_factory.mktemp(kind) / "pretrained_model"
            made[kind] = write_policy(folder, kind, image=64, camera=CAMERAS[kind], **KINDS[kind])
        return made[kind]

    return write


def steps_of(episode: int, count: int) -> list[Request]:
    """One request for each env step of an episode; the task is the same at all of them."""
    asked = requests(count, explore=False, seed=episode, image=64)
    task = asked[0].observation["task"]
    seeds = [noise_seed(episode, step) for step in range(count)]
    return [
        replace(request, observation=request.observation | {"task": task}, noise_seed=seed)
        for request, seed in zip(asked, seeds, strict=True)
    ]


@pytest.mark.parametrize("kind", list(KINDS))
def test_it_acts_as_in_lerobot_s_loop_whatever_other_episodes_do(written: Any, kind: str):
    from lerobot.policies.factory import get_policy_class

    path = written(kind)
    adapter = load_acting(config_of(path, kind))
    stock = get_policy_class(kind).from_pretrained(path)
    episodes = [steps_of(episode, 5) for episode in (1, 2)]
    found = [adapter.decide(list(asked), 3) for asked in zip(*episodes, strict=True)]
    for which, asked in enumerate(episodes):
        stock.reset()
        for step, request in enumerate(asked):
            arrays, tasks = stack_observations([request])
            torch.manual_seed(request.noise_seed)
            action = stock.select_action(adapter.processing.prepare(arrays, tasks))
            expected = adapter.processing.postprocessor(action).numpy()
            decision = found[step][which]
            np.testing.assert_array_equal(decision.chunk, expected)
            assert decision.chunk.shape == (1, 2) and decision.version == 3 and not decision.log_prob.any()


@pytest.mark.parametrize("kind", ["vqbet", "tdmpc"])
def test_it_is_evaluated_and_not_trained(written: Any, kind: str, tmp_path: Path, capsys: Any):
    path = written(kind)
    fields = [f"--policy.path={path}", "--env.type=simulated", "--env.image_size=64", "--launch.engine=local"]
    fields += [f"--policy.rename_map={json.dumps({FRONT: CAMERAS[kind]})}"] if kind == "tdmpc" else []
    assert cli.main(["eval", *fields, "--evaluation.episodes=2", f"--output_dir={tmp_path / 'eval'}"]) == 0
    found = json.loads((tmp_path / "eval" / "evaluation.json").read_text())
    assert found["n"] == 2 and found["steps_mean"] > 1
    why = f"policy.type='{kind}': {path} is of this type: no likelihood for it here, so it can be evaluated"
    for verb in (["train", "--sft.steps=0"], ["offline", "--dataset.repo_id=a/b"]):
        more = [field for field in fields if verb[0] == "train" or "policy" in field]
        assert cli.main([*verb, *more, f"--output_dir={tmp_path / 'new'}"]) == 2
        assert why in capsys.readouterr().err


def test_it_does_not_explore_and_has_no_density(written: Any):
    config = config_of(written("tdmpc"), "tdmpc")
    adapter = load_acting(config)
    (asked,) = requests(1, image=64)
    for refused in (
        lambda: adapter.decide([asked], 0),
        lambda: adapter.values(*stack_observations([asked])),
        lambda: load_adapter(config),
    ):
        with pytest.raises(InputError, match="policy.type='tdmpc': .*no likelihood"):
            refused()


def test_in_python_an_episode_begins_with_reset(written: Any):
    policy = load_policy(written("vqbet"), device="cpu")
    asked = steps_of(5, 2)
    first, later = (request.observation for request in asked)
    assert policy.history == 1 and policy.act(first).shape == (1, 2)
    assert not np.array_equal(policy.act(later), policy.act(later)), "a chunk of three has three actions"
    policy.reset()
    fresh = load_acting(config_of(written("vqbet"), "vqbet"))
    (expected,) = fresh.decide([replace(asked[0], noise_seed=noise_seed(1, 1))], 0)
    np.testing.assert_array_equal(policy.act(first), expected.chunk)


def write_package(folder: Path, name: str, code: str) -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text(code)
    (folder / f"{name}-1.0.dist-info").mkdir()
    text = f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 1.0\n"
    (folder / f"{name}-1.0.dist-info" / "METADATA").write_text(text)


def test_a_type_that_is_missing_and_a_package_that_is_broken_are_two_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from accerl_lerobot.policies import config as policies

    monkeypatch.setattr(policies, "NOT_IMPORTED", {})
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "config.json").write_text('{"type": "theirs"}')
    save_file({"weight": torch.zeros(1)}, tmp_path / "policy" / "model.safetensors")
    config = PolicyConfig(path=str(tmp_path / "policy"), device="cpu")
    with pytest.raises(InputError, match="no such policy type here; install the package.*; there are act, "):
        load_acting(config)
    write_package(tmp_path / "site", "lerobot_policy_theirs", "import no_such_module_of_theirs")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    why = "lerobot_policy_theirs is installed and cannot be imported .ModuleNotFoundError: No module named"
    with pytest.raises(InputError, match=f"no such policy type here; {why}") as caught:
        load_acting(config)
    assert "\n" not in str(caught.value) and "lerobot_policy_theirs" not in sys.modules


HALF = """
from dataclasses import dataclass
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

@PreTrainedConfig.register_subclass("half")
@dataclass
class HalfConfig(ACTConfig):
    pass
"""


def test_a_package_that_registers_its_type_and_then_fails_is_told_by_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "config.json").write_text('{"type": "half"}')
    save_file({"weight": torch.zeros(1)}, tmp_path / "policy" / "model.safetensors")
    write_package(
        tmp_path / "site", "lerobot_policy_half", "from . import config\nimport no_such_module_of_theirs"
    )
    (tmp_path / "site" / "lerobot_policy_half" / "config.py").write_text(HALF)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    why = "lerobot_policy_half is installed and cannot be imported .ModuleNotFoundError: No module named"
    try:
        with pytest.raises(InputError, match=f"policy.type='half': .*{why} 'no_such_module_of_theirs'"):
            load_acting(PolicyConfig(path=str(tmp_path / "policy"), device="cpu"))
    finally:
        PreTrainedConfig.get_known_choices().pop("half", None)
