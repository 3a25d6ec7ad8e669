# SPDX-License-Identifier: Apache-2.0
"""The diffusion family, in numbers: on LeRobot's policy, and on a network small enough to sample often."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies import diffusion
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.diffusion import DiffusionShape, Schedule
from accerl_lerobot.policies.loading import load_adapter, load_lerobot_config, save_pretrained
from accerl_lerobot.policies.samplers import DiffusionSamplerConfig
from accerl_lerobot.replay import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies import diffusion_oracle
from tests.policies.checkpoints import edit_config, stock_chunk, write_diffusion
from tests.policies.contract import PolicyContract
from tests.policies.tiny import adapter_at, check_ratio_one, log_ratio, perturb, requests, stored
from tests.rounding import assert_close
from tests.runs import drive
from tests.test_local import learning_run, success, updates

ALL, LAST_TWO, LAST = (DiffusionSamplerConfig(std_min=0.5, last_steps=n) for n in (None, 2, 1))


class TestDDPM(PolicyContract):
    """Images above 32 pixels: of smaller ones LeRobot's spatial softmax sees one cell, whatever is in it."""

    samplers = [ALL, LAST_TWO, LAST]
    parts = ("rgb_encoder", "down_modules", "mid_modules", "up_modules", "final_conv")
    one_token = True
    image = 40
    slack = 0.06

    @staticmethod
    def write(directory: Path) -> Path:
        return write_diffusion(directory, image=40)


class TestDDIM(PolicyContract):
    """With batch norm, whose statistics must not move."""

    samplers = [ALL, LAST, DiffusionSamplerConfig(std_min=0.5, eta=0.0)]
    parts = ("rgb_encoder", "down_modules", "mid_modules", "up_modules", "final_conv")
    one_token = True
    image = 40

    @staticmethod
    def write(directory: Path) -> Path:
        return write_diffusion(
            directory,
            image=40,
            use_group_norm=False,
            noise_scheduler_type="DDIM",
            prediction_type="sample",
            num_inference_steps=3,
        )


def ask(count: int, **options: bool) -> list[Request]:
    return requests(count, image=16, **options)


def written(directory: Path, **fields: object) -> Path:
    return write_diffusion(directory / "pretrained_model", **fields)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("diffusion"))


@pytest.fixture
def adapter(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


def own_noise(asked: list[Request], steps: int) -> tuple[Tensor, list[Tensor]]:
    """Initial noise of these requests, (B, 8, 2), and the noise of each step."""
    first, rest = [], []
    for request in asked:
        rng = np.random.default_rng(request.noise_seed)
        first.append(rng.standard_normal((8, 2), dtype=np.float32))
        rest.append(rng.standard_normal((steps, 8, 2), dtype=np.float32))
    return torch.from_numpy(np.stack(first)), list(torch.from_numpy(np.stack(rest)).transpose(0, 1))


SCHEDULES = [
    {},
    {"prediction_type": "sample"},
    {"clip_sample": False, "beta_schedule": "linear", "beta_end": 0.3},
    {"noise_scheduler_type": "DDIM"},
    {"noise_scheduler_type": "DDIM", "prediction_type": "sample", "clip_sample_range": 0.7},
    {"num_inference_steps": 3},  # 20 training steps are no multiple of it
    {"num_inference_steps": None, "num_train_timesteps": 6},
]


@pytest.mark.parametrize("fields", SCHEDULES, ids=lambda f: "-".join(str(v) for v in f.values()) or "ddpm")
def test_not_exploring_is_lerobot_s_sampler_to_the_bit(
    tmp_path: Path, fields: dict, monkeypatch: pytest.MonkeyPatch
):
    adapter, asked = adapter_at(written(tmp_path, **fields)), ask(6, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    noise, steps = own_noise(asked, len(adapter.family.schedule))
    for scheduler in ("ddpm", "ddim"):
        monkeypatch.setattr(
            f"diffusers.schedulers.scheduling_{scheduler}.randn_tensor",
            lambda shape, generator, device, dtype: steps.pop(0),
        )
    batch = adapter.processing.prepare(observations, tasks)
    batch["observation.state"] = batch["observation.state"][:, None]
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch, noise=noise))
    assert len(steps) == (1 if adapter.family.schedule.scheduler == "DDPM" else len(adapter.family.schedule))
    chunks = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert np.array_equal(chunks, stock.numpy())
    noisy = np.stack([d.chunk for d in adapter.decide(ask(6), 0)])
    assert np.abs(noisy - chunks).max() > 1e-2


