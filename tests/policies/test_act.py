# SPDX-License-Identifier: Apache-2.0
"""ACT, in numbers: the stock chunk is the mean, and everything around it is exact."""

from __future__ import annotations

import json
import math
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.gaussian import StdHead
from accerl_lerobot.policies.loading import load_adapter, save_pretrained
from accerl_lerobot.policies.samplers import FlowSamplerConfig, GaussianSamplerConfig
from accerl_lerobot.replay import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.checkpoints import edit_config, stock_chunk, write_act
from tests.policies.contract import PolicyContract
from tests.policies.tiny import adapter_at, log_ratio, perturb, requests, stored
from tests.rounding import assert_close
from tests.runs import drive
from tests.test_local import learning_run, success, updates


class TestContract(PolicyContract):
    # An 18-layer ResNet rounds the chunk by up to 1e-6 from batch to batch, and log ρ by that over the std.
    samplers = [GaussianSamplerConfig(std=0.5, std_max=1.0), GaussianSamplerConfig(std=0.5, learn_std=False)]
    parts = ("model.backbone", "model.encoder.", "model.decoder.", "action_head")

    @staticmethod
    def write(directory: Path) -> Path:
        return write_act(directory)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_act(tmp_path_factory.mktemp("act") / "pretrained_model")


@pytest.fixture
def adapter(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


def ask(count: int, **options: bool) -> list:
    return requests(count, image=16, **options)


def test_not_exploring_is_lerobot_s_chunk(adapter: LeRobotAdapter):
    asked = ask(6, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    batch = adapter.processing.prepare(observations, tasks)
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch))
    chunks = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert np.array_equal(chunks, stock[:, :3].numpy())
    queued = [adapter.processing.unnormalise(adapter.policy.select_action(batch)) for _ in range(3)]
    assert np.array_equal(chunks, torch.stack(queued, 1).numpy()), "what lerobot-eval executes"
    noisy = np.stack([d.chunk for d in adapter.decide(ask(6), 0)])
    assert np.abs(noisy - chunks).max() > 1e-2


def test_a_saved_checkpoint_is_stock_lerobot_s(adapter: LeRobotAdapter, path: Path, tmp_path: Path):
    perturb(adapter, 0.1)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu"))
    asked = ask(1, explore=False)
    chunk = adapter.decide(asked, 0)[0].chunk
    assert np.array_equal(stock_chunk(tmp_path / "saved", asked[0])[0, :3], chunk)
    assert np.abs(stock_chunk(path, asked[0])[0, :3] - chunk).max() > 1e-3


def slow_std(head: StdHead, row: np.ndarray, dim: int) -> float:
    """By hand: layer norm, a linear layer, and the logarithm kept between those of 0.05 and 0.5."""
    weights = {k: v.double().numpy() for k, v in head.state_dict().items()}
    row = (row - row.mean()) / math.sqrt(row.var() + 1e-5) * weights["norm.weight"] + weights["norm.bias"]
    share = 1 / (1 + math.exp(-(weights["out.weight"][dim] @ row + weights["out.bias"][dim])))
    return math.exp(math.log(0.05) + (math.log(0.5) - math.log(0.05)) * share)


def test_other_weights_give_the_ratio_of_a_slow_computation(adapter: LeRobotAdapter, path: Path):
    asked = ask(4)
    decisions = adapter.decide(asked, 0)
    for decision in decisions:  # std 0.5, no squash
        assert_close(decision.chunk, 0.5 * decision.latent["u"])
    perturb(adapter, 0.1)
    seen: list[torch.Tensor] = []
    adapter.policy.model.decoder.register_forward_hook(lambda m, a, out: seen.append(out.double()))
    expected = []
    for request, decision in zip(asked, decisions, strict=True):
        batch = adapter.processing.prepare(*stack_observations([request]))
        mean = adapter.policy.predict_action_chunk(batch)[0].double().numpy()
        total = 0.0
        for i in range(3):
            for j in range(2):
                std = slow_std(adapter.family.std, seen[-1][i, 0].numpy(), j)
                z = (decision.latent["u"][i, j] - mean[i, j]) / std
                total += -0.5 * z * z - math.log(std * math.sqrt(2 * math.pi))
        expected.append(total - float(decision.log_prob.astype(np.float64).sum()))
    change = log_ratio(adapter, asked, decisions).numpy()
    assert np.allclose(change, expected, atol=1e-4)
    assert np.abs(change).max() > 0.1, "the weights must have moved the policy"


