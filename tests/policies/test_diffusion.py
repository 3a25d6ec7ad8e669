# SPDX-License-Identifier: Apache-2.0
"""The diffusion family, in numbers: on LeRobot's policy, and on a network small enough to sample often."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.console import Console
from accerl_lerobot.engine import run
from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.experience import TASK, Request
from accerl_lerobot.policies.adapter import LeRobotAdapter, stack_observations
from accerl_lerobot.policies.config import DiffusionSamplerConfig, PolicyConfig
from accerl_lerobot.policies.diffusion import DiffusionFamily, DiffusionShape, Schedule
from accerl_lerobot.policies.family import Action, standard_normal
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.rollout.worker import RolloutWorker
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.checkpoints import edit_config, write_diffusion
from tests.policies.tiny import adapter_at, deviation, requests
from tests.rounding import assert_close
from tests.runs import tiny_run
from tests.transport.played import played

ALL = DiffusionSamplerConfig(std_min=0.5)


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


# ---- importance weights, on a network in which every entry acts on every other

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


def family(scheduler: str, config: DiffusionSamplerConfig) -> DiffusionFamily:
    return DiffusionFamily(SimpleNamespace(shape=SHAPE, schedule=schedule(scheduler)), config)


def act(predict: Callable[[Tensor, int], Tensor], it: DiffusionFamily, seed: int) -> Action:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(SAMPLES, 3, 1, generator=generator)
    eps = torch.randn(SAMPLES, 3, 3, 1, generator=generator)
    return it.sample(predict, x, eps, torch.ones(SAMPLES, dtype=torch.bool))


def payoff(action: Action) -> Tensor:
    executed = action.chunk[:, 0, 0]
    return torch.tanh(2 * executed + 0.5) + 0.2 * executed**2


@pytest.mark.parametrize("scheduler", ["DDPM", "DDIM"])
def test_weighted_samples_of_mu_are_samples_of_pi(scheduler: str):
    it = family(scheduler, DiffusionSamplerConfig(std_min=0.3))
    acted = act(MU, it, 11)
    ratio = (it.log_prob(PI, acted.latent) - acted.log_prob).sum(1).exp()
    new, old = (payoff(act(p, it, seed)) for p, seed in ((PI, 12), (MU, 13)))
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(ratio * payoff(acted), new) < EXACT


def test_exploration_keeps_to_the_least_std():
    x, eps = torch.zeros(1, 3, 1), torch.ones(1, 3, 3, 1)
    it = family("DDPM", DiffusionSamplerConfig(std_min=0.4))
    plan, path = it.schedule, it.sample(MU, x, eps, torch.tensor([True])).latent["path"]
    for k, timestep in enumerate((12, 6, 0)):
        mean, std = plan.step(k, path[:, k], MU(path[:, k], timestep))
        assert_close(path[:, k + 1], mean + max(float(std), 0.4))
    assert float(plan.step(1, x, x)[1]) < 0.4 and float(plan.step(2, x, x)[1]) == 0


def test_entropy_is_the_mean_surprise_of_what_is_sampled():
    it = family("DDPM", DiffusionSamplerConfig(std_min=0.3))
    assert deviation(-act(MU, it, 1).log_prob.sum(1), torch.full((2,), it.entropy)) < EXACT


# ---- loading and saving


@pytest.mark.parametrize(
    ("changes", "options", "sentence"),
    [
        ({}, {"num_steps": 21}, "policy.num_steps=21: use at most 20, as many as it was trained with"),
        ({}, {"n_action_steps": 9}, "policy.n_action_steps=9: use 1 to 8, the chunk the policy predicts"),
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


# ---- a policy that looks back, LeRobot's default, in a world

OBSERVED = 2
STATE = "observation.state"
WORLD = SimulatedConfig(max_steps=13, tolerance=0.05, image_size=40)


@pytest.fixture(scope="module")
def looking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(
        tmp_path_factory.mktemp("looking"),
        image=40,
        n_obs_steps=OBSERVED,
        noise_scheduler_type="DDIM",
        num_inference_steps=3,
    )


def test_an_episode_is_the_one_that_stock_lerobot_plays(looking: Path):
    """LeRobot sees every env step and keeps its own queues; we look when a decision is due."""
    adapter = adapter_at(looking)
    policy, size = adapter.policy, (adapter.family.shape.horizon, adapter.family.shape.action_dim)
    ours, stock = make_world(WORLD, OBSERVED), make_world(WORLD)
    observation, policy_sees = ours.reset(3, "match"), stock.reset(3, "match")
    policy.reset()
    steps = decisions = 0
    ended = False
    while not ended:
        request = Request(observation=observation, noise_seed=decisions, explore=False)
        chunk = adapter.decide([request], 0)[0].chunk
        noise = standard_normal([request], size, device=torch.device("cpu"))[0]
        for row in chunk:
            arrays = {k: np.asarray(v)[None] for k, v in policy_sees.items() if k != TASK}
            batch = adapter.processing.prepare(arrays, [str(policy_sees[TASK])])
            action = adapter.processing.unnormalise(policy.select_action(batch, noise=noise))[0]
            assert_close(action, row)
            result = stock.step_chunk(row[None])
            steps += 1
            if result.done:
                break
            assert result.observation is not None
            policy_sees = result.observation
        whole = ours.step_chunk(chunk)
        ended = whole.done
        assert ended == result.done
        if whole.observation is not None:
            observation = whole.observation
            assert np.array_equal(observation[STATE][-1], result.observation[STATE])
        decisions += 1
    assert steps == 13 and decisions == 5


def config_for(path: Path, output_dir: Path, **sections: object) -> RunConfig:
    defaults = {
        "env": WORLD,
        "policy": PolicyConfig(path=str(path), device="cpu", sampler=DiffusionSamplerConfig(std_min=0.3)),
        "trainer": TrainerConfig(updates=3, batch_decisions=16),
        "launch": LaunchConfig(engine="local"),
        "evaluation": EvaluationConfig(episodes=4, videos=0, before=False),
        "output_dir": str(output_dir),
    }
    return tiny_run(path, **(defaults | sections))


def test_a_run_asks_the_policy_how_far_it_looks_back(looking: Path, tmp_path: Path):
    config = config_for(looking, tmp_path / "run")
    summary = run.execute(config, run.make_output_dir(config), Console())
    assert summary["updates"] == 3 and summary["n_after"] == 4 and summary["ratio_max_dev"] < 1


def test_a_world_without_a_history_is_refused_in_words(looking: Path):
    request = requests(1, image=40)[0]
    with pytest.raises(ValueError, match="but the policy reads 2 env steps at a time: make worlds"):
        adapter_at(looking).decide([request], 0)


def test_a_rollout_process_asks_with_the_history():
    worker = RolloutWorker(WORLD, RolloutConfig(worlds=1), ("match",), 0, history=OBSERVED)
    asked: list[Request] = []

    def decide(due: list[Request]) -> list[Request]:
        asked.extend(due)
        raise InterruptedError

    worker.report(True, [])
    with pytest.raises(InterruptedError):
        worker.run(played(decide), played(lambda segments: True))
    assert asked[0].observation[STATE].shape == (OBSERVED, 4)
    assert asked[0].observation["observation.images.front"].shape == (OBSERVED, 40, 40, 3)
