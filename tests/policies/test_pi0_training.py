# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5 in training: what is tuned, in which precision, and that a policy gets better."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.contract import Engine
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.evaluation.config import evaluation_plans
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig, ValueHeadConfig
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import FlowSamplerConfig, NoiseSpaceSamplerConfig
from accerl_lerobot.replay import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.flow_contract import slow_log_prob
from tests.policies.tiny import adapter_at, check_ratio_one, log_ratio, perturb, requests, stored
from tests.policies.tiny_pi import KINDS, small, write_pi
from tests.rounding import assert_close
from tests.runs import collect, drive, tiny_run


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module", params=KINDS)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi(tmp_path_factory.mktemp(request.param) / "pretrained_model", request.param, padded_dim=4)


def change(adapter: LeRobotAdapter, seed: int) -> set[str]:
    """Takes a large step on stored decisions; the names of the policy's tensors that moved."""
    asked = requests(6, seed=seed)
    before = {k: v.clone() for k, v in adapter.policy.state_dict().items()}
    latent, _ = stored(adapter.decide(asked, 0))
    optimizer = torch.optim.AdamW(adapter.trainable().values(), lr=1e-2)
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
    optimizer.step()
    return {k for k, v in adapter.policy.state_dict().items() if not torch.equal(v, before[k])}


def test_the_expert_alone(path: Path):
    adapter = adapter_at(path, tuning=TuningConfig(mode="expert"))
    moved = change(adapter, 0)
    assert moved == {k.removeprefix("policy.") for k in adapter.trainable() if k.startswith("policy.")}
    assert not any("paligemma." in k or "lm_head" in k for k in moved)
    for part in ("gemma_expert.model.layers.0", "gemma_expert.model.norm", "action_in_proj", "time_mlp_in"):
        assert any(part in k for k in moved), part


def test_low_rank_adapters_where_lerobot_puts_them(path: Path, tmp_path: Path):
    config = PolicyConfig(path=str(path), device="cpu", tuning=TuningConfig(mode="lora", rank=4))
    adapter = adapter_at(path, tuning=config.tuning)
    trained = [k for k in adapter.trainable() if k.startswith("policy.")]
    assert trained and all(".lora_" in k for k in trained)
    assert {k.split(".lora_")[0].split(".")[-1] for k in trained} >= {"q_proj", "v_proj", "action_out_proj"}
    assert not any("paligemma." in k for k in trained)
    asked = requests(5)
    before = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    change(adapter, 1)
    decisions = adapter.decide(asked, 0)
    assert np.abs(np.stack([d.chunk for d in decisions]) - before).max() > 1e-2
    save_pretrained(adapter, tmp_path / "saved", config)
    plain = adapter_at(tmp_path / "saved")
    assert not any(".lora_" in k for k in plain.policy.state_dict())
    check_ratio_one(plain, asked, decisions)


def test_full_trains_all_that_acts(path: Path):
    adapter = adapter_at(path, tuning=TuningConfig(mode="full"))
    assert change(adapter, 2) == {
        k.removeprefix("policy.") for k in adapter.trainable() if k.startswith("policy.")
    }


def test_lerobot_s_own_freezing_is_kept(tmp_path: Path):
    for kind in KINDS:
        path = write_pi(tmp_path / kind, kind, train_expert_only=True)
        assert not any("paligemma." in k for k in adapter_at(path).trainable())


@pytest.mark.parametrize("detach", [True, False])
def test_the_value_loss_reaches_the_backbone_only_when_asked(path: Path, detach: bool):
    adapter = adapter_at(path, value_head=ValueHeadConfig(detach=detach))
    perturb(adapter, 0.1)
    asked = requests(4)
    latent, _ = stored(adapter.decide(asked, 0))
    adapter.evaluate(*stack_observations(asked), latent).value.mean.square().sum().backward()
    reached = {k for k, p in adapter.trainable().items() if p.grad is not None and p.grad.abs().max() > 0}
    critic = {k for k in adapter.trainable() if k.startswith("value_head.")}
    assert critic <= reached
    assert (reached == critic) if detach else any("vision_tower" in k for k in reached)


@pytest.mark.parametrize("per_row", [True, False])
def test_steered_by_its_noise_the_policy_stays_as_it_is(path: Path, per_row: bool):
    sampler = NoiseSpaceSamplerConfig(per_row=per_row)
    adapter, asked = adapter_at(path, sampler), requests(12)
    assert all(k.startswith(("family.", "value_head.")) for k in adapter.trainable())
    perturb(adapter, 0.3)
    together = adapter.decide(asked, 0)
    alone = [adapter.decide([request], 0)[0] for request in asked[:6]]
    check_ratio_one(adapter, asked, alone + together[6:])
    latent, old = stored(together)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    assert all(p.grad.abs().max() > 0 for k, p in adapter.trainable().items() if k.startswith("family."))
    noise = latent["z"].expand(-1, 4, -1)
    stock = adapter.policy.predict_action_chunk(
        adapter.processing.prepare(*stack_observations(asked)), noise=noise
    )
    chunks = np.stack([d.chunk for d in together])
    assert np.array_equal(chunks, adapter.processing.unnormalise(stock).numpy())


