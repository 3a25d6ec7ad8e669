# SPDX-License-Identifier: Apache-2.0
"""The off-policy chunk critic: its memory and networks against slow ones by hand, and a run that learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import ChunkCriticConfig, SelfImitationConfig
from accerl_lerobot.engine.preflight import check_start
from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, TASK, Origin, Request, Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import FlowSamplerConfig, PolicyConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.flow import FlowContext, FlowFamily, FlowShape
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.replay import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.chunk_critic import MEMBERS, ChunkCriticUpdate, Critic
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.memory import CODE, Memory
from accerl_lerobot.trainer.nonfinite import NonFiniteError
from accerl_lerobot.trainer.off_policy import OffPolicyUpdate
from tests.runs import tiny_run

GAMMA = 0.9
ENV = SimulatedConfig(max_steps=16, environment_state=True)


def episode(
    rewards: list[float], *, first: float = 0.0, latent: dict[str, np.ndarray] | None = None
) -> Segment:
    """An episode whose environment state counts its decisions from `first`."""
    t = len(rewards)
    counts = first + np.arange(t + 1, dtype=np.float32)
    return Segment(
        observations={
            "observation.state": np.zeros((t + 1, 4), np.float32),
            "observation.images.front": np.zeros((t + 1, 32, 32, 3), np.uint8),
            ENVIRONMENT_STATE: counts[:, None],
        },
        task="Match the target",
        latent=latent or {"path": np.zeros((t, 2, 4, 2), np.float32)},
        log_prob=np.zeros((t, 4), np.float32),
        value=np.zeros(t, np.float32),
        actions=np.zeros((t, 4, 2), np.float32),
        reward=np.array(rewards, np.float32),
        version=np.zeros(t, np.int64),
        steps=np.full(t, 4),
        terminated=True,
        truncated=False,
        success=rewards[-1] > 0,
        key=str(first),
        origin=Origin("match", 0, 0),
        episode={"return": sum(rewards)},
    )


def chunks(segment: Segment) -> np.ndarray:
    return np.zeros((len(segment), 4, 2), np.float32)


def learner(
    checkpoint: Path, algorithm: ChunkCriticConfig | None = None, **trainer: Any
) -> ChunkCriticUpdate:
    adapter = load_adapter(PolicyConfig(path=str(checkpoint), device="cpu"))
    config = TrainerConfig(**{"warmup_updates": 0, "value_warmup_updates": 0} | trainer)
    return ChunkCriticUpdate(adapter, algorithm or ChunkCriticConfig(), config)


class TestMemory:
    def test_targets_of_an_episode_by_hand(self):
        memory = Memory(1000, GAMMA, n_step=2)
        memory.add(episode([0.0, 1.0, 0.0, 2.0]), chunks(episode([0.0] * 4)))
        np.testing.assert_allclose(memory["return"], [0.9 + 2 * 0.729, 1 + 2 * 0.81, 1.8, 2.0], rtol=1e-6)
        np.testing.assert_allclose(memory["reward"], [0.9, 1.0, 1.8, 2.0], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(memory["discount"], [0.81, 0.81, 0.0, 0.0], rtol=1e-6)
        assert memory["following"][:2].tolist() == [2, 3]
        assert memory["success"].all()

    def test_the_oldest_rows_leave_and_following_still_points_on(self):
        memory = Memory(10, GAMMA, n_step=2)
        for first in range(0, 100, 10):
            segment = episode([0.0] * 4, first=first)
            memory.add(segment, chunks(segment))
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
            memory.add(segment, chunks(segment))
        assert memory["state"].shape == (4, 1 + CODE)
        assert (memory["state"][0, 1:] != memory["state"][2, 1:]).any()
        again = Memory(1000, GAMMA, n_step=2)
        again.restore(memory.state())
        for each in (memory, again):
            each.add(episode([1.0]), chunks(episode([1.0])))
        seen, tasks = again.observations(np.array([0, 3, 4]))
        assert tasks == ["open the door", "close the door", "Match the target"]
        assert ENVIRONMENT_STATE not in seen and seen["observation.state"].shape == (3, 4)
        np.testing.assert_array_equal(again["state"], memory["state"])

    def test_a_part_of_an_episode_is_refused(self):
        segment = episode([0.0, 0.0])
        segment.episode = {}
        with pytest.raises(InputError, match=r"rollout\.segment_length=2: .*whole episodes"):
            Memory(1000, GAMMA, n_step=2).add(segment, chunks(segment))


def test_the_ensemble_equals_a_slow_one():
    torch.manual_seed(0)
    critic = Critic(state=3, chunk=8)
    critic.mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
    critic.std.copy_(torch.tensor([0.5, 1.0, 2.0]))
    state, chunk = torch.randn(5, 3), torch.randn(5, 4, 2)
    x = np.concatenate([(state.numpy() - [1, 2, 3]) / [0.5, 1, 2], chunk.numpy().reshape(5, 8)], 1)
    for member in range(MEMBERS):
        h = x
        weights = [w[member].detach().double().numpy() for w in critic.weights]
        for weight in weights[:-1]:
            h = h @ weight
            h = (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-5)
            h = h / (1 + np.exp(-h))
        expected = (h @ weights[-1])[:, 0]
        np.testing.assert_allclose(critic(state, chunk)[member].detach(), expected, rtol=1e-4, atol=1e-5)
    two = torch.tensor([4, 1])
    torch.testing.assert_close(critic(state, chunk, two), critic(state, chunk)[two])


def requests(adapter: LeRobotAdapter, count: int) -> list[Request]:
    world = make_world(ENV)
    return [Request(observation=world.reset(i, "match"), noise_seed=i) for i in range(count)]


def test_what_is_executed_and_proposed_is_what_the_policy_does(tiny_checkpoint: Path):
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu"))
    asked = requests(adapter, 3)
    decided = adapter.decide(asked, 0)
    latent = [d.latent for d in decided]
    stacked = {k: torch.from_numpy(np.stack([each[k] for each in latent])) for k in latent[0]}
    executed = adapter.processing.unnormalise(adapter.family.executed(stacked))
    np.testing.assert_array_equal(executed, np.stack([d.chunk for d in decided]))

    rest = adapter.decide(
        [Request(observation=r.observation, noise_seed=r.noise_seed, explore=False) for r in asked], 0
    )
    x0 = torch.from_numpy(np.stack([d.latent["path"][0] for d in rest]))
    seen = {k: np.stack([r.observation[k] for r in asked]) for k in asked[0].observation if k != TASK}
    proposed = adapter.family.propose(adapter.encode(seen, ["Match the target"] * 3), x0)
    assert proposed.requires_grad
    np.testing.assert_allclose(
        adapter.processing.unnormalise(proposed.detach()), np.stack([d.chunk for d in rest]), atol=1e-6
    )
    del seen[ENVIRONMENT_STATE]
    blind = adapter.family.propose(adapter.encode(seen, ["Match the target"] * 3), x0)
    assert torch.equal(blind, proposed), "the policy does not read the simulator's state"


def test_imitation_is_flow_matching():
    """For the field that leads straight to the chunk the loss is 0; for one that is off by 1 it is 1."""
    shape = FlowShape(num_steps=3, chunk_size=4, executed=3, padded_dim=5, action_dim=2)
    target = torch.zeros(64, 4, 5)
    target[:, :3, :2] = torch.randn(64, 3, 2)

    class Fake:
        pass

    model: Any = Fake()
    model.shape = shape
    family = FlowFamily(model, FlowSamplerConfig())
    for off in (0.0, 1.0):
        velocity = lambda x, t, off=off: (x - target) / t[:, None, None] + off  # noqa: E731
        encoded = Encoded(
            features=torch.zeros(64, 1, 1), mask=torch.ones(64, 1), context=FlowContext(velocity=velocity)
        )
        loss = family.imitation_loss(encoded, target[:, :3, :2])
        torch.testing.assert_close(loss, torch.full((64,), off), atol=1e-3, rtol=1e-3)


def test_the_policy_climbs_the_critic(tiny_checkpoint: Path):
    """Reward is how far the first action of a chunk goes up; the state says nothing."""
    torch.manual_seed(0)
    algorithm = ChunkCriticConfig(critic_steps=2.0, policy_steps=0.2, imitation=0.0, anchor=0.1)
    update = learner(tiny_checkpoint, algorithm, lr=3e-4, value_lr=1e-3, value_warmup_updates=4)
    rng = np.random.default_rng(0)

    def proposed() -> float:
        return float(update.memory["proposal"][:64, 0, 0].mean())

    for _ in range(12):
        segments = []
        for _ in range(32):
            path = rng.standard_normal((1, 2, 4, 2)).astype(np.float32)
            reward = float(path[0, 1, 0, 0] > 0)
            segments.append(episode([reward], latent={"path": path}))
        metrics = update.step(segments)
        if update.version == 1:
            before = proposed()
    assert proposed() > before + 0.3
    assert metrics["explained_variance"] > 0.5 and metrics["gain"] > 0
    assert metrics["memory_decisions"] == 12 * 32


@pytest.mark.parametrize("known", [True, False], ids=["with the simulator's state", "without"])
def test_self_imitation_goes_where_successes_are(tiny_checkpoint: Path, known: bool):
    """Success is a chunk whose first action goes up; half of the chunks do, by chance."""
    torch.manual_seed(0)
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu"))
    config = TrainerConfig(warmup_updates=0, value_warmup_updates=0, lr=1e-3)
    update = OffPolicyUpdate(adapter, SelfImitationConfig(policy_steps=0.5), config)
    rng = np.random.default_rng(0)

    def proposed() -> float:
        observations, tasks = update.memory.observations(np.zeros(64, int))
        with torch.no_grad():
            encoded = adapter.encode(observations, tasks)
            noise = torch.randn(64, *adapter.family.noise_size())
            return float(adapter.family.propose(encoded, noise)[:, 0, 0].mean())

    for _ in range(6):
        segments = []
        for _ in range(32):
            path = rng.standard_normal((1, 2, 4, 2)).astype(np.float32)
            segments.append(episode([float(path[0, 1, 0, 0] > 0)], latent={"path": path}))
            if not known:
                del segments[-1].observations[ENVIRONMENT_STATE]
        metrics = update.step(segments)
        if update.version == 1:
            first, before = metrics["imitation_loss"], proposed()
    assert metrics["imitation_loss"] < first
    mean_of_successes = (2 / np.pi) ** 0.5
    assert proposed() == pytest.approx(mean_of_successes, abs=0.3) and proposed() > before + 0.1


def test_a_step_imitates_successes_only(tiny_checkpoint: Path):
    """The loss of a step equals the family's, averaged over those rows of its batch that succeeded."""
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu"))
    config = TrainerConfig(warmup_updates=0, value_warmup_updates=0, lr=0.0, weight_decay=0.0)
    update = OffPolicyUpdate(adapter, SelfImitationConfig(policy_steps=0.25), config)
    family = adapter.family
    family.imitation_loss = lambda encoded, chunk: chunk[:, 0, 0] + 0 * encoded.features.sum((1, 2))
    segments = []
    for value, reward in ((1.0, 1.0), (3.0, 1.0), (100.0, 0.0), (200.0, 0.0)):
        path = np.full((1, 2, 4, 2), value, np.float32)
        segments.append(episode([reward], latent={"path": path}))
    loss = update.step(segments)["imitation_loss"]
    assert 1.0 < loss < 3.0


