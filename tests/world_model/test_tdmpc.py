# SPDX-License-Identifier: Apache-2.0
"""LeRobot's TD-MPC as a world model that critic and teacher stand on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import tdmpc
from accerl_lerobot.world_model.config import TDMPCStateConfig
from accerl_lerobot.world_model.states import StateLearner, StateSpec, Transitions, new_state_model
from accerl_lerobot.world_model.tdmpc import TDMPCModel
from tests.policies.checkpoints import write_policy
from tests.policies.test_stock import KINDS

CAMERA, IMAGE, ROBOT = "observation.images.front", "observation.image", "observation.state"
UNITS = (np.array([0.5, -1.0], np.float32), np.array([2.0, 0.25], np.float32))
"""Zero and scale of the policy that practises; TD-MPC normalises by the range of its own dataset."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tdmpc") / "pretrained_model"
    return write_policy(folder, "tdmpc", image=64, camera=IMAGE, **KINDS["tdmpc"])


def spec_of(written: Path) -> StateSpec:
    config: Any = get_policy_class("tdmpc").from_pretrained(written).config
    state = config.robot_state_feature.shape[0]
    return StateSpec(cameras={CAMERA: 3}, state=state, environment_state=0, chunk=(3, 2), units=UNITS)


def transitions(spec: StateSpec, count: int = 6) -> Transitions:
    rng = np.random.default_rng(0)

    def seen() -> dict[str, np.ndarray]:
        images = rng.integers(0, 256, (count, 64, 64, 3), np.uint8)
        return {CAMERA: images, ROBOT: rng.standard_normal((count, spec.state)).astype(np.float32)}

    return Transitions(
        observations=seen(),
        following=seen(),
        tasks=["a"] * count,
        elapsed=torch.linspace(0, 1, count),
        chunk=torch.from_numpy(rng.uniform(-1, 1, (count, *spec.chunk)).astype(np.float32)),
        returns=torch.from_numpy(rng.random(count, dtype=np.float32)),
        success=torch.ones(count, dtype=torch.bool),
    )


def test_state_and_loss_are_those_of_lerobot_s_networks(written: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tdmpc, "shifted", lambda images: images)
    spec = spec_of(written)
    made = new_state_model(spec, TDMPCStateConfig(path=str(written)))
    assert isinstance(made, TDMPCModel) and made.learns
    policy: Any = get_policy_class("tdmpc").from_pretrained(written)
    pre, post = make_pre_post_processors(policy.config, pretrained_path=str(written))
    batch = transitions(spec)

    def latent(model: Any, observations: dict[str, np.ndarray]) -> torch.Tensor:
        images = torch.from_numpy(observations[CAMERA]).permute(0, 3, 1, 2).float() / 255
        inputs = {IMAGE: images, ROBOT: torch.from_numpy(observations[ROBOT]), "task": ["a"] * 6}
        processed = pre(inputs)
        return model.encode({IMAGE: processed[IMAGE], ROBOT: processed[ROBOT]})

    with torch.no_grad():
        z = latent(policy.model, batch.observations)
        state = made.encode(batch.observations, batch.tasks, batch.elapsed.numpy())
        torch.testing.assert_close(state[:, : z.shape[1]], z)
        torch.testing.assert_close(state[:, z.shape[1] : -1], torch.from_numpy(batch.observations[ROBOT]))
        assert state[:, -1].tolist() == batch.elapsed.tolist() and state.shape[1] == made.size

        executed = UNITS[0] + UNITS[1] * batch.chunk.numpy()
        ends = post(torch.tensor([[[0.0, 0.0]], [[1.0, 1.0]]])).numpy()[:, 0]
        actions = torch.from_numpy((executed - ends[0]) / (ends[1] - ends[0])).float()
        predicted = z
        for k in range(3):
            predicted = policy.model.latent_dynamics(predicted, actions[:, k])
        consistency = (predicted - latent(policy.model_target, batch.following)).square().mean()
        returns = (policy.model.V(z) - batch.returns).square().mean()
        expected = policy.config.consistency_coeff * consistency + 0.5 * returns
        loss, parts = made.loss(batch)
    assert float(loss) == pytest.approx(float(expected), rel=1e-3)
    assert parts == pytest.approx({"consistency": float(consistency), "return": float(returns)}, rel=1e-3)


def test_it_learns_or_stays_as_it_is(written: Path):
    spec = spec_of(written)
    learner = StateLearner(new_state_model(spec, TDMPCStateConfig(path=str(written))))
    slow = [parameter.clone() for parameter in learner.model.slow.parameters()]
    batch = transitions(spec, 64)
    for _ in range(30):
        learner.submit(batch, {})
    losses = [20 * parts["consistency"] + 0.5 * parts["return"] for parts in learner.collect()]
    assert losses[-1] < 0.8 * losses[0]
    assert not all(map(torch.equal, slow, learner.model.slow.parameters()))
    still = new_state_model(spec, TDMPCStateConfig(path=str(written), learn=False))
    assert not still.learns and not any(parameter.requires_grad for parameter in still.parameters())


def test_what_does_not_fit_is_one_line(written: Path, tmp_path: Path):
    spec = spec_of(written)
    other = write_policy(tmp_path / "vqbet", "vqbet", image=64, camera=CAMERA, **KINDS["vqbet"])
    for path, change, message in (
        (None, {}, "world_model.path=None: give the pretrained_model"),
        (str(tmp_path / "nowhere"), {}, "world_model.path="),
        (str(other), {}, "its type is vqbet; give one of type tdmpc"),
        (str(written), {"chunk": (3, 7)}, "action has 2 numbers there and 7 here"),
        (str(written), {"state": 9}, "observation.state has .* numbers there and 9 here"),
        (str(written), {"cameras": {"observation.images.a": 3, "observation.images.b": 3}}, "it sees observ"),
    ):
        with pytest.raises(InputError, match=message):
            new_state_model(spec._replace(**change), TDMPCStateConfig(path=path))
    made = new_state_model(spec, TDMPCStateConfig(path=str(written)))
    small = {CAMERA: np.zeros((1, 32, 32, 3), np.uint8), ROBOT: np.zeros((1, spec.state), np.float32)}
    with pytest.raises(InputError, match=r"world_model.path=.*\(3, 64, 64\), the run's \(3, 32, 32\)"):
        made.encode(small, ["a"], np.zeros(1))
