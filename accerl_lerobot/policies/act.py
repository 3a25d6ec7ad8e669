# SPDX-License-Identifier: Apache-2.0
"""ACT: one pass of LeRobot's transformer; its own forward is run, and watched at two places.

At inference the variational encoder is not run and the latent is 0, so the policy is deterministic. The
ResNet's batch norms are frozen in LeRobot's own code, and dropout is off, since a policy here is never in
training mode: nothing but the observations and the weights moves the chunk.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.gaussian import GaussianContext, GaussianModel


class ACT(GaussianModel):
    """Drives LeRobot's `ACTPolicy`."""

    idle = ("model.vae_encoder", "model.encoder_latent_input_proj.weight")

    def __init__(self, policy: Any) -> None:
        config = policy.config
        if config.temporal_ensemble_coeff is not None:
            remedy = "averaging over earlier chunks makes actions depend on more than the observation"
            raise InputError(
                "policy.temporal_ensemble_coeff", config.temporal_ensemble_coeff, f"{remedy}; set it to null"
            )
        self.policy = policy
        self.executed, self.action_dim = config.n_action_steps, config.action_feature.shape[0]
        self.width = self.row_width = config.dim_model

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """The features are the encoder's output: latent, state, image positions."""
        from lerobot.utils.constants import OBS_IMAGES

        model: Any = self.policy.model
        inputs: dict[str, Any] = dict(batch)
        if self.policy.config.image_features:
            inputs[OBS_IMAGES] = [batch[key] for key in self.policy.config.image_features]
        seen: dict[str, Tensor] = {}

        def encoder_done(module: nn.Module, arguments: Any, output: Tensor) -> None:
            seen["features"] = output.transpose(0, 1)

        def head_starts(module: nn.Module, arguments: tuple[Tensor]) -> None:
            seen["rows"] = arguments[0]

        hooks = [
            model.encoder.register_forward_hook(encoder_done),
            model.action_head.register_forward_pre_hook(head_starts),
        ]
        try:
            mean, _ = model(inputs)
        finally:
            for hook in hooks:
                hook.remove()
        features = seen["features"]
        return Encoded(
            features=features,
            mask=features.new_ones(features.shape[:2]).bool(),
            context=GaussianContext(mean=mean.float(), rows=seen["rows"]),
        )

    def stock(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        return self.policy.predict_action_chunk(batch), None
