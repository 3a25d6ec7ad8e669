# SPDX-License-Identifier: Apache-2.0
"""Policies without a likelihood act as LeRobot's own loop has them act, and are not trained."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy
from lerobot.utils import import_utils
from safetensors.torch import save_file

from accerl_lerobot import cli, evaluate, load_policy
from accerl_lerobot.algorithms import SelfImitationConfig, chunk_critic, off_policy
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.update import make_update
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request, stack_observations
from accerl_lerobot.policies import config as policies
from accerl_lerobot.policies.config import ChunkNoiseConfig, PolicyConfig, TuningConfig, override
from accerl_lerobot.policies.features import policy_features
from accerl_lerobot.policies.loading import load_acting, load_adapter
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.seeds import noise_seed
from tests.policies.checkpoints import (
    write_act,
    write_diffusion,
    write_multi_task_dit,
    write_policy,
    write_smolvla,
    write_xvla,
)
from tests.policies.tiny import requests
from tests.policies.tiny_pi import write_pi
from tests.policies.tiny_vlms import (
    wan_hub,
    write_eo1,
    write_evo1,
    write_fastwam,
    write_groot,
    write_lingbot_va,
    write_molmoact2,
    write_vla_jepa,
    write_wall_x,
)
from tests.tiny_datasets import record_dataset

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
    "act": {
        "temporal_ensemble_coeff": 0.1, "chunk_size": 4, "n_action_steps": 1, "dim_model": 16, "n_heads": 2,
        "dim_feedforward": 16, "latent_dim": 4, "n_encoder_layers": 1, "n_vae_encoder_layers": 1,
        "pretrained_backbone_weights": None,
    },
}  # fmt: skip
"""Policies that have no likelihood; the last one is of a type that has one otherwise."""


FRONT, OF_TDMPC = "observation.images.front", "observation.image"  # LeRobot's TD-MPC knows its camera only


def finish_codebook(policy: Any) -> None:
    codebook = policy.vqbet.action_head.vqvae_model
    codebook.discretized.fill_(True)
    codebook.vq_layer.freeze_codebook.fill_(True)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    @cache
    def write(kind: str) -> Path:
        folder, camera = tmp_path_factory.mktemp(kind) / "policy", OF_TDMPC if kind == "tdmpc" else FRONT
        prepare = finish_codebook if kind == "vqbet" else lambda policy: None
        return write_policy(folder, kind, image=64, camera=camera, prepare=prepare, **KINDS[kind])

    return write


@pytest.fixture
def vqbet(written: Callable[[str], Path]) -> Path:
    return written("vqbet")


def acting(path: Path, **options: Any) -> Any:
    return load_acting(PolicyConfig(path=str(path), device="cpu", **options))


def steps_of(episode: int, count: int) -> list[Request]:
    """One request for each env step of an episode; the task is the same at all of them."""
    asked = []
    for step, request in enumerate(requests(count, explore=False, seed=episode, image=64)):
        observation = request.observation | {"task": "Go"}
        asked.append(replace(request, observation=observation, noise_seed=noise_seed(episode, step)))
    return asked


def stock_step(stock: Any, adapter: Any, request: Request) -> np.ndarray:
    """One call of LeRobot's, with the noise of the request."""
    torch.manual_seed(request.noise_seed)
    action = stock.select_action(adapter.processing.prepare(*stack_observations([request])))
    return adapter.processing.postprocessor(action).numpy()


@pytest.mark.parametrize("kind", list(KINDS))
def test_it_acts_as_in_lerobot_s_loop_whatever_other_episodes_do(written: Any, kind: str):
    path = written(kind)
    adapter = acting(path, rename_map={FRONT: OF_TDMPC} if kind == "tdmpc" else {})
    stock = get_policy_class(kind).from_pretrained(path)
    episodes = [steps_of(episode, 5) for episode in (1, 2)]
    found = [adapter.decide(list(asked), 3) for asked in zip(*episodes, strict=True)]
    for which, asked in enumerate(episodes):
        stock.reset()
        for step, request in enumerate(asked):
            decision = found[step][which]
            np.testing.assert_array_equal(decision.chunk, stock_step(stock, adapter, request))
            assert decision.chunk.shape == (1, 2) and decision.version == 3 and not decision.log_prob.any()


