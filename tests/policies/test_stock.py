# SPDX-License-Identifier: Apache-2.0
"""Policies without a likelihood act as LeRobot's own loop has them act, and are not trained."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from accerl_lerobot import cli, evaluate, load_policy
from accerl_lerobot.algorithms import SelfImitationConfig, chunk_critic, off_policy
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request, stack_observations
from accerl_lerobot.policies.config import ChunkNoiseConfig, PolicyConfig, TuningConfig, override
from accerl_lerobot.policies.features import policy_features
from accerl_lerobot.policies.loading import load_acting, load_adapter
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.policies.stock import StockAdapter
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
from tests.policies.tiny_pi import small, write_pi
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


FRONT = "observation.images.front"
CAMERAS = {"vqbet": FRONT, "tdmpc": "observation.image", "act": FRONT}  # LeRobot's TD-MPC knows this one only


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


@pytest.mark.parametrize("write", [write_vla_jepa, write_fastwam, write_lingbot_va])
def test_what_is_trained_on_later_images_acts_as_in_lerobot_s_loop(
    write: Callable[..., Path], tmp_path: Path
):
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    path = write(tmp_path / "policy", image=64)
    with wan_hub(tmp_path / "wan"):
        adapter = load_acting(PolicyConfig(path=str(path), device="cpu"))
        stock = get_policy_class(PreTrainedConfig.from_pretrained(path).type).from_pretrained(path)
        with pytest.raises(InputError, match="LeRobot trains it on what follows a chunk"):
            learning(path)
    for episode in (1, 2):
        stock.reset()
        for request in steps_of(episode, 14):
            torch.manual_seed(request.noise_seed)
            batch = adapter.processing.prepare(*stack_observations([request]))
            expected = adapter.processing.postprocessor(stock.select_action(batch)).numpy()
            np.testing.assert_array_equal(adapter.decide([request], 0)[0].chunk, expected)
    if write is write_lingbot_va:
        ended, *_ = steps_of(3, 1)
        adapter.decide([ended], 0)
        with pytest.raises(InputError, match="it acts in one environment at a time; set rollout.workers=1"):
            adapter.decide([steps_of(2, 15)[-1]], 0)


def test_an_episode_that_is_run_again_begins_anew(written: Any):
    adapter = load_acting(config_of(written("vqbet"), "vqbet"))
    chunks = [adapter.decide([request], 0)[0].chunk for request in steps_of(5, 2)]
    again = adapter.decide(steps_of(5, 1), 0)[0].chunk
    np.testing.assert_array_equal(again, chunks[0])


def test_two_tasks_with_one_instruction_have_a_policy_object_each(written: Any):
    alone, beside = (load_acting(config_of(written("vqbet"), "vqbet")) for _ in range(2))
    mine, other = ([replace(request, task=task) for request in steps_of(5, 3)] for task in ("a", "b"))
    expected = [alone.decide([request], 0)[0].chunk for request in mine]
    found = [beside.decide(list(both), 0)[0].chunk for both in zip(mine, other, strict=True)]
    np.testing.assert_array_equal(found, expected)


def test_an_episode_whose_policy_object_is_lost_is_not_gone_on_with(written: Any):
    replaced = load_acting(config_of(written("vqbet"), "vqbet"))
    with pytest.raises(InputError, match="what it remembers of an episode is lost: its inference worker was"):
        replaced.decide(steps_of(5, 2)[1:], 0)


def test_in_python_it_is_evaluated_by_the_config_of_a_run_that_has_trained(written: Any):
    env = SimulatedConfig(image_size=64, max_steps=6)
    config = RunConfig(env=env, algorithm=SelfImitationConfig(), launch=LaunchConfig(engine="local"))
    assert evaluate(config, written("vqbet"), episodes=2).success.n == 2


def test_what_cannot_learn_is_evaluated_and_refused_in_one_line(written: Any, tmp_path: Path, capsys: Any):
    fields = ["--env.type=simulated", "--env.image_size=64", "--launch.engine=local"]
    renames = f"--policy.rename_map={json.dumps({FRONT: CAMERAS['tdmpc']})}"
    policies = {
        "tdmpc": [f"--policy.path={written('tdmpc')}", renames],
        "vqbet": [f"--policy.path={written('vqbet')}"],
        "act": [f"--policy.path={written('act')}"],
    }
    evaluation = ["--evaluation.episodes=2", f"--output_dir={tmp_path / 'eval'}"]
    assert cli.main(["eval", *fields, *policies["tdmpc"], *evaluation]) == 0
    found = json.loads((tmp_path / "eval" / "evaluation.json").read_text())
    assert found["n"] == 2 and found["steps_mean"] > 1
    train = [
        "train",
        *fields,
        "--sft.steps=0",
        "--rollout.segment_length=100",
        f"--output_dir={tmp_path / 'new'}",
    ]
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


def learning(path: Path, mode: Any = "checkpoint", **fields: Any) -> StockAdapter:
    """A policy of any type, loaded to learn."""
    sampler = ChunkNoiseConfig(**fields)
    tuning = TuningConfig(mode=mode)
    adapter = load_adapter(PolicyConfig(path=str(path), device="cpu", sampler=sampler, tuning=tuning))
    assert isinstance(adapter, StockAdapter)
    return adapter


@pytest.mark.parametrize("write", [write_act, write_diffusion])
def test_types_that_are_known_act_as_in_lerobot_s_loop(write: Callable[..., Path], tmp_path: Path):
    adapter = learning(write(tmp_path / "policy", image=32))
    (asked,) = requests(1, explore=False)
    chunk = adapter.decide([asked], 0)[0].chunk
    adapter.policy.reset()
    torch.manual_seed(asked.noise_seed)
    batch = adapter.processing.prepare(*stack_observations([asked]))
    with torch.no_grad():
        taken = [adapter.policy.select_action(dict(batch)) for _ in range(len(chunk))]
    expected = [adapter.processing.postprocessor(action).numpy()[0] for action in taken]
    np.testing.assert_allclose(chunk, np.stack(expected), atol=1e-5)


def test_smolvla_s_training_loss_is_ours(tmp_path: Path):
    path = write_smolvla(tmp_path / "smolvla")
    ours, stock = load_adapter(PolicyConfig(path=str(path), device="cpu")), learning(path)
    asked = requests(6, image=32)
    arrays, tasks = stack_observations(asked)
    chunk = torch.rand(6, 4, 2) - 0.5
    found = []
    for adapter in (ours, stock):
        torch.manual_seed(3)
        loss, _ = adapter.imitate(arrays, tasks, chunk)
        found.append(float(loss.mean().detach()))
    assert found[0] == pytest.approx(found[1], rel=1e-4)


def test_of_a_smolvla_with_noise_on_its_chunk_the_expert_alone_can_be_trained(tmp_path: Path):
    adapter = learning(write_smolvla(tmp_path / "smolvla"), mode="expert")
    trained = adapter.trainable()
    assert trained and not [name for name in trained if ".vlm_with_expert.vlm." in name]


def test_a_policy_that_looks_back_is_shown_what_lerobot_s_loop_would_show_it(written: Any):
    from lerobot.policies.factory import get_policy_class

    path, steps = written("vqbet"), steps_of(4, 9)
    adapter, stock = learning(path), get_policy_class("vqbet").from_pretrained(written("vqbet"))
    stock.reset()
    taken = []
    for request in steps:
        torch.manual_seed(steps[6].noise_seed)
        batch = adapter.processing.prepare(*stack_observations([request]))
        taken.append(adapter.processing.postprocessor(stock.select_action(batch)).numpy()[0])
    # The third chunk begins at step 6, and is predicted from steps 4 to 6.
    seen = [request.observation for request in steps[4:7]]
    observation = {k: v if k == "task" else np.stack([s[k] for s in seen]) for k, v in seen[0].items()}
    asked = Request(observation=observation, noise_seed=steps[6].noise_seed, explore=False)
    chunk = adapter.decide([asked], 0)[0].chunk
    np.testing.assert_allclose(chunk, np.stack(taken[6:9]), atol=1e-5)
    assert "predict_action_chunk" not in vars(adapter.policy)


def test_steps_and_rows_of_a_run_are_set_by_the_names_of_lerobot_s_config():
    from lerobot.policies.factory import make_policy_config

    config = make_policy_config("multi_task_dit", device="cpu", n_obs_steps=2, horizon=6, n_action_steps=3)
    override(config, PolicyConfig(num_steps=4, n_action_steps=5))
    assert (config.num_inference_steps, config.num_integration_steps, config.n_action_steps) == (4, 4, 5)
    with pytest.raises(InputError, match="policy.n_action_steps=6: multi_task_dit: at most 5 rows"):
        override(config, PolicyConfig(n_action_steps=6))


def test_images_of_any_size_fit_a_policy_that_resizes_them():
    from lerobot.policies.factory import make_policy_config

    fields: dict[str, Any] = {"device": "cpu", "image_crop_shape": None}
    assert not policy_features(make_policy_config("multi_task_dit", **fields)).any_size
    assert policy_features(
        make_policy_config("multi_task_dit", **fields, image_resize_shape=(64, 64))
    ).any_size


def test_exploring_is_the_chunk_and_noise_of_the_request(written: Any):
    adapter = learning(written("vqbet"), noise_level=0.1)
    asked = adapter.example_requests() * 2
    asked = [replace(request, noise_seed=i) for i, request in enumerate(asked)]
    plain = learning(written("vqbet"), noise_level=0.0).decide(asked, 0)
    noisy = adapter.decide(asked, 0)
    scale = 2.0  # of MIN_MAX over ±2, or twice the std
    noise = np.stack([n.chunk - p.chunk for n, p in zip(noisy, plain, strict=True)]) / scale
    assert 0.03 < noise.std() < 0.3 and not np.allclose(noise[0], noise[1])
    np.testing.assert_array_equal(noisy[2].chunk, adapter.decide(asked, 0)[2].chunk)


@pytest.fixture
def small_pi() -> Iterator[None]:
    with small():
        yield


def write_vqbet(folder: Path, image: int) -> Path:
    return write_policy(folder, "vqbet", image=image, **KINDS["vqbet"])


def write_pi0(folder: Path, image: int) -> Path:
    return write_pi(folder, "pi0")


def write_pi05(folder: Path, image: int) -> Path:
    return write_pi(folder, "pi05")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, bool], Path]:
    """Three demonstrations with images of a size, with or without the simulator's state."""

    @cache
    def record(size: int, states: bool) -> Path:
        env = SimulatedConfig(max_steps=12, image_size=size, environment_state=states)
        return Path(str(record_dataset(tmp_path_factory.mktemp("demos") / "data", env, episodes=3).root))

    return record


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
def test_any_policy_learns_and_is_saved_for_stock_lerobot(
    write: Callable[..., Path],
    algorithm: str,
    recorded: Callable[[int, bool], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    small_pi: None,
):
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    for package in NEEDED.get(write, ()):
        pytest.importorskip(package)
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 5)
    monkeypatch.setattr(off_policy, "POLICY_BATCH", 8)
    size = 64 if write in (write_vqbet, write_multi_task_dit, write_xvla) else 32
    policy, states, out = (
        write(tmp_path / "policy", image=size),
        algorithm == "chunk_critic",
        tmp_path / "run",
    )
    env = ["--env.type=simulated", "--env.max_steps=12", f"--env.image_size={size}"]
    env += [f"--env.environment_state={str(states).lower()}"]
    fields = [
        f"--policy.path={policy}", "--policy.device=cpu", "--sft.steps=0", "--launch.engine=local",
        "--policy.sampler.type=chunk_noise", f"--algorithm.type={algorithm}",
        "--dataset.repo_id=a/b", f"--dataset.root={recorded(size, states)}",
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


def test_in_python_an_episode_begins_with_reset(written: Any):
    policy = load_policy(written("vqbet"), device="cpu")
    asked = steps_of(5, 2)
    first, later = (request.observation for request in asked)
    assert policy.history == 1 and policy.act(first).shape == (1, 2)
    assert not np.array_equal(policy.act(later), policy.act(later)), "a chunk of three has three actions"
    policy.reset()
    fresh = load_acting(config_of(written("vqbet"), "vqbet"))
    (expected,) = fresh.decide([replace(asked[0], noise_seed=noise_seed(1, 0))], 0)
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


def test_a_package_that_a_type_needs_is_named(written: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from lerobot.utils import import_utils

    monkeypatch.setitem(import_utils._require_package_cache, "torchdiffeq", False)
    path = shutil.copytree(written("act"), tmp_path / "policy")
    config = json.loads((path / "config.json").read_text())
    named = {name: config[name] for name in ("input_features", "output_features")}
    (path / "config.json").write_text(json.dumps(named | {"type": "wall_x"}))
    with pytest.raises(
        InputError, match="a package that it needs is missing .ImportError: 'torchdiffeq' is"
    ) as caught:
        load_acting(PolicyConfig(path=str(path), device="cpu"))
    assert "\n" not in str(caught.value)


def test_a_backbone_s_weights_that_the_checkpoint_has_are_not_wanted(tmp_path: Path):
    path = write_eo1(tmp_path / "policy")
    (tmp_path / "policy-qwen" / "model.safetensors").unlink()
    adapter = load_acting(PolicyConfig(path=str(path), device="cpu"))
    assert adapter.policy.config.pretrained_path is None


def test_a_policy_that_learns_does_so_in_float32():
    from lerobot.policies.factory import make_policy_config

    config = make_policy_config("evo1", device="cpu")
    override(config, PolicyConfig())
    assert config.vlm_dtype == "bfloat16"
    override(config, PolicyConfig(), learns=True)
    assert config.vlm_dtype == "float32"


def test_a_policy_that_takes_no_batch_decides_one_by_one(
    written: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy

    stock = VQBeTPolicy.select_action

    def one_at_a_time(self: Any, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        if len(batch["observation.state"]) > 1:
            raise RuntimeError("one at a time, please")
        return stock(self, batch)

    monkeypatch.setattr(VQBeTPolicy, "select_action", one_at_a_time)
    adapter = learning(written("vqbet"))
    assert "vqbet policies decide for one environment at a time" in caplog.text
    assert len(adapter.decide(adapter.example_requests(), 0)) == 2


def test_a_policy_that_changes_while_it_acts_is_refused(written: Any, monkeypatch: pytest.MonkeyPatch):
    from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy

    stock, count = VQBeTPolicy.select_action, iter(range(10_000))
    monkeypatch.setattr(VQBeTPolicy, "select_action", lambda self, batch: stock(self, batch) + next(count))
    with pytest.raises(
        InputError, match="policy.type='vqbet': asked twice with the same noise, it gives two"
    ):
        learning(written("vqbet"))


def test_actions_that_lerobot_does_not_bring_back_are_refused(written: Any, monkeypatch: pytest.MonkeyPatch):
    """Such as a gripper that the postprocessor opens or closes whole."""
    stock = Processing.unnormalise

    def whole(self: Processing, chunk: torch.Tensor) -> torch.Tensor:
        actions = stock(self, chunk).clone()
        actions[..., -1] = torch.where(actions[..., -1] > 0, -1.0, 1.0)
        return actions

    monkeypatch.setattr(Processing, "unnormalise", whole)
    with pytest.raises(InputError, match="policy.type='vqbet': LeRobot's preprocessor does not undo"):
        learning(written("vqbet"))


def test_actions_of_which_none_varies_are_no_reason_to_refuse(written: Any, monkeypatch: pytest.MonkeyPatch):
    stock = Processing.unnormalise
    monkeypatch.setattr(Processing, "unnormalise", lambda self, chunk: 0 * stock(self, chunk) + 0.3)
    learning(written("vqbet"))
