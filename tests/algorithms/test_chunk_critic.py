# SPDX-License-Identifier: Apache-2.0
"""The off-policy algorithms: memory, weights and networks against slow ones by hand, and runs that learn."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import AWRConfig, ChunkCriticConfig, SelfImitationConfig, chunk_critic
from accerl_lerobot.algorithms.config import OffPolicyConfig, TrainerConfig
from accerl_lerobot.algorithms.off_policy import Memory, OffPolicyUpdate, weights
from accerl_lerobot.algorithms.update import make_update
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError, NonFiniteError
from accerl_lerobot.experience import ENVIRONMENT_STATE, Request, Segment, stack_observations
from accerl_lerobot.policies import teacher as teacher_module
from accerl_lerobot.policies.config import FlowSamplerConfig, PolicyConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowFamily, FlowShape
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.teacher import Ensemble, Teacher, with_teacher
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.run.preflight import check_start
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.world_model.config import LatentConfig, SimulatorStateConfig
from accerl_lerobot.world_model.latent import LatentModel
from accerl_lerobot.world_model.states import SimulatorState, StateSpec
from tests.replay.segments import make_segment
from tests.rounding import assert_close
from tests.runs import off_policy_run

GAMMA = 0.9
ENV = SimulatedConfig(max_steps=16, environment_state=True)
STATE_SIZE = 5  # of its ``observation.environment_state``


@pytest.fixture(autouse=True)
def few_first_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 20)


def episode(rewards: list[float], *, first: float = 0.0, actions: np.ndarray | None = None) -> Segment:
    """An episode whose environment state counts its decisions from `first`."""
    t = len(rewards)
    counts = first + np.arange(t + 1, dtype=np.float32)
    return make_segment(
        str(first),
        t,
        observations={
            "observation.state": np.zeros((t + 1, 4), np.float32),
            "observation.images.front": np.zeros((t + 1, 32, 32, 3), np.uint8),
            ENVIRONMENT_STATE: counts[:, None],
        },
        task="Match the target",
        latent={},
        actions=np.zeros((t, 4, 2), np.float32) if actions is None else actions,
        reward=np.array(rewards, np.float32),
        steps=np.full(t, 4),
        terminated=True,
        success=rewards[-1] > 0,
    )


def learning(path: Path, algorithm: OffPolicyConfig, model: Any = None, **trainer: Any) -> Any:
    """An update, with a teacher where there is a `model` of the state."""
    torch.manual_seed(0)  # of the critic
    policy, load = PolicyConfig(path=str(path), device="cpu"), load_adapter
    if model is not None:
        load = partial(with_teacher, load_adapter, model, int(isinstance(model, SimulatorStateConfig)))
    config = TrainerConfig(**{"warmup_updates": 0, "value_warmup_updates": 0} | trainer)
    return make_update(load(policy), algorithm, config)


def learner(path: Path, model: Any = None, policy_steps: float = 0.25, **trainer: Any) -> Any:
    """A learner on the state of a simulator that tells one number, or on the state of another `model`."""
    algorithm = ChunkCriticConfig(gamma=GAMMA, policy_steps=policy_steps)
    return learning(path, algorithm, model or SimulatorStateConfig(), **trainer)


def assert_equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name, tensor in expected.items():
        np.testing.assert_array_equal(found[name], tensor, err_msg=name)


def state_of(teacher: Teacher, request: Request) -> torch.Tensor:
    """(1, S), at the beginning of an episode."""
    return teacher.states(*stack_observations([request]), np.zeros(1, np.float32))


def remember(memory: Memory, segment: Segment, **state: np.ndarray) -> None:
    memory.add(segment, np.zeros((len(segment), 4, 2), np.float32), **state)


class TestMemory:
    def test_targets_of_an_episode_by_hand(self):
        memory = Memory(1000, GAMMA, n_step=2)
        remember(memory, episode([0.0, 1.0, 0.0, 2.0]))
        np.testing.assert_allclose(memory["return"], [0.9 + 2 * 0.729, 1 + 2 * 0.81, 1.8, 2.0], rtol=1e-6)
        np.testing.assert_allclose(memory["reward"], [0.9, 1.0, 1.8, 2.0], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(memory["discount"], [0.81, 0.81, 0.0, 0.0], rtol=1e-6)
        assert memory["following"][:2].tolist() == [2, 3]
        assert memory["success"].all()

    def test_the_oldest_rows_leave_and_following_still_points_on(self):
        memory = Memory(10, GAMMA, n_step=2)
        for first in range(0, 100, 10):
            segment = episode([0.0] * 4, first=first)
            remember(memory, segment, state=segment.observations[ENVIRONMENT_STATE][:-1])
            bootstraps = np.flatnonzero(memory["discount"])
            now = memory["state"][bootstraps, 0]
            then = memory["state"][memory["following"][bootstraps], 0]
            np.testing.assert_array_equal(then, now + 2)
        assert len(memory) == 10 and memory.total == 40
        assert sorted(memory["state"][:, 0]) == [72, 73, 80, 81, 82, 83, 90, 91, 92, 93]

    def test_tasks_are_told_apart_and_all_is_restored(self):
        memory = Memory(1000, GAMMA, n_step=2)
        for name in ("open the door", "close the door"):
            segment = episode([0.0, 1.0])
            segment.task = name
            remember(memory, segment)
        again = Memory(1000, GAMMA, n_step=2)
        again.restore(memory.state())
        for each in (memory, again):
            remember(each, episode([1.0]))
        seen, tasks = again.observations(np.array([0, 3, 4]))
        assert tasks == ["open the door", "close the door", "Match the target"]
        assert ENVIRONMENT_STATE not in seen and seen["observation.state"].shape == (3, 4)
        np.testing.assert_array_equal(again["return"], memory["return"])


def slowly(ensemble: Ensemble, member: int, x: np.ndarray) -> np.ndarray:
    """Outputs of one member, in NumPy and float64."""
    h = x.astype(np.float64)
    layers = [
        [p[member].detach().double().numpy() for p in layer]
        for layer in zip(ensemble.weights, ensemble.biases, strict=True)
    ]
    for weight, bias in layers[:-1]:
        h = h @ weight + bias
        h = (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-5)
        h = h / (1 + np.exp(-h))
    return h @ layers[-1][0] + layers[-1][1]


class TestActing:
    def test_buffers_of_the_world_model_are_published(self, tiny_checkpoint: Path):
        config = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
        trained, replica = (with_teacher(load_adapter, LatentConfig(latents=4), 0, config) for _ in range(2))
        for adapter, value in ((trained, 7), (replica, 0)):
            adapter.teacher.model.register_buffer("seen", torch.tensor(value))
        replica.load_trainable(trained.export_trainable())
        assert int(replica.teacher.model.seen) == 7

    def test_whole_episodes_are_the_teachers_once_it_is_ready(self, tiny_checkpoint: Path, monkeypatch: Any):
        monkeypatch.setattr(teacher_module, "NOISE", 0.0)
        config = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
        adapter = with_teacher(load_adapter, SimulatorStateConfig(), STATE_SIZE, config)
        observation = make_environment(ENV).reset(0, "match")
        asked = [
            Request(observation=observation, noise_seed=noise_seed(episode, decision), explore=explore)
            for episode, decision, explore in product(range(200), (0, 1), (True, False))
        ]
        assert not any(map(adapter.teacher.acts, asked)), "an untrained teacher does not act"
        own = adapter.decide(asked[:8], 0)
        adapter.teacher.ready.fill_(1)
        acts = np.array(list(map(adapter.teacher.acts, asked))).reshape(200, 2, 2)
        assert not acts[..., 1].any(), "evaluation is the policy's"
        np.testing.assert_array_equal(acts[:, 0, 0], acts[:, 1, 0])
        assert 70 < acts[:, 0, 0].sum() < 130
        chunk = adapter.teacher(state_of(adapter.teacher, asked[0])).detach()
        wanted = adapter.processing.unnormalise(chunk)[0].numpy()
        for i, (decision, before) in enumerate(zip(adapter.decide(asked[:8], 0), own, strict=True)):
            expected = wanted if acts.reshape(-1)[i] else before.chunk
            np.testing.assert_allclose(decision.chunk, expected, atol=1e-6)

    def test_its_noise_belongs_to_the_request(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(teacher_module, "ACTING_SHARE", 1.0)
        spec, observation = StateSpec({}, 4, STATE_SIZE, (4, 2)), make_environment(ENV).reset(0, "match")
        teacher = Teacher(SimulatorState(spec, SimulatorStateConfig()), chunk=(4, 2))
        teacher.ready.fill_(1)
        asked = [Request(observation=observation, noise_seed=i) for i in range(400)]
        chunk = teacher.replace(torch.zeros(400, 4, 2), asked)
        torch.testing.assert_close(teacher.replace(torch.zeros(3, 4, 2), asked[7:10]), chunk[7:10])
        noise = chunk - teacher(state_of(teacher, asked[0])).detach()
        assert abs(float(noise.std()) - teacher_module.NOISE) < 0.02


def test_a_step_of_critic_and_teacher_by_hand(tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    """On all rows of a memory of two episodes, in NumPy; noise is 1 throughout."""
    torch.manual_seed(0)
    update = learner(tiny_checkpoint, value_warmup_updates=9)
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 6, 4, 2)).astype(np.float32)
    rewards = [0.5, 0.0, -1.0, 0.0, 0.0]
    update.step([episode([*rewards, last], actions=a) for last, a in zip((1.0, -9.0), actions, strict=True)])
    memory, teacher = update.memory, update.teacher
    update._scale_states()
    with torch.no_grad():
        for weight in (update.critic.network.weights[-1], update.slow.network.weights[-1]):
            weight.mul_(100)
        update.slow.network.biases[-1].add_(0.5)
        teacher.low.copy_(torch.tensor([-2.0, 0.5]))
    every = np.arange(12)
    monkeypatch.setattr(chunk_critic, "drawn", lambda among, _: among)
    monkeypatch.setattr(torch, "randn_like", torch.ones_like)
    losses: dict[str, float] = {}
    monkeypatch.setattr(
        update, "_descend", lambda name, loss, **_: losses.update({name: float(loss.detach())}) or 7.0
    )

    def scaled(rows: np.ndarray) -> np.ndarray:
        states = memory["state"]
        return ((states[rows] - states.mean(0)) / np.maximum(states.std(0), 1e-3)).clip(-10, 10)

    def planned(rows: np.ndarray) -> np.ndarray:
        share = (1 + np.tanh(slowly(teacher.network, 0, scaled(rows))).reshape(-1, 4, 2)) / 2
        return np.array([-2.0, 0.5]) * (1 - share) + share  # the range of the actions

    def valued(critic: chunk_critic.Critic, rows: np.ndarray, chunk: np.ndarray) -> np.ndarray:
        seen = np.concatenate([scaled(rows), chunk.reshape(len(rows), 8)], 1)
        return np.stack([slowly(critic.network, i, seen)[:, 0] for i in range(6)])

    before = [p.detach().clone() for p in update.slow.parameters()]
    following = memory["following"][every]
    ahead = valued(update.slow, following, planned(following) + 0.1)
    bootstrap = ahead.mean(0) - ahead.std(0, ddof=1)
    bounds = float(np.quantile(bootstrap, 0.3)), float(np.quantile(bootstrap, 0.7))
    target = memory["reward"] + memory["discount"] * bootstrap.clip(*bounds)
    q = valued(update.critic, every, memory["chunk"])
    error = np.square(q - (0.75 * target + 0.25 * memory["return"])).mean(1)
    metrics = update._critic_step(bounds)
    assert losses["critic"] == pytest.approx(error.sum(), rel=1e-5)
    unexplained = (memory["return"] - q.mean(0)).var() / memory["return"].var()
    by_hand = {"value_loss": error.mean(), "value_mean": q.mean(), "explained_variance": 1 - unexplained}
    by_hand |= {"return_mean": memory["return"].mean(), "value_grad_norm": 7.0}
    assert metrics == pytest.approx(by_hand, rel=1e-3)
    for old, new, fast in zip(before, update.slow.parameters(), update.critic.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.01 * (fast - old))

    won = np.arange(6)
    metrics = update._teacher_step(every, won)
    q = valued(update.critic, every, planned(every))
    gap = np.square(planned(won) - memory["chunk"][won]).mean() / 0.3**2
    gain = (q.mean(0) - q.std(0, ddof=1)).mean() / abs(q).mean()
    assert losses["teacher"] == pytest.approx(0.5 * gap - gain, rel=1e-3)
    by_hand = {"teacher_value": q.mean(), "disagreement": q.std(0, ddof=1).mean(), "distance": gap}
    assert metrics == pytest.approx(by_hand, rel=1e-3)

    features = torch.randn(12, 3, update.adapter.model.width)
    encoded = Encoded(features=features, mask=torch.tensor([[1.0, 1.0, 0.0]]).expand(12, 3), context=None)
    read = update.reader(features[:, :2].mean(1)).detach().numpy()
    found = update.losses(every, encoded, torch.zeros(12))["perception_loss"]
    assert float(found.detach()) == pytest.approx(0.5 * np.square(read - scaled(every)).mean(), rel=1e-3)


def test_a_latent_state_is_computed_anew_when_its_model_changes(tiny_checkpoint: Path, monkeypatch: Any):
    monkeypatch.setattr(LatentModel, "first_steps", 8)
    monkeypatch.setattr(chunk_critic, "MOST_STATE_STEPS", 5)
    monkeypatch.setattr(chunk_critic, "LEAST_TRANSITIONS", 4)
    monkeypatch.setattr(chunk_critic, "REFRESH", 12)
    torch.manual_seed(0)
    update, rng = learner(tiny_checkpoint, model=LatentConfig(latents=4)), np.random.default_rng(0)

    def played() -> Segment:
        segment = episode([0.0, 0.0, 1.0], actions=rng.uniform(-1, 1, (3, 4, 2)).astype(np.float32))
        del segment.observations[ENVIRONMENT_STATE]
        segment.observations["observation.images.front"] = rng.integers(0, 256, (4, 32, 32, 3), np.uint8)
        segment.time_limit = 16
        return segment

    metrics = update.step([played()])
    assert not any(name.startswith("world_model") for name in metrics), "two transitions are too few"
    replaced = []
    for _ in range(7):
        acting = [parameter.detach().clone() for parameter in update.teacher.model.parameters()]
        update.step([played(), played()])
        now = list(update.teacher.model.parameters())
        replaced.append(any(not torch.equal(old, new) for old, new in zip(acting, now, strict=True)))
        assert bool(update.teacher.ready) == (update.version > 2), "once its 8 first steps are made"
        seen = update.memory.observations(np.arange(len(update.memory)))
        states = update.teacher.states(*seen, update.memory["elapsed"])
        torch.testing.assert_close(torch.from_numpy(update.memory["state"]), states)
    assert replaced == [True, True, False, True, False, True, False], "every 12 decisions, 6 an update"
    assert update.memory["state"][:3, 4 + 4].tolist() == [0, 0.25, 0.5]
    assert update.state_learner.count == 8 + 5 * 3


def test_success_is_told_by_who_acted(tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    update = learner(tiny_checkpoint, value_warmup_updates=9)
    segments = [episode([float(won)]) for won in (1, 1, 0, 0)]
    for seed, segment in enumerate(segments):
        segment.origin = segment.origin._replace(seed=seed)
    monkeypatch.setattr(update.teacher, "plays", lambda episode: episode > 0)
    metrics = update.step(segments)
    assert (metrics["policy_success"], metrics["teacher_success"]) == (0.5, 0.0), "it is not ready"
    update.teacher.ready.fill_(1)
    metrics = update.step(segments)
    found = metrics["policy_success"], metrics["teacher_success"]
    assert found == pytest.approx((3 / 5, 1 / 3))


def test_nothing_is_learnt_before_the_first_success(tiny_checkpoint: Path):
    update = learner(tiny_checkpoint, policy_steps=1.0)
    before = update.adapter.export_trainable()
    assert "imitation_loss" not in update.step([episode([0.0, 0.0])])
    assert_equal(update.adapter.export_trainable(), before)
    assert "imitation_loss" in update.step([episode([0.0, 1.0])])


def test_a_task_without_a_success_is_not_taught(tiny_checkpoint: Path):
    update = learner(tiny_checkpoint)
    update.remember(episode([0.0, 1.0]))
    update.remember(replace(episode([0.0, 0.0, 0.0]), task="Another task"))
    update.remember(episode([0.0]))
    assert update.imitable().tolist() == [0, 1, 5]
    update.remember(replace(episode([1.0]), task="Another task"))
    assert len(update.imitable()) == 7


@pytest.mark.parametrize("causal", [True, False])
def test_imitation_is_flow_matching(causal: bool):
    """For the field that leads straight to the chunk, padded with its last action, the loss is 0.

    For one that is off by 1 in the row that is not executed it is a quarter, or 0 if that row does not count.
    """
    shape = FlowShape(num_steps=3, chunk_size=4, executed=3, padded_dim=5, action_dim=2, causal=causal)
    target = torch.zeros(64, 4, 5)
    target[:, :3, :2] = torch.randn(64, 3, 2)
    target[:, 3] = target[:, 2]
    family = FlowFamily(SimpleNamespace(shape=shape), FlowSamplerConfig())
    wrong = torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None]
    for off, expected in ((0.0, 0.0), (1.0, 1.0), (wrong, 0.0 if causal else 0.25)):
        velocity = lambda x, t, off=off: (x - target) / t[:, None, None] + off  # noqa: E731
        encoded = Encoded(features=torch.zeros(64, 1, 1), mask=torch.ones(64, 1), context=velocity)
        loss = family.imitation_loss(encoded, target[:, :3, :2])
        torch.testing.assert_close(loss, torch.full((64,), expected), atol=1e-3, rtol=1e-3)


def first_action(update: OffPolicyUpdate) -> float:
    """Mean over noise of the first number that the policy does without exploring."""
    seen: Any = {name: array[0] for name, array in episode([0.0]).observations.items()}
    seen["task"] = "Match the target"
    asked = [Request(observation=seen, noise_seed=i, explore=False) for i in range(64)]
    return float(np.mean([decision.chunk[0, 0] for decision in update.adapter.decide(asked, 0)]))


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "updates", "least"), [("fp32", 6, 0.2), ("bf16", 4, 0.0)])
def test_teacher_and_policy_go_where_the_critic_leads(
    precision: str, updates: int, least: float, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
):
    """Reward is how far the first action goes up; the state says nothing. bf16 is emulated, and slow."""
    torch.manual_seed(0)
    monkeypatch.setattr(chunk_critic, "IMITATION", 0.0)
    monkeypatch.setattr("accerl_lerobot.algorithms.off_policy.POLICY_BATCH", 16)
    algorithm = ChunkCriticConfig(critic_steps=4.0, policy_steps=0.5)
    rates = {"lr": 1e-3, "value_lr": 1e-3, "value_warmup_updates": 2}
    update = learning(tiny_checkpoint, algorithm, SimulatorStateConfig(), **rates)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: precision == "bf16")
    automatic = PolicyConfig(path=str(tiny_checkpoint), device="cpu", precision="auto")
    update.adapter.precision, cast = load_adapter(automatic).precision, set()
    update.critic.register_forward_hook(lambda *_: cast.add(torch.is_autocast_enabled("cpu")))
    rng, before = np.random.default_rng(0), first_action(update)
    for _ in range(updates):
        actions = rng.uniform(-1, 1, (32, 1, 4, 2)).astype(np.float32)
        metrics = update.step([episode([(1 + float(a[0, 0, 0])) / 2], actions=a) for a in actions])
        assert bool(update.teacher.ready) == (update.version > 2)
    assert cast == {precision == "bf16"} and np.isfinite(list(metrics.values())).all()
    assert first_action(update) > before + least
    assert metrics["memory_decisions"] == updates * 32
    assert precision == "bf16" or metrics["explained_variance"] > 0.5


def test_blocks_that_forget_compute_again_and_learn_the_same(tiny_checkpoint: Path):
    counts, weights, algorithm = [], [], SelfImitationConfig(policy_steps=1.0)
    for forget in (False, True):
        update = learning(tiny_checkpoint, algorithm, activation_checkpointing=forget)
        calls: list[None] = []
        for module in update.adapter.policy.modules():
            module.register_forward_hook(lambda *_, calls=calls: calls.append(None))
        torch.manual_seed(0)
        update.step([episode([1.0])])
        counts.append(len(calls))
        weights.append(update.adapter.export_trainable())
    assert counts[1] > counts[0]
    for name, mine in weights[0].items():
        assert_close(mine, weights[1][name])


def test_weights_by_hand():
    advantage = torch.tensor([-1.0, 0.0, 0.5, 2.0, 1e6])
    expected = [math.exp(-2), 1, math.exp(1), 20, 20]
    np.testing.assert_allclose(weights(advantage, beta=0.5), expected, rtol=1e-6)
    np.testing.assert_allclose(weights(advantage, beta=math.inf), 1)


def test_a_step_weighs_each_row_by_its_advantage(tiny_checkpoint: Path):
    """Two decisions with known returns, a critic that says 0, and imitation losses of 1 and 3."""
    update = learning(tiny_checkpoint, AWRConfig(policy_steps=1.0, beta=0.5), lr=0.0, value_lr=0.0)
    for value, reward in ((1.0, 0.0), (3.0, 1.0)):
        update.remember(episode([reward], actions=np.full((1, 4, 2), value, np.float32)))
    losses = update.adapter.processing.normalise(torch.tensor([1.0, 3.0])[:, None, None].expand(2, 4, 2))
    update.adapter.family.imitation_loss = lambda encoded, chunk: (
        chunk[:, 0, 0] + 0 * encoded.features.sum((1, 2))
    )
    rows = np.array([0, 1, 1])
    for _ in range(2):
        encoded = update.adapter.encode(*update.memory.observations(rows))
        found = update.losses(rows, encoded, torch.tensor([1.0, 2.0, 3.0]))
        square = 2 / 3  # the mean square of the returns 0, 1, 1 stays the same
        weight = np.minimum(np.exp(np.array([0.0, 1.0, 1.0]) / math.sqrt(square) / 0.5), 20.0)
        assert found["imitation_loss"].item() == pytest.approx(weight @ [1, 2, 3] / 3, rel=1e-5)
        assert found["value_loss"].item() == pytest.approx(2 / 3)
    metrics = update.learn(1)
    low, high = float(losses[0, 0, 0]), float(losses[1, 0, 0])
    assert min(low, 20 * high) < metrics["imitation_loss"] < max(low, 20 * high)


def test_the_critic_learns_returns_and_leaves_the_policy_alone(tiny_checkpoint: Path):
    algorithm = AWRConfig(policy_steps=1.0)
    update = learning(tiny_checkpoint, algorithm, lr=1e-2, value_lr=3e-2, value_warmup_updates=60)
    before = update.adapter.export_trainable()
    update.remember(episode([0.0, 0.0, 1.0]))
    for _ in range(60):
        metrics = update.learn(1)
        update.version += 1
    after = update.adapter.export_trainable()
    changed = {name.split(".")[0] for name in before if not np.array_equal(before[name], after[name])}
    assert changed == {"value_head"} and metrics["value_loss"] < 0.05


@pytest.mark.parametrize("make", [learner, partial(learning, algorithm=AWRConfig())])
def test_what_was_learnt_is_restored_to_the_last_bit(make: Callable[[Path], Any], tiny_checkpoint: Path):
    """On a latent state: see `test_resume_exact`."""

    def steps(update: OffPolicyUpdate, seed: int) -> dict[str, float]:
        torch.manual_seed(seed)
        actions = np.random.default_rng(seed).uniform(-1, 1, (8, 3, 4, 2)).astype(np.float32)
        return update.step([episode([0.0, 0.0, float(a[0, 0, 0] > 0)], actions=a) for a in actions])

    one, other = make(tiny_checkpoint), make(tiny_checkpoint)
    steps(one, 0)
    other.adapter.load_trainable(one.adapter.export_trainable())
    other.restore(one.state())
    assert steps(one, 1) == steps(other, 1)
    assert_equal(other.adapter.export_trainable(), one.adapter.export_trainable())


def test_a_step_imitates_successes_only(tiny_checkpoint: Path):
    update = learning(tiny_checkpoint, SelfImitationConfig(policy_steps=0.25), lr=0.0)
    adapter = update.adapter
    adapter.family.imitation_loss = lambda encoded, chunk: chunk[:, 0, 0] + 0 * encoded.features.sum((1, 2))
    values = ((1.0, 1.0), (3.0, 1.0), (100.0, 0.0), (200.0, 0.0))
    segments = [episode([won], actions=np.full((1, 4, 2), value, np.float32)) for value, won in values]
    loss = update.step(segments)["imitation_loss"]
    low, high = (adapter.processing.normalise(torch.full((1, 4, 2), v))[0, 0, 0] for v in (1.0, 3.0))
    assert low < loss < high


def test_less_memory_gives_the_same_step(tiny_checkpoint: Path):
    def step(**options: Any) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        torch.manual_seed(0)
        update = learning(tiny_checkpoint, SelfImitationConfig(policy_steps=0.25), lr=1e-3, **options)
        update.adapter.family.imitation_loss = lambda encoded, _: encoded.features.square().mean((1, 2))
        segment = episode([0.0, 0.0, 0.0, 1.0])
        segment.observations["observation.state"][:, 0] = np.arange(5)
        return update.step([segment]), update.adapter.export_trainable()

    (metrics, weights), (other, others) = step(), step(micro_batch=50)
    assert other == pytest.approx(metrics, rel=1e-5)
    for name, tensor in weights.items():
        np.testing.assert_allclose(others[name], tensor, rtol=1e-4, atol=1e-6)


def test_what_is_not_finite_is_skipped_and_ends_the_run(tiny_checkpoint: Path):
    update = learner(tiny_checkpoint, policy_steps=1.0)
    before = update.adapter.export_trainable()
    torch.nn.init.constant_(update.teacher.network.biases[0], math.nan)
    with pytest.raises(NonFiniteError, match="5 steps in a row"):
        update.step([episode([0.0, 0.0, 0.0, 1.0])])
    policy = {name: tensor for name, tensor in before.items() if name.startswith("policy.")}
    assert_equal(update.adapter.export_trainable(), policy)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (
            {"env": SimulatedConfig(), "world_model": SimulatorStateConfig()},
            "world_model.type='simulator': .*add env.environment_state",
        ),
        (
            {"algorithm": SelfImitationConfig(), "world_model": LatentConfig()},
            "='latent': .*use chunk_critic",
        ),
        ({"env": SimulatedConfig(max_steps=4)}, "='latent': an episode is one .*lower policy.n_action_steps"),
        ({"replay": ReplayConfig(samples_per_insert=2.0)}, "replay.samples_per_insert=2.0: .*use 1.0"),
        ({"trainer": TrainerConfig(ranks=2)}, "trainer.ranks=2: .*use 1"),
        ({"rollout": RolloutConfig(segment_length=3)}, "rollout.segment_length=3: .*use at least 4"),
    ],
)
def test_what_it_cannot_learn_from_is_refused(tiny_checkpoint: Path, sections: dict[str, Any], message: str):
    policy = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
    with pytest.raises(InputError, match=message):
        check_start(off_policy_run(tiny_checkpoint, **{"env": ENV, "policy": policy} | sections))