def test_without_an_anchor_the_policy_moves_further(tiny_checkpoint: Path):
    moved = []
    for anchor in (0.0, 10.0):
        torch.manual_seed(0)
        update = learner(tiny_checkpoint, ChunkCriticConfig(anchor=anchor, policy_steps=0.5), lr=3e-4)
        rng = np.random.default_rng(0)
        for _ in range(4):
            paths = rng.standard_normal((16, 1, 2, 4, 2)).astype(np.float32)
            segments = [episode([float(p[0, 1, 0, 0] > 0)], latent={"path": p}) for p in paths]
            metrics = update.step(segments)
        moved.append(metrics["distance"])
    assert moved[0] > 2 * moved[1]


def test_the_critic_computes_in_fp32_beside_a_policy_in_bf16(
    tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
):
    seen = set()
    forward = Critic.forward

    def spy(self: Critic, *inputs: Any) -> torch.Tensor:
        q = forward(self, *inputs)
        seen.add((torch.is_autocast_enabled("cpu"), q.dtype))
        return q

    monkeypatch.setattr(Critic, "forward", spy)
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu", precision="bf16"))
    config = TrainerConfig(warmup_updates=0, value_warmup_updates=0)
    update = ChunkCriticUpdate(adapter, ChunkCriticConfig(policy_steps=0.5), config)
    metrics = update.step([episode([0.0, 0.0, 0.0, 1.0])])
    assert np.isfinite(metrics["policy_loss"]) and seen == {(False, torch.float32)}