@pytest.mark.parametrize("write", [write_vla_jepa, write_fastwam, write_lingbot_va])
def test_what_is_trained_on_later_images_acts_as_in_lerobot_s_loop(write: Any, tmp_path: Path):
    path = write(tmp_path / "policy", image=64)
    with wan_hub(tmp_path / "wan"):
        adapter = acting(path)
        stock = get_policy_class(PreTrainedConfig.from_pretrained(path).type).from_pretrained(path)
        with pytest.raises(InputError, match="LeRobot trains it on what follows a chunk"):
            learning(path)
    for episode in (1, 2):
        stock.reset()
        for request in steps_of(episode, 14):
            expected = stock_step(stock, adapter, request)
            np.testing.assert_array_equal(adapter.decide([request], 0)[0].chunk, expected)
    if write is write_lingbot_va:
        adapter.decide(steps_of(3, 1), 0)
        with pytest.raises(InputError, match="it acts in one environment at a time; set rollout.workers=1"):
            adapter.decide([steps_of(2, 15)[-1]], 0)


def test_an_episode_begins_anew_and_is_not_gone_on_with_where_its_policy_object_is_lost(vqbet: Path):
    adapter, steps = acting(vqbet), steps_of(5, 2)
    with pytest.raises(InputError, match="what it remembers of an episode is lost: its inference worker was"):
        adapter.decide(steps[1:], 0)
    first, _, again = (adapter.decide([request], 0)[0].chunk for request in (*steps, steps[0]))
    np.testing.assert_array_equal(again, first)


def test_two_tasks_with_one_instruction_have_a_policy_object_each(vqbet: Path):
    alone, beside = acting(vqbet), acting(vqbet)
    mine, other = ([replace(request, task=task) for request in steps_of(5, 3)] for task in ("a", "b"))
    expected = [alone.decide([request], 0)[0].chunk for request in mine]
    found = [beside.decide(list(both), 0)[0].chunk for both in zip(mine, other, strict=True)]
    np.testing.assert_array_equal(found, expected)


def test_in_python_it_is_evaluated_by_the_config_of_a_run_that_has_trained(vqbet: Path):
    env = SimulatedConfig(image_size=64, max_steps=6)
    config = RunConfig(env=env, algorithm=SelfImitationConfig(), launch=LaunchConfig(engine="local"))
    assert evaluate(config, vqbet, episodes=2).success.n == 2


