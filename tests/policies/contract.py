# SPDX-License-Identifier: Apache-2.0
"""The contract of every policy and family, in numbers; a test class inherits it for its own checkpoint."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import SamplerConfig
from tests.policies.tiny import (
    adapter_at,
    check_batches,
    check_gradient,
    check_journey,
    log_ratio,
    perturb,
    requests,
    stored,
)


def label(config: SamplerConfig) -> str:
    return "-".join(str(v) for v in vars(config).values() if v is not None)


class PolicyContract:
    """Set `samplers` and the like, and override `write`."""

    samplers: ClassVar[list[Any]]
    parts: ClassVar[tuple[str, ...]]
    """Parts of parameter names, whose gradients are compared with finite differences."""
    shape: ClassVar[tuple[int, int]] = (3, 2)
    """Shape of a chunk: executed rows, action dims."""
    image: ClassVar[int] = 16
    slack: ClassVar[float] = 0.02
    """Relative error of finite differences: ReLUs bend, and smaller steps drown in rounding."""
    one_token: ClassVar[bool] = False
    """True if the critic's features are one token, among which an attention query has nothing to choose."""

    @staticmethod
    def write(directory: Path) -> Path:
        raise NotImplementedError

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        if "config" in metafunc.fixturenames:
            metafunc.parametrize("config", self.samplers, ids=label)

    @pytest.fixture(scope="class")
    def path(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return self.write(tmp_path_factory.mktemp("policy") / "pretrained_model")

    @pytest.fixture(scope="class")
    def loaded(self, path: Path) -> LeRobotAdapter:
        return adapter_at(path)

    @pytest.fixture
    def adapter(self, loaded: LeRobotAdapter) -> LeRobotAdapter:
        """One of its own for each test."""
        return copy.deepcopy(loaded)

    def exploring(self, adapter: LeRobotAdapter, config: SamplerConfig) -> LeRobotAdapter:
        family = type(adapter.family)(adapter.model, config)
        return LeRobotAdapter(adapter.policy, adapter.processing, adapter.model, family, adapter.value_head)

    def ask(self, count: int, **options: Any) -> list[Request]:
        return requests(count, image=self.image, **options)

    def test_decisions_and_ratio_one_do_not_depend_on_the_batch(self, adapter: LeRobotAdapter, config: Any):
        adapter, asked = self.exploring(adapter, config), self.ask(40)
        perturb(adapter, 0.1)
        for one in check_batches(adapter, asked, few=8):
            assert one.chunk.shape == self.shape and one.chunk.dtype == np.float32 and one.version == 7
            assert one.log_prob.shape == (adapter.actions,) and one.log_prob.dtype == np.float32

    def test_no_global_generator_is_read_or_moved(self, adapter: LeRobotAdapter, config: Any):
        adapter, asked = self.exploring(adapter, config), self.ask(6)
        together = adapter.decide(asked, 7)
        torch.manual_seed(1)
        state = torch.get_rng_state()
        assert pickle.dumps(adapter.decide(asked, 7)) == pickle.dumps(together), "no global generator is read"
        adapter.self_check(*stack_observations(asked))
        assert torch.equal(torch.get_rng_state(), state), "nor moved"

    def test_seed_and_observation_matter(self, adapter: LeRobotAdapter):
        first = self.ask(1)[0]
        others = [Request(observation=first.observation, noise_seed=99)]
        for key in adapter.policy.config.input_features:
            changed = first.observation | {key: np.zeros_like(first.observation[key])}
            others.append(Request(observation=changed, noise_seed=first.noise_seed))
        chunk = adapter.decide([first], 0)[0].chunk
        for other in others:
            assert np.abs(adapter.decide([other], 0)[0].chunk - chunk).max() > 1e-3

    def test_ratio_one_after_save_and_load_and_a_segment_s_journey(
        self, adapter: LeRobotAdapter, path: Path, tmp_path: Path, config: Any
    ):
        adapter, asked = self.exploring(adapter, config), self.ask(7)
        perturb(adapter, 0.1)
        check_journey(adapter, asked, path, tmp_path / "saved")
        untouched = self.exploring(adapter_at(path), config)
        assert log_ratio(untouched, asked[:6], adapter.decide(asked[:6], 0)).abs().max() > 1e-3

    def test_gradients_reach_every_trainable_parameter(self, adapter: LeRobotAdapter, config: Any):
        adapter, asked = self.exploring(adapter, config), self.ask(8)
        perturb(adapter, 0.1)  # heads start at zero, where only their output layers have a gradient
        latent, _ = stored(adapter.decide(asked, 0))
        evaluation = adapter.evaluate(*stack_observations(asked), latent)
        (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
        parameters = adapter.trainable()
        silent = [k for k, p in parameters.items() if p.grad is None or not p.grad.abs().max() > 0]
        assert silent == ["value_head.query"] * self.one_token
        assert all(any(part in k for k in parameters) for part in self.parts)

    def test_log_prob_s_gradient_against_finite_differences(self, adapter: LeRobotAdapter, config: Any):
        adapter, asked = self.exploring(adapter, config), self.ask(8)
        perturb(adapter, 0.1)
        decisions = adapter.decide(asked, 0)
        perturb(adapter, 0.02, seed=1)
        check_gradient(adapter, asked, decisions, self.parts, step=0.005, slack=self.slack)

    def test_published_weights_make_the_same_policy(self, loaded: LeRobotAdapter):
        trainer, reader, asked = copy.deepcopy(loaded), copy.deepcopy(loaded), self.ask(4)
        perturb(trainer, 0.1)
        before = pickle.dumps(reader.decide(asked, 0))
        reader.load_trainable(trainer.export_trainable())
        assert pickle.dumps(reader.decide(asked, 0)) == pickle.dumps(trainer.decide(asked, 0)) != before

    def test_training_touches_neither_normalisation_nor_buffers(
        self, adapter: LeRobotAdapter, path: Path, tmp_path: Path
    ):
        asked = self.ask(4)
        state = {k: v.clone() for k, v in adapter.policy.state_dict().items()}
        trainable = adapter.trainable()
        latent, _ = stored(adapter.decide(asked, 0))
        optimizer = torch.optim.AdamW(trainable.values(), lr=1e-2)
        evaluation = adapter.evaluate(*stack_observations(asked), latent)
        (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
        optimizer.step()
        save_pretrained(adapter, tmp_path / "trained", PolicyConfig(path=str(path), device="cpu"))
        files = sorted(f.name for f in path.glob("policy_*processor*.safetensors"))
        assert len(files) == 2
        for file in files:
            assert (tmp_path / "trained" / file).read_bytes() == (path / file).read_bytes()
        now = adapter.policy.state_dict()
        moved = {now[k].data_ptr() for k, v in state.items() if not torch.equal(now[k], v)}
        assert moved == {p.data_ptr() for k, p in trainable.items() if k.startswith("policy.")}

    def test_what_does_not_explore_is_not_scored(self, adapter: LeRobotAdapter, config: Any):
        adapter = self.exploring(adapter, config)
        for decision in adapter.decide(self.ask(2, explore=False), 0):
            assert not decision.log_prob.any()