def test_lerobot_s_sampler_wants_what_its_processors_do_not_give(adapter: LeRobotAdapter):
    batch = adapter.processing.prepare(*stack_observations(ask(2)))
    with pytest.raises(AssertionError):
        adapter.policy.predict_action_chunk(batch)
    assert adapter.decide(ask(2), 0)[0].chunk.shape == (3, 2)
    # Its queues would have answered the second question with the first one's observation.
    adapter.policy.select_action(batch)
    assert adapter.self_check(*stack_observations(ask(3))) == 0.0


@pytest.mark.parametrize(
    ("fields", "config"),
    [
        ({}, ALL),
        ({}, LAST_TWO),
        ({"prediction_type": "sample", "clip_sample": False}, DiffusionSamplerConfig(std_min=0.02)),
        ({"noise_scheduler_type": "DDIM"}, ALL),
        ({"noise_scheduler_type": "DDIM"}, DiffusionSamplerConfig(std_min=0.1, eta=0.6, last_steps=3)),
        ({"noise_scheduler_type": "DDIM", "prediction_type": "sample"}, LAST),
    ],
    ids=str,
)
def test_other_weights_give_the_oracle_s_ratio(tmp_path: Path, fields: dict, config: DiffusionSamplerConfig):
    adapter, asked = adapter_at(written(tmp_path, **fields), config), ask(3)
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.1)
    policy = adapter.policy
    rule = {
        "scheduler": policy.config.noise_scheduler_type,
        "eta": config.eta,
        "prediction": policy.config.prediction_type,
        "clip": 1.0 if policy.config.clip_sample else None,
    }
    expected = []
    for request, decision in zip(asked, decisions, strict=True):
        batch = adapter.processing.prepare(*stack_observations([request]))
        features = policy.diffusion.rgb_encoder[0](batch["observation.images.front"])
        condition = torch.cat([batch["observation.state"], features], -1)

        def network(x: np.ndarray, t: int, condition: Tensor = condition) -> np.ndarray:
            with torch.no_grad():
                output = policy.diffusion.unet(
                    torch.from_numpy(x).float()[None], torch.tensor([t]), condition
                )
            return output[0].double().numpy()

        new = diffusion_oracle.log_prob(
            network, decision.latent["path"], [15, 10, 5, 0], 20, 3, config.std_min, rule
        )
        old = decision.log_prob.astype(np.float64)
        assert len(old) == (3 if config.last_steps == 1 else 8)
        expected.append((new[: len(old)] - old).sum())
    change = log_ratio(adapter, asked, decisions).numpy()
    assert np.allclose(change, expected, rtol=1e-3, atol=2e-3)
    assert np.abs(change).max() > 0.05, "the weights must have moved the policy"


# ---- what an importance weight is for, on a network in which every entry acts on every other

SHAPE = DiffusionShape(horizon=3, executed=1, action_dim=1)
SAMPLES = 100_000
EXACT, WRONG = 4.0, 10.0
"""Monte-Carlo errors: agreement is below the first, a detected mistake above the second."""


def network(perturbation: float, drift: float) -> Callable[[Tensor, int], Tensor]:
    base, other = torch.Generator().manual_seed(7), torch.Generator().manual_seed(8)
    mix = 0.3 * torch.randn(3, 3, generator=base)
    mix[0] = torch.tensor([0.4, 0.9, 0.9])
    mix += perturbation * torch.randn(3, 3, generator=other)
    added = drift * torch.tensor([-0.3, 1.0, 1.0])

    def predict(x: Tensor, timestep: int) -> Tensor:
        return (torch.tanh(x.flatten(1) @ mix.T + 0.05 * timestep) + added).view(x.shape)

    return predict


MU, PI = network(0.0, 0.0), network(0.1, 0.3)