def test_what_cannot_learn_is_evaluated_and_refused_in_one_line(written: Any, tmp_path: Path, capsys: Any):
    fields = ["--env.type=simulated", "--env.image_size=64", "--launch.engine=local"]
    policies = {kind: [f"--policy.path={written(kind)}"] for kind in KINDS}
    policies["tdmpc"] += [f"--policy.rename_map={json.dumps({FRONT: OF_TDMPC})}"]
    evaluation = ["--evaluation.episodes=2", f"--output_dir={tmp_path / 'eval'}"]
    assert cli.main(["eval", *fields, *policies["tdmpc"], *evaluation]) == 0
    found = json.loads((tmp_path / "eval" / "evaluation.json").read_text())
    assert found["n"] == 2 and found["steps_mean"] > 1
    train = ["train", *fields, "--sft.steps=0", "--rollout.segment_length=100"]
    train += [f"--output_dir={tmp_path / 'new'}"]
    for kind, algorithm, why in (
        ("tdmpc", "gipo", "LeRobot trains it on what follows a chunk"),
        ("vqbet", "gipo", "algorithm.type=gipo needs exact likelihoods, which smolvla, act, .* have here"),
        ("act", "gipo", ".*averaging over earlier chunks"),
        ("act", "awr", ".*averaging over earlier chunks"),
        ("vqbet", "awr", "awr's critic reads the policy's features, which are not known; use chunk_critic"),
    ):
        assert cli.main([*train, *policies[kind], f"--algorithm.type={algorithm}"]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        field = "policy.temporal_ensemble_coeff=0.1" if kind == "act" else f"policy.type='{kind}'"
        assert re.search(f"{field}: {why}", error), error
    assert not (tmp_path / "new").exists()


def learning(path: Path, mode: Any = "checkpoint", **fields: Any) -> Any:
    """A policy of any type, loaded to learn."""
    sampler, tuning = ChunkNoiseConfig(**fields), TuningConfig(mode=mode)
    return load_adapter(PolicyConfig(path=str(path), device="cpu", sampler=sampler, tuning=tuning))


@pytest.mark.parametrize("write", [write_act, write_diffusion])
def test_types_that_are_known_act_as_in_lerobot_s_loop(write: Any, tmp_path: Path):
    adapter = learning(write(tmp_path / "policy", image=32))
    (asked,) = requests(1, explore=False)
    chunk = adapter.decide([asked], 0)[0].chunk
    adapter.policy.reset()
    expected = [stock_step(adapter.policy, adapter, asked)[0] for _ in chunk]
    np.testing.assert_allclose(chunk, np.stack(expected), atol=1e-5)


def test_smolvla_s_training_loss_is_ours_and_its_expert_alone_can_be_trained(tmp_path: Path):
    path, chunk, found = write_smolvla(tmp_path / "smolvla"), torch.rand(6, 4, 2) - 0.5, []
    for adapter in (acting(path), learning(path)):
        torch.manual_seed(3)
        loss, _ = adapter.imitate(*stack_observations(requests(6)), chunk)
        found.append(float(loss.mean().detach()))
    assert found[0] == pytest.approx(found[1], rel=1e-4)
    trained = learning(path, mode="expert").trainable()
    assert trained and not [name for name in trained if ".vlm_with_expert.vlm." in name]


def test_a_policy_that_looks_back_is_shown_what_lerobot_s_loop_would_show_it(vqbet: Path):
    steps = [replace(request, noise_seed=6) for request in steps_of(4, 9)]
    adapter, stock = learning(vqbet), VQBeTPolicy.from_pretrained(vqbet)
    stock.reset()
    taken = [stock_step(stock, adapter, request)[0] for request in steps]
    # The third chunk begins at step 6, and is predicted from steps 4 to 6.
    seen = [request.observation for request in steps[4:7]]
    observation = {k: v if k == "task" else np.stack([s[k] for s in seen]) for k, v in seen[0].items()}
    chunk = adapter.decide([replace(steps[6], observation=observation)], 0)[0].chunk
    np.testing.assert_allclose(chunk, np.stack(taken[6:9]), atol=1e-5)


def test_steps_and_rows_of_a_run_are_set_by_the_names_of_lerobot_s_config():
    config = make_policy_config("multi_task_dit", device="cpu", n_obs_steps=2, horizon=6, n_action_steps=3)
    override(config, PolicyConfig(num_steps=4, n_action_steps=5))
    assert (config.num_inference_steps, config.num_integration_steps, config.n_action_steps) == (4, 4, 5)
    with pytest.raises(InputError, match="policy.n_action_steps=6: multi_task_dit: at most 5 rows"):
        override(config, PolicyConfig(n_action_steps=6))


def test_images_of_any_size_fit_a_policy_that_resizes_them():
    for shape in (None, (64, 64)):
        fields = {"device": "cpu", "image_crop_shape": None, "image_resize_shape": shape}
        assert policy_features(make_policy_config("multi_task_dit", **fields)).any_size == bool(shape)


def test_exploring_is_the_chunk_and_noise_of_the_request(vqbet: Path):
    adapter = learning(vqbet, noise_level=0.1)
    asked = [replace(request, noise_seed=i) for i, request in enumerate(adapter.example_requests() * 2)]
    plain = learning(vqbet, noise_level=0.0).decide(asked, 0)
    noisy = adapter.decide(asked, 0)
    scale = 2.0  # of MIN_MAX over ±2, or twice the std
    noise = np.stack([n.chunk - p.chunk for n, p in zip(noisy, plain, strict=True)]) / scale
    assert 0.03 < noise.std() < 0.3 and not np.allclose(noise[0], noise[1])
    np.testing.assert_array_equal(noisy[2].chunk, adapter.decide(asked, 0)[2].chunk)


write_vqbet = partial(write_policy, kind="vqbet", prepare=finish_codebook, **KINDS["vqbet"])
write_pi0, write_pi05 = partial(write_pi, kind="pi0"), partial(write_pi, kind="pi05")
NEEDED = {write_wall_x: ("torchdiffeq", "qwen_vl_utils"), write_groot: ("tree",)}
"""Packages that some of LeRobot's policies need and that this package does not."""


@pytest.mark.parametrize(
    ("write", "algorithm"),
    [
        (write_vqbet, "chunk_critic"),
        (write_multi_task_dit, "self_imitation"),
        *(
            pytest.param(write, algorithm, marks=pytest.mark.slow)
            for write, algorithm in (
                (write_vqbet, "self_imitation"), (write_xvla, "chunk_critic"), (write_act, "self_imitation"),
                (write_diffusion, "chunk_critic"), (write_smolvla, "self_imitation"),
                (write_pi0, "chunk_critic"), (write_pi05, "self_imitation"), (write_eo1, "chunk_critic"),
                (write_evo1, "self_imitation"), (write_molmoact2, "self_imitation"),
                (write_wall_x, "self_imitation"), (write_groot, "chunk_critic"),
            )
        ),
    ],
)  # fmt: skip
def test_any_policy_learns_and_lerobot_loads_it(write: Any, algorithm: str, tmp_path: Path, monkeypatch: Any):
    for package in NEEDED.get(write, ()):
        pytest.importorskip(package)
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 5)
    monkeypatch.setattr(off_policy, "POLICY_BATCH", 8)
    size = 64 if write in (write_vqbet, write_multi_task_dit, write_xvla) else 32
    policy, out = write(tmp_path / "policy", image=size), tmp_path / "run"
    states = algorithm == "chunk_critic"
    simulated = SimulatedConfig(max_steps=12, image_size=size, environment_state=states)
    record_dataset(tmp_path / "data", simulated, episodes=3)
    env = ["--env.type=simulated", "--env.max_steps=12", f"--env.image_size={size}"]
    env += [f"--env.environment_state={str(states).lower()}"]
    fields = [
        f"--policy.path={policy}", "--policy.device=cpu", "--sft.steps=0", "--launch.engine=local",
        "--policy.sampler.type=chunk_noise", f"--algorithm.type={algorithm}",
        "--dataset.repo_id=a/b", f"--dataset.root={tmp_path / 'data'}",
        "--algorithm.policy_steps=0.5", "--rollout.environments=2", "--rollout.segment_length=6",
        "--trainer.updates=3", "--trainer.batch_decisions=8", "--trainer.value_warmup_updates=1",
        "--replay.min_decisions=8", "--replay.max_unlearned_decisions=16", "--replay.samples_per_insert=1",
        "--replay.max_lag=100", "--evaluation.before=false", "--evaluation.episodes=2",
        "--evaluation.videos=0", f"--output_dir={out}",
    ]  # fmt: skip
    assert cli.main(["train", *env, *fields]) == 0
    saved = out / "checkpoints" / "last" / "pretrained_model"
    kind = get_policy_class(PreTrainedConfig.from_pretrained(saved).type)
    before, after = (kind.from_pretrained(path).state_dict() for path in (policy, saved))
    changed = [name for name, tensor in before.items() if not torch.equal(tensor, after[name])]
    assert changed and all(bool(torch.isfinite(tensor).all()) for tensor in after.values())
    evaluation = ["--evaluation.episodes=2", "--launch.engine=local", f"--output_dir={tmp_path / 'eval'}"]
    assert cli.main(["eval", *env, *evaluation, f"--policy.path={saved}", "--policy.device=cpu"]) == 0