def test_the_std_starts_where_it_is_configured_and_stays_within_bounds(path: Path):
    # The checkpoint's action std is 0.5, so that is the factor from normalised to executed.
    adapter = adapter_at(path, GaussianSamplerConfig(std=0.3, std_min=0.1, std_max=0.6))
    noisy = np.stack([d.chunk for d in adapter.decide(ask(200), 0)])
    stock = np.stack([d.chunk for d in adapter.decide(ask(200, explore=False), 0)])
    added = (noisy - stock) / 0.5
    assert abs(added.mean()) < 0.03 and added.std() == pytest.approx(0.3, rel=0.05)
    with torch.no_grad():
        adapter.family.std.out.bias.copy_(torch.tensor([50.0, -50.0]))
    added = (np.stack([d.chunk for d in adapter.decide(ask(200), 0)]) - stock) / 0.5
    assert added[..., 0].std() == pytest.approx(0.6, rel=0.06)
    assert added[..., 1].std() == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize("detach", [True, False])
def test_the_std_shapes_the_features_only_when_asked(path: Path, detach: bool):
    adapter = adapter_at(path, GaussianSamplerConfig(detach=detach))
    perturb(adapter, 0.1)
    asked = ask(4)
    latent, _ = stored(adapter.decide(asked, 0))
    # Where u is the mean, the log-prob has no gradient but the std's.
    with torch.no_grad():
        latent["u"] = adapter.encode(*stack_observations(asked)).context.mean[:, :3]
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    reached = {k for k, p in adapter.trainable().items() if p.grad is not None and p.grad.abs().max() > 1e-9}
    head = {k for k in adapter.trainable() if k.startswith("family.")}
    assert len(head) == 4 and head <= reached
    assert (reached == head) if detach else any("backbone" in k for k in reached)


def test_dropout_is_off_and_batch_norm_frozen(adapter: LeRobotAdapter):
    kinds = {type(m).__name__ for m in adapter.policy.modules()}
    assert "Dropout" in kinds and "FrozenBatchNorm2d" in kinds and "BatchNorm2d" not in kinds
    assert adapter.policy.config.dropout > 0 and not any(m.training for m in adapter.policy.modules())


def test_what_inference_does_not_run_is_not_trained(path: Path):
    for mode in ("checkpoint", "full"):
        names = adapter_at(path, tuning=TuningConfig(mode=mode)).trainable()
        assert not [k for k in names if "vae_encoder" in k or "encoder_latent_input_proj.weight" in k]
        assert "policy.model.encoder_latent_input_proj.bias" in names