def schedule(scheduler: str) -> Schedule:
    alphas = torch.tensor([0.1, 0.5, 0.9])
    return Schedule(
        timesteps=(12, 6, 0),
        alphas=alphas,
        following=torch.cat([alphas[1:], torch.ones(1)]),
        scheduler=scheduler,
        prediction="epsilon",
        clip=1.5,
    )


def act(
    predict: Callable[[Tensor, int], Tensor], scheduler: str, config: DiffusionSamplerConfig, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """(executed action (B,), chain, log-prob (B,))."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(SAMPLES, 3, 1, generator=generator)
    eps = torch.randn(SAMPLES, 3, 3, 1, generator=generator)
    explore = torch.ones(SAMPLES, dtype=torch.bool)
    x, path, logp = diffusion.sample(predict, x, eps, explore, SHAPE, schedule(scheduler), config)
    return x[:, 0, 0], path, logp.sum(1)


def payoff(action: Tensor) -> Tensor:
    return torch.tanh(2 * action + 0.5) + 0.2 * action**2


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error


def weighted(scheduler: str, config: DiffusionSamplerConfig) -> tuple[Tensor, Tensor]:
    """Samples of μ: ρ (B,) and ρ·f(a) (B,)."""
    action, path, behaviour = act(MU, scheduler, config, 11)
    new = diffusion.log_prob(PI, path, SHAPE, schedule(scheduler), config).sum(1)
    ratio = (new - behaviour).exp()
    return ratio, ratio * payoff(action)


EXACT_SAMPLERS = [
    ("DDPM", DiffusionSamplerConfig(std_min=0.3)),
    ("DDIM", DiffusionSamplerConfig(std_min=0.3)),
    ("DDIM", DiffusionSamplerConfig(std_min=0.5, eta=0.3)),
]


@pytest.mark.parametrize(("scheduler", "config"), EXACT_SAMPLERS, ids=str)
def test_weighted_samples_of_mu_are_samples_of_pi(scheduler: str, config: DiffusionSamplerConfig):
    ratio, product = weighted(scheduler, config)
    new, old = (payoff(act(p, scheduler, config, seed)[0]) for p, seed in ((PI, 12), (MU, 13)))
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, new) < EXACT


@pytest.mark.parametrize("scheduler", ["DDPM", "DDIM"])
def test_rows_that_are_not_executed_feed_back(scheduler: str, monkeypatch: pytest.MonkeyPatch):
    config = DiffusionSamplerConfig(std_min=0.3)
    executed = torch.tensor([[True], [False], [False]])
    monkeypatch.setattr(diffusion, "_mask", lambda k, shape, schedule, device: executed)
    ratio, product = weighted(scheduler, config)
    assert deviation(ratio, torch.ones(2)) < EXACT, "E[ρ] = 1 does not catch it"
    assert deviation(product, payoff(act(PI, scheduler, config, 12)[0])) > WRONG


@pytest.mark.parametrize("scheduler", ["DDPM", "DDIM"])
def test_the_last_steps_weight_towards_those_steps_alone(scheduler: str):
    config = DiffusionSamplerConfig(std_min=0.3, last_steps=1)
    ratio, product = weighted(scheduler, config)

    def only_the_last_is_new(x: Tensor, timestep: int) -> Tensor:
        return PI(x, timestep) if timestep == 0 else MU(x, timestep)

    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, payoff(act(only_the_last_is_new, scheduler, config, 12)[0])) < EXACT
    assert deviation(product, payoff(act(PI, scheduler, config, 12)[0])) > WRONG, "not π: the rest is μ's"


def test_exploration_keeps_to_the_last_steps_and_to_the_least_std():
    config = DiffusionSamplerConfig(std_min=0.4, last_steps=2)
    x, eps = torch.zeros(1, 3, 1), torch.ones(1, 3, 3, 1)
    plan = schedule("DDPM")
    _, path, _ = diffusion.sample(MU, x, eps, torch.tensor([True]), SHAPE, plan, config)
    mean, std = plan.step(0, x, MU(x, 12))
    assert torch.equal(path[:, 0], mean + std), "the first step is LeRobot's own"
    for k, timestep in ((1, 6), (2, 0)):
        mean, std = plan.step(k, path[:, k - 1], MU(path[:, k - 1], timestep))
        assert_close(path[:, k], mean + max(float(std), 0.4))
    assert float(plan.step(1, x, x)[1]) < 0.4 and float(plan.step(2, x, x)[1]) == 0


def test_entropy_is_the_mean_surprise_of_what_is_sampled():
    for config in (DiffusionSamplerConfig(std_min=0.3), DiffusionSamplerConfig(std_min=0.3, last_steps=1)):
        logp = act(MU, "DDPM", config, 1)[2]
        entropy = diffusion.entropy(SHAPE, schedule("DDPM"), config)
        assert deviation(-logp, torch.full((2,), entropy)) < EXACT


# ---- loading and saving


@pytest.mark.parametrize("config", [ALL, LAST], ids=["all", "last"])
def test_only_executed_rows_of_the_outcome_are_scored(path: Path, config: DiffusionSamplerConfig):
    adapter, asked = adapter_at(path, config), ask(4)
    decisions = adapter.decide(asked, 0)
    for decision in decisions:
        decision.latent["path"][-1, 3:] += 1.0
    check_ratio_one(adapter, asked, decisions)
    for decision in decisions:
        decision.latent["path"][-1, 2, 1] += 0.1
    assert log_ratio(adapter, asked, decisions).abs().min() > 1e-3


@pytest.mark.parametrize(("last", "points"), [(None, 5), (2, 3), (1, 2)])
def test_the_latent_is_as_small_as_re_scoring_allows(path: Path, last: int | None, points: int):
    decision = adapter_at(path, DiffusionSamplerConfig(last_steps=last)).decide(ask(1), 0)[0]
    assert decision.latent["path"].shape == (points, 8, 2)


def test_a_saved_checkpoint_is_stock_lerobot_s(path: Path, tmp_path: Path):
    sampler = DiffusionSamplerConfig(scheduler="DDIM")
    config = PolicyConfig(path=str(path), device="cpu", sampler=sampler, num_steps=2)
    adapter = load_adapter(config)
    perturb(adapter, 0.1)
    save_pretrained(adapter, tmp_path / "saved", config)
    asked = ask(1, explore=False)
    noise, _ = own_noise(asked, 2)
    chunk = adapter.decide(asked, 0)[0].chunk
    assert np.array_equal(stock_chunk(tmp_path / "saved", asked[0], noise=noise)[0], chunk)
    stored_config = json.loads((tmp_path / "saved" / "config.json").read_text())
    assert stored_config["noise_scheduler_type"] == "DDIM" and stored_config["num_inference_steps"] == 2
    assert len(adapter_at(tmp_path / "saved").family.schedule) == 2


def test_torchvision_s_weights_are_not_asked_for(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def download(*arguments: object, **options: object) -> None:
        raise AssertionError("the network")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", download)
    copied = Path(shutil.copytree(path, tmp_path / "policy"))
    edit_config(copied, pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    assert load_lerobot_config(PolicyConfig(path=str(copied))).pretrained_backbone_weights is None
    adapter_at(copied)


@pytest.mark.parametrize(
    ("changes", "options", "sentence"),
    [
        (
            {},
            {"num_steps": 21},
            "policy.num_steps=21: use at most 20, as many as it was trained with",
        ),
        (
            {},
            {"sampler": DiffusionSamplerConfig(last_steps=5)},
            "policy.sampler.last_steps=5: use at most 4, the policy's denoising steps",
        ),
        (
            {},
            {"n_action_steps": 9},
            "policy.n_action_steps=9: use 1 to 8, the chunk the policy predicts",
        ),
        (
            {"n_obs_steps": 2},
            {"n_action_steps": 8},
            "policy.n_action_steps=8: use 1 to 7, the chunk the policy predicts",
        ),
    ],
)
def test_refusals(path: Path, tmp_path: Path, changes: dict, options: dict, sentence: str):
    copied = Path(shutil.copytree(path, tmp_path / "policy"))
    edit_config(copied, **changes)
    with pytest.raises(InputError, match=f"^{sentence}"):
        load_adapter(PolicyConfig(path=str(copied), device="cpu", **options))


def test_a_compiled_network_is_refused(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "compile", lambda module, **options: module)
    copied = Path(shutil.copytree(path, tmp_path / "policy"))
    edit_config(copied, compile_model=True)
    with pytest.raises(InputError, match="^policy.compile_model=True: "):
        adapter_at(copied)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"std_min": 0.0}, "std_min"),
        ({"std_min": 1.1}, "std_min"),
        ({"last_steps": 0}, "last_steps"),
        ({"eta": 1.5}, "eta"),
        ({"scheduler": "PNDM"}, "scheduler"),
    ],
)
def test_bad_values_name_their_field(values: dict, field: str):
    with pytest.raises(InputError, match=f"^policy.sampler.{field}="):
        DiffusionSamplerConfig(**values)


def test_a_changed_scheduler_fails_at_load(path: Path, monkeypatch: pytest.MonkeyPatch):
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel

    stock = DDPMScheduler._get_variance
    with monkeypatch.context() as patch:
        patch.setattr(
            DDPMScheduler, "_get_variance", lambda self, t, **options: 1.1 * stock(self, t, **options)
        )
        with pytest.raises(InputError, match="does not fit LeRobot .* it differs from its sampler"):
            adapter_at(path)
    monkeypatch.delattr(DiffusionModel, "_prepare_global_conditioning")
    with pytest.raises(InputError, match=r"cannot drive it \(AttributeError: .*_prepare_global"):
        adapter_at(path)


class TestTuning:
    def test_there_is_no_expert(self, path: Path):
        with pytest.raises(InputError, match="diffusion has no action expert"):
            adapter_at(path, tuning=TuningConfig(mode="expert"))

    def test_lora_trains_little_and_is_saved_as_plain_weights(self, path: Path, tmp_path: Path):
        tuning = TuningConfig(mode="lora", rank=4, alpha=64, targets=r"diffusion\.unet\..*cond_encoder\.1")
        config = PolicyConfig(path=str(path), device="cpu", tuning=tuning)
        torch.manual_seed(0)  # of the adapters
        adapter, asked = load_adapter(config), ask(8)
        latent, _ = stored(adapter.decide(asked, 0))
        perturb(adapter, 1.0)
        adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
        trained = {k: p for k, p in adapter.trainable().items() if k.startswith("policy.")}
        assert trained and all(".lora_" in k and p.grad.abs().max() > 0 for k, p in trained.items())
        save_pretrained(adapter, tmp_path / "saved", config)
        again = adapter_at(tmp_path / "saved")
        rest = ask(4, explore=False)
        chunks = [np.stack([d.chunk for d in a.decide(rest, 0)]) for a in (adapter, again, adapter_at(path))]
        assert_close(chunks[1], chunks[0])
        assert np.abs(chunks[0] - chunks[2]).max() > 1e-3


def test_a_random_policy_gets_better_at_the_task(tmp_path: Path):
    sizes = {"observation.state": 4, "action": 2}
    path = written(
        tmp_path,
        image=8,
        horizon=8,
        n_obs_steps=2,
        executed=4,
        noise_scheduler_type="DDIM",
        prediction_type="sample",
        num_inference_steps=2,
        stats={key: {"min": -torch.ones(n), "max": torch.ones(n)} for key, n in sizes.items()},
    )
    run = learning_run(
        path,
        env=SimulatedConfig(
            max_steps=8, tolerance=0.3, reward="dense", terminate_on_success=False, image_size=8
        ),
        policy=PolicyConfig(path=str(path), device="cpu", sampler=DiffusionSamplerConfig(std_min=0.3)),
        rollout=RolloutConfig(worlds=32, segment_length=8),
        replay=ReplayConfig(capacity=1024, min_decisions=96, ahead=192, samples_per_insert=2.0),
        algorithm=GIPOConfig(gamma=0.5),
        trainer=TrainerConfig(
            updates=40, batch_decisions=96, lr=1e-3, value_lr=3e-3, warmup_updates=3, value_warmup_updates=5
        ),
    )
    engine = LocalEngine(run, ("match",), history=2)
    before = success(engine)
    engine.train()
    history = updates(drive(engine))
    after = success(engine)
    engine.close()
    assert after > before + 0.25, f"{before:.0%} → {after:.0%}"
    rewards = [u["reward_mean"] for u in history]
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.5