def test_in_python_an_episode_begins_with_reset(vqbet: Path):
    policy = load_policy(vqbet, device="cpu")
    asked = steps_of(5, 2)
    first, later = (request.observation for request in asked)
    assert policy.history == 1 and policy.act(first).shape == (1, 2)
    assert not np.array_equal(policy.act(later), policy.act(later)), "a chunk of three has three actions"
    policy.reset()
    (expected,) = acting(vqbet).decide([replace(asked[0], noise_seed=noise_seed(1, 0))], 0)
    np.testing.assert_array_equal(policy.act(first), expected.chunk)


def test_a_policy_that_does_not_look_at_its_images_is_warned_of(
    vqbet: Path, caplog: pytest.LogCaptureFixture
):
    config = PolicyConfig(path=str(vqbet), device="cpu", sampler=ChunkNoiseConfig())
    algorithm, trainer = SelfImitationConfig(), TrainerConfig()
    adapter: Any = load_adapter(config)
    make_update(adapter, algorithm, trainer)
    assert adapter.sees() and not caplog.records
    with torch.no_grad():  # as a rectifier that is never active
        adapter.policy.vqbet.rgb_encoder.out.weight.zero_()
    make_update(adapter, algorithm, trainer)
    assert "acts the same whatever its images show" in caplog.text


REGISTERS = """
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

@PreTrainedConfig.register_subclass("theirs")
class TheirConfig(ACTConfig):
    pass
"""