@pytest.mark.parametrize("stochastic", ["last", "all", "one"])
def test_log_probs_are_float32_where_the_network_is_bfloat16(path: Path, stochastic: str):
    config = FlowSamplerConfig(stochastic=stochastic)
    adapter, asked = adapter_at(path, config, precision="bf16"), requests(4)
    products: list[torch.dtype] = []
    adapter.policy.model.action_in_proj.register_forward_hook(lambda *given: products.append(given[2].dtype))
    decisions = adapter.decide(asked, 0)
    latent, old = stored(decisions)
    assert set(products) == {torch.bfloat16} and old.dtype == latent["path"].dtype == torch.float32
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    assert evaluation.log_prob.dtype == torch.float32
    assert torch.equal(evaluation.log_prob, old), "the same batch, the same numbers"
    # In bfloat16 observations alone are not observations in a batch: the oracle reads them as they were.
    with torch.autocast("cpu", torch.bfloat16):
        encoded = adapter.encode(*stack_observations(asked))

        def velocity(x: np.ndarray, t: float, sample: int) -> np.ndarray:
            whole = torch.zeros(4, *x.shape)
            whole[sample] = torch.from_numpy(x).float()
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
                return encoded.context.velocity(whole, torch.full((4,), t))[sample].numpy().astype(float)

        expected = slow_log_prob(adapter, asked, latent, velocity)
    assert_close(old, expected)  # rounded to bfloat16 it would be off by 0.1
    alone = [adapter.decide([request], 0)[0] for request in asked]
    assert log_ratio(adapter, asked, alone).abs().max() < 0.5


def test_a_bfloat16_checkpoint_acts_and_is_saved_in_float32(path: Path, tmp_path: Path):
    kind = adapter_at(path).policy.config.type
    origin = write_pi(tmp_path / "origin", kind, dtype="bfloat16", padded_dim=4)
    adapter, asked = adapter_at(origin), requests(16)
    assert {p.dtype for p in adapter.policy.parameters()} == {torch.float32}
    together = adapter.decide(asked, 0)
    alone = [adapter.decide([request], 0)[0] for request in asked]
    check_ratio_one(adapter, asked, alone)
    change(adapter, 3)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(origin), device="cpu"))
    again = adapter_at(tmp_path / "saved")
    assert again.policy.config.dtype == "float32"
    expected = adapter.decide(asked, 0)
    assert np.array_equal(again.decide(asked, 0)[0].chunk, expected[0].chunk), "not rounded to bfloat16"
    assert np.abs(expected[0].chunk - together[0].chunk).max() > 1e-3


def test_relative_actions_are_added_to_their_own_state(tmp_path: Path):
    for kind in KINDS:
        absolute = adapter_at(write_pi(tmp_path / f"{kind}-absolute", kind))
        relative = adapter_at(write_pi(tmp_path / f"{kind}-relative", kind, use_relative_actions=True))
        asked = requests(5)
        states = np.stack([r.observation["observation.state"] for r in asked])
        chunks = [np.stack([d.chunk for d in a.decide(asked, 0)]) for a in (absolute, relative)]
        assert_close(chunks[1], chunks[0] + states[:, None, :2])
        check_ratio_one(relative, asked, relative.decide(asked, 0))


def test_a_camera_the_world_does_not_have_is_masked(tmp_path: Path):
    for kind in KINDS:
        one = adapter_at(write_pi(tmp_path / f"{kind}-one", kind))
        two = adapter_at(write_pi(tmp_path / f"{kind}-two", kind, empty_cameras=1))
        asked = requests(5)
        chunks = [np.stack([d.chunk for d in a.decide(asked, 0)]) for a in (one, two)]
        assert_close(chunks[1], chunks[0])
        values = [a.values(*stack_observations(asked)) for a in (one, two)]
        assert_close(values[1], values[0])


def run(
    checkpoint: Path, updates: int, batch: int, lr: float
) -> tuple[list[float], list[float], list[float]]:
    """(success and return of the stock sampler before, after; mean reward of each update)."""
    config: RunConfig = tiny_run(
        checkpoint,
        env=SimulatedConfig(max_steps=8, tolerance=0.3, reward="dense", terminate_on_success=False),
        policy=PolicyConfig(path=str(checkpoint), device="cpu", sampler=FlowSamplerConfig(noise_level=0.6)),
        rollout=RolloutConfig(worlds=32, segment_length=8),
        replay=ReplayConfig(capacity=512, min_decisions=64, ahead=128, samples_per_insert=2.0),
        algorithm=GIPOConfig(gamma=0.5),
        trainer=TrainerConfig(
            updates=updates,
            batch_decisions=batch,
            lr=lr,
            value_lr=5e-3,
            warmup_updates=3,
            value_warmup_updates=5,
        ),
    )
    engine = LocalEngine(config, ("match",))
    before = played(engine)
    engine.train()
    history = drive(engine)
    after = played(engine)
    engine.close()
    return before, after, [u["reward_mean"] for progress in history for u in progress.updates]


def played(engine: Engine, episodes: int = 64) -> list[float]:
    engine.plan(evaluation_plans(("match",), episodes, "test"))
    results = collect(engine, "test", episodes)
    return [float(np.mean([getattr(r, k) for r in results])) for k in ("success", "episode_return")]


def test_a_random_pi0_learns_the_task(tmp_path: Path):
    before, after, rewards = run(write_pi(tmp_path / "pi0", "pi0", prompt=12, num_steps=2), 50, 128, 5e-3)
    assert before[0] < 0.4 and after[0] > 0.7, f"{before[0]:.0%} → {after[0]:.0%}"
    assert after[1] > before[1] + 2 and np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.5


def test_a_random_pi05_gets_better(tmp_path: Path):
    # It would have to learn to read first: its state is text. What it does learn is to stay near the middle.
    before, after, rewards = run(write_pi(tmp_path / "pi05", "pi05", prompt=40, num_steps=1), 50, 64, 3e-3)
    assert after[1] > before[1] + 0.4, f"{before[1]:.2f} → {after[1]:.2f}"
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10])