def test_torchvision_s_weights_are_not_asked_for(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def download(*arguments: object, **options: object) -> None:
        raise AssertionError("the network")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", download)
    config = PolicyConfig(path=str(path), device="cpu")
    save_pretrained(adapter, tmp_path / "asks", config)
    edit_config(tmp_path / "asks", pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    with pytest.raises(AssertionError, match="the network"):
        stock_chunk(tmp_path / "asks", ask(1)[0])
    again = adapter_at(tmp_path / "asks")
    assert pickle.dumps(again.decide(ask(2), 0)) == pickle.dumps(adapter.decide(ask(2), 0))
    save_pretrained(again, tmp_path / "saved", config)
    stock_chunk(tmp_path / "saved", ask(1)[0])
    assert json.loads((tmp_path / "saved" / "config.json").read_text())["pretrained_backbone_weights"] is None


def test_temporal_ensembling_is_refused(path: Path, tmp_path: Path):
    copied = Path(shutil.copytree(path, tmp_path / "policy"))
    edit_config(copied, temporal_ensemble_coeff=0.01, n_action_steps=1)
    with pytest.raises(InputError, match="^policy.temporal_ensemble_coeff=0.01: averaging over earlier"):
        adapter_at(copied)


def test_samplers_of_other_families_are_refused(path: Path):
    with pytest.raises(InputError, match=r"^policy.sampler.type='flow': a act policy explores by gaussian$"):
        adapter_at(path, FlowSamplerConfig())


def test_a_changed_lerobot_fails_at_load(path: Path, monkeypatch: pytest.MonkeyPatch):
    from lerobot.policies.act.modeling_act import ACT, ACTPolicy

    stock = ACTPolicy.predict_action_chunk
    with monkeypatch.context() as patch:
        patch.setattr(ACTPolicy, "predict_action_chunk", lambda self, batch: 1.001 * stock(self, batch))
        with pytest.raises(InputError, match=r"does not fit LeRobot 0\.6\.1: it differs from its sampler"):
            adapter_at(path)
    forward = ACT.forward

    def headless(self, batch):  # noqa: ANN001, ANN202
        head, self.action_head = self.action_head, torch.nn.Identity()
        hidden, rest = forward(self, batch)
        self.action_head = head
        return head.weight @ hidden.mT, rest

    monkeypatch.setattr(ACT, "forward", headless)
    with pytest.raises(InputError, match=r"cannot drive it \(KeyError: 'rows'\)"):
        adapter_at(path)


@pytest.mark.parametrize("learn_std", [True, False])
def test_a_checkpoint_without_a_std_of_its_own_starts_one(path: Path, tmp_path: Path, learn_std: bool):
    config = GaussianSamplerConfig(learn_std=learn_std)
    adapter = adapter_at(path, config)
    saved = tmp_path / "saved"
    save_pretrained(adapter, saved, PolicyConfig(path=str(path), device="cpu", sampler=config))
    assert (saved / "family.safetensors").is_file() == learn_std
    assert json.loads((saved / "accerl.json").read_text())["sampler"]["type"] == "gaussian"


class TestTuning:
    def test_there_is_no_expert(self, path: Path):
        with pytest.raises(InputError, match="policy.tuning.mode='expert': act has no action expert"):
            adapter_at(path, tuning=TuningConfig(mode="expert"))

    def test_lora_wants_targets_that_are_called(self, path: Path):
        with pytest.raises(InputError, match="policy.tuning.targets=None: LeRobot names no default for act"):
            adapter_at(path, tuning=TuningConfig(mode="lora"))
        # Attention multiplies by its output layer's weight without calling the layer: an adapter there is
        # never run.
        for targets in (r".*self_attn\.out_proj", r".*nothing"):
            with pytest.raises(InputError, match="matches none of the policy's .* linear layers"):
                adapter_at(path, tuning=TuningConfig(mode="lora", targets=targets))

    def test_lora_trains_little_and_is_saved_as_plain_weights(self, path: Path, tmp_path: Path):
        targets = r"model\.(encoder|decoder|vae_encoder)\..*linear\d"
        tuning = TuningConfig(mode="lora", rank=4, alpha=64, targets=targets)
        torch.manual_seed(0)  # of the adapters
        config = PolicyConfig(path=str(path), device="cpu", tuning=tuning)
        adapter, asked = load_adapter(config), ask(8)
        latent, _ = stored(adapter.decide(asked, 0))
        perturb(adapter, 1.0)
        evaluation = adapter.evaluate(*stack_observations(asked), latent)
        (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
        trained = {k: p for k, p in adapter.trainable().items() if k.startswith("policy.")}
        assert len(trained) == 3 * 2 * 2 and all(".lora_" in k for k in trained), "three layers, two linears"
        assert all(p.grad is not None and p.grad.abs().max() > 0 for p in trained.values())
        save_pretrained(adapter, tmp_path / "saved", config)
        rest = ask(1, explore=False)
        chunk = adapter.decide(rest, 0)[0].chunk
        assert_close(stock_chunk(tmp_path / "saved", rest[0])[0, :3], chunk)
        assert np.abs(stock_chunk(path, rest[0])[0, :3] - chunk).max() > 1e-3


def test_a_random_policy_learns_the_task(tmp_path: Path):
    path = write_act(tmp_path / "policy", image=8, chunk=4, executed=4)
    run = learning_run(
        path,
        env=SimulatedConfig(
            max_steps=8, tolerance=0.3, reward="dense", terminate_on_success=False, image_size=8
        ),
        policy=PolicyConfig(
            path=str(path), device="cpu", sampler=GaussianSamplerConfig(std=0.4, std_min=0.1, std_max=1.0)
        ),
        rollout=RolloutConfig(worlds=32, segment_length=8),
        replay=ReplayConfig(capacity=1024, min_decisions=96, ahead=192, samples_per_insert=2.0),
        algorithm=GIPOConfig(gamma=0.5),
        trainer=TrainerConfig(
            updates=40, batch_decisions=96, lr=1e-3, value_lr=3e-3, warmup_updates=3, value_warmup_updates=5
        ),
    )
    engine = LocalEngine(run, ("match",))
    before = success(engine)
    engine.train()
    history = updates(drive(engine))
    after = success(engine)
    engine.close()
    assert before < 0.4
    assert after > 0.6, f"{before:.0%} → {after:.0%}"
    rewards = [u["reward_mean"] for u in history]
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 1.0