def test_what_is_not_finite_is_skipped_and_ends_the_run(tiny_checkpoint: Path):
    update = learner(tiny_checkpoint, ChunkCriticConfig(policy_steps=1.0), max_nonfinite=3)
    before = update.adapter.export_trainable()
    with pytest.raises(NonFiniteError, match="3 steps in a row"):
        update.step([episode([0.0, 0.0, 0.0, float("nan")])])
    after = update.adapter.export_trainable()
    assert all(np.array_equal(before[name], after[name]) for name in before)


ROOMS: dict[str, Any] = {
    "env": ENV,
    "algorithm": ChunkCriticConfig(),
    "rollout": RolloutConfig(worlds=4, segment_length=4),
    "replay": ReplayConfig(capacity=64, min_decisions=16, ahead=32, samples_per_insert=1),
}


@pytest.mark.parametrize(
    ("rooms", "message"),
    [
        ({"env": SimulatedConfig()}, r"algorithm\.type='chunk_critic': .*add --env\.environment_state=true"),
        ({"replay": ReplayConfig(samples_per_insert=2.0)}, r"replay\.samples_per_insert=2\.0: .*use 1\.0"),
        ({"rollout": RolloutConfig(time_limit="truncate")}, r"rollout\.time_limit='truncate': .*use fail"),
        ({"rollout": RolloutConfig(group_size=4)}, r"rollout\.group_size=4: .*use 0"),
        ({"trainer": TrainerConfig(ranks=2, sharding="ddp")}, r"trainer\.ranks=2: .*use 1"),
        ({"rollout": RolloutConfig(segment_length=3)}, r"rollout\.segment_length=3: .*use at least 4"),
        (
            {"policy": {"sampler": FlowSamplerConfig(stochastic="one")}},
            r"policy\.sampler\.type='flow': .*stochastic=last",
        ),
    ],
)
def test_what_it_cannot_learn_from_is_refused(tiny_checkpoint: Path, rooms: dict[str, Any], message: str):
    policy = PolicyConfig(path=str(tiny_checkpoint), device="cpu", **rooms.pop("policy", {}))
    with pytest.raises(InputError, match=message):
        check_start(tiny_run(tiny_checkpoint, **ROOMS | {"policy": policy} | rooms))