@pytest.mark.parametrize(
    ("before", "said"), [("", "no such policy type here; "), (REGISTERS, "of this type: ")]
)
def test_a_type_that_is_missing_and_a_package_that_is_broken_are_two_lines(
    before: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(policies, "NOT_IMPORTED", {})
    monkeypatch.setattr(PreTrainedConfig, "_choice_registry", dict(PreTrainedConfig.get_known_choices()))
    (tmp_path / "config.json").write_text('{"type": "theirs"}')
    save_file({"weight": torch.zeros(1)}, tmp_path / "model.safetensors")
    with pytest.raises(InputError, match="no such policy type here; install the package.*; there are act, "):
        acting(tmp_path)
    name, info = "lerobot_policy_theirs", tmp_path / "lerobot_policy_theirs-1.0.dist-info"
    (tmp_path / f"{name}.py").write_text(f"{before}\nimport no_such_module_of_theirs")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot-policy-theirs\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    why = f"{name} is installed and cannot be imported .ModuleNotFoundError: No module named"
    with pytest.raises(InputError, match=f"{said}{why}") as caught:
        acting(tmp_path)
    assert "\n" not in str(caught.value) and name not in sys.modules


def test_a_package_that_a_type_needs_is_named(vqbet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(import_utils._require_package_cache, "torchdiffeq", False)
    path = shutil.copytree(vqbet, tmp_path / "policy")
    config = json.loads((path / "config.json").read_text())
    named = {name: config[name] for name in ("input_features", "output_features")}
    (path / "config.json").write_text(json.dumps(named | {"type": "wall_x"}))
    why = "a package that it needs is missing .ImportError: 'torchdiffeq' is"
    with pytest.raises(InputError, match=why) as caught:
        acting(path)
    assert "\n" not in str(caught.value)


def test_a_backbone_s_weights_that_the_checkpoint_has_are_not_wanted(tmp_path: Path):
    path = write_eo1(tmp_path / "policy")
    (tmp_path / "policy-qwen" / "model.safetensors").unlink()
    assert acting(path).policy.config.pretrained_path is None


def test_a_policy_that_learns_does_so_in_float32():
    config = make_policy_config("evo1", device="cpu")
    override(config, PolicyConfig())
    assert config.vlm_dtype == "bfloat16"
    override(config, PolicyConfig(), learns=True)
    assert config.vlm_dtype == "float32"


def test_a_policy_that_takes_no_batch_decides_one_by_one(vqbet: Path, monkeypatch: Any, caplog: Any):
    stock = VQBeTPolicy.select_action

    def one_at_a_time(self: Any, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        if len(batch["observation.state"]) > 1:
            raise RuntimeError("one at a time, please")
        return stock(self, batch)

    monkeypatch.setattr(VQBeTPolicy, "select_action", one_at_a_time)
    adapter = learning(vqbet)
    assert "vqbet policies decide for one environment at a time" in caplog.text
    assert len(adapter.decide(adapter.example_requests(), 0)) == 2


def test_what_would_not_be_learned_is_refused(tmp_path: Path):
    path = write_policy(tmp_path / "act", "act", image=64, **KINDS["act"])
    with pytest.raises(
        InputError, match="^policy.temporal_ensemble_coeff=0.1: actions averaged over earlier"
    ):
        learning(path)
    unfinished = write_policy(tmp_path / "vqbet", "vqbet", image=64, **KINDS["vqbet"])
    with pytest.raises(InputError, match="^policy.type='vqbet': its training moves vqbet.action_head.vqvae"):
        learning(unfinished)


def test_a_policy_that_changes_while_it_acts_is_refused(vqbet: Path, monkeypatch: pytest.MonkeyPatch):
    stock, count = VQBeTPolicy.select_action, iter(range(10_000))
    monkeypatch.setattr(VQBeTPolicy, "select_action", lambda self, batch: stock(self, batch) + next(count))
    with pytest.raises(InputError, match="^policy.type='vqbet': asked twice with the same noise, it"):
        learning(vqbet)


def test_actions_that_lerobot_does_not_bring_back_are_refused(vqbet: Path, monkeypatch: pytest.MonkeyPatch):
    """Such as a gripper that the postprocessor opens or closes whole; those that never vary are none."""
    stock = Processing.unnormalise
    monkeypatch.setattr(Processing, "unnormalise", lambda self, chunk: 0 * stock(self, chunk) + 0.3)
    learning(vqbet)
    monkeypatch.setattr(Processing, "unnormalise", lambda self, chunk: 2 * stock(self, chunk).sign())
    with pytest.raises(InputError, match="policy.type='vqbet': LeRobot's preprocessor does not undo"):
        learning(vqbet)
