# SPDX-License-Identifier: Apache-2.0
"""LeRobot's gaussian_actor, the policy of its SAC: one action a decision, a Gaussian through tanh.

Three things in LeRobot 0.6.1 are not what its config says, and the comparison at load time covers them: what
it clamps to [std_min, std_max] is handed to `MultivariateNormal` as a covariance, so the std is the
*square root* of it; ``use_tanh_squash`` is not read, every action is squashed; and ``select_action`` samples,
it does not take the mean. `predict_action_chunk` raises, and `forward` cannot score a stored action.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.gaussian import GaussianContext, GaussianModel


class GaussianActor(GaussianModel):
    """Drives LeRobot's `GaussianActorPolicy`."""

    squashed = True
    executed = 1

    def __init__(self, policy: Any) -> None:
        config = policy.config
        if config.num_discrete_actions is not None:
            remedy = "LeRobot takes the discrete action that a critic likes best, which has no density"
            raise InputError("policy.num_discrete_actions", config.num_discrete_actions, remedy)
        self.policy = policy
        self.action_dim = policy.actor.action_dim
        self.width = policy.actor.encoder.output_dim
        if not config.shared_encoder:
            self.idle = ("encoder_critic.",)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the encoder's output, one token.

        Unlike in LeRobot's SAC, whose critic shapes a shared image encoder, the log-prob's gradient reaches
        it: our critic reads features and does not shape them.
        """
        actor = self.policy.actor
        features = actor.encoder(batch)
        hidden = actor.network(features)
        variance = torch.exp(actor.std_layer(hidden).float()).clamp(actor.std_min, actor.std_max)
        mean = actor.mean_layer(hidden).float()
        return Encoded(
            features=features[:, None],
            mask=features.new_ones(len(features), 1).bool(),
            context=GaussianContext(mean=mean[:, None], std=variance.sqrt()[:, None]),
        )

    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """LeRobot draws from the global generator, which is put back."""
        device = next(self.policy.parameters()).device
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(0)
            action = self.policy.select_action(batch)
            torch.manual_seed(0)
            zeros = torch.zeros_like(action)
            eps = torch.normal(zeros, zeros + 1)
        return action[:, None], eps[:, None]
