# SPDX-License-Identifier: Apache-2.0
"""LeRobot's TD-MPC as a world model that critic and teacher stand on."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import tdmpc
from accerl_lerobot.world_model.config import TDMPCStateConfig
from accerl_lerobot.world_model.states import StateLearner, StateSpec, new_state_model
from accerl_lerobot.world_model.tdmpc import TDMPCModel
from tests.policies.checkpoints import write_policy
from tests.policies.test_stock import KINDS
from tests.world_model.test_latent import FRONT, ROBOT, transitions

IMAGE = "observation.image"
UNITS = (np.array([0.5, -1.0], np.float32), np.array([2.0, 0.25], np.float32))
"""Zero and scale of the policy that practises; TD-MPC normalises by the range of its own dataset."""
SPEC = StateSpec(cameras={FRONT: 3}, state=4, environment_state=0, chunk=(3, 2), units=UNITS)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tdmpc") / "pretrained_model"
    return write_policy(folder, "tdmpc", image=64, camera=IMAGE, **KINDS["tdmpc"])


def test_state_and_loss_are_those_of_lerobot_s_networks(written: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tdmpc, "shifted", lambda images: images)
    made = new_state_model(SPEC, TDMPCStateConfig(path=str(written)))
    assert isinstance(made, TDMPCModel) and made.learns
    policy: Any = get_policy_class("tdmpc").from_pretrained(written)
    pre, post = make_pre_post_processors(policy.config, pretrained_path=str(written))
    batch = transitions(6, 0, state=4, chunk=3)

    def latent(model: Any, observations: dict[str, np.ndarray]) -> torch.Tensor:
        images = torch.from_numpy(observations[FRONT]).permute(0, 3, 1, 2).float() / 255
        inputs = {IMAGE: images, ROBOT: torch.from_numpy(observations[ROBOT]), "task": ["a"] * 6}
        return model.encode({name: pre(inputs)[name] for name in (IMAGE, ROBOT)})

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
    learner = StateLearner(new_state_model(SPEC, TDMPCStateConfig(path=str(written))))
    slow = [parameter.clone() for parameter in learner.model.slow.parameters()]
    batch = transitions(64, 0, state=4, chunk=3)
    for _ in range(30):
        learner.submit(batch, {})
    losses = [20 * parts["consistency"] + 0.5 * parts["return"] for parts in learner.collect()]
    assert losses[-1] < 0.8 * losses[0]
    assert not all(map(torch.equal, slow, learner.model.slow.parameters()))
    still = new_state_model(SPEC, TDMPCStateConfig(path=str(written), learn=False))
    assert not still.learns and not any(parameter.requires_grad for parameter in still.parameters())


def test_what_does_not_fit_is_one_line(written: Path, tmp_path: Path):
    other = write_policy(tmp_path / "vqbet", "vqbet", image=64, camera=FRONT, **KINDS["vqbet"])
    scaled = shutil.copytree(written, tmp_path / "scaled")
    config = json.loads((scaled / "config.json").read_text())
    config["normalization_mapping"]["VISUAL"] = "MEAN_STD"
    (scaled / "config.json").write_text(json.dumps(config))
    for path, change, message in (
        (None, {}, "world_model.path=None: give the pretrained_model"),
        (str(tmp_path / "nowhere"), {}, "world_model.path="),
        (str(other), {}, "its type is vqbet; give one of type tdmpc"),
        (str(scaled), {}, "its images are normalised by MEAN_STD; train it with IDENTITY"),
        (str(written), {"chunk": (3, 7)}, "action has 2 numbers there and 7 here"),
        (str(written), {"state": 9}, "observation.state has .* numbers there and 9 here"),
        (str(written), {"cameras": {"observation.images.a": 3, "observation.images.b": 3}}, "it sees observ"),
    ):
        with pytest.raises(InputError, match=message):
            new_state_model(SPEC._replace(**change), TDMPCStateConfig(path=path))
    made = new_state_model(SPEC, TDMPCStateConfig(path=str(written)))
    small = {FRONT: np.zeros((1, 32, 32, 3), np.uint8), ROBOT: np.zeros((1, SPEC.state), np.float32)}
    with pytest.raises(InputError, match=r"world_model.path=.*\(3, 64, 64\), the run's \(3, 32, 32\)"):
        made.encode(small, ["a"], np.zeros(1))
