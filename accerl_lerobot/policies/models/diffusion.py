# SPDX-License-Identifier: Apache-2.0
"""LeRobot's diffusion policy: the observations once, then its U-Net once per denoising step.

Never in training mode here: batch norms keep their statistics, and the crop is the centre one.
`predict_action_chunk` reads queues that only `select_action` fills, or else wants a time dimension that a
LeRobot preprocessor does not add; `stock` adds it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.diffusion import DiffusionContext, DiffusionModel, DiffusionShape, Schedule
from accerl_lerobot.policies.family import Encoded


class Diffusion(DiffusionModel):
    """Drives LeRobot's `DiffusionPolicy`.

    Args:
        policy: a loaded one.
    """

    def __init__(self, policy: Any) -> None:
        config = policy.config
        if config.compile_model:
            raise InputError(
                "policy.compile_model",
                True,
                "a compiled sampler rounds unlike the re-scoring pass; set it to false in config.json",
            )
        steps, most = policy.diffusion.num_inference_steps, config.num_train_timesteps
        if steps > most:
            raise InputError("policy.num_steps", steps, f"use at most {most}, as many as it was trained with")
        self.policy = policy
        self.shape = DiffusionShape(
            horizon=config.horizon,
            executed=min(config.n_action_steps, config.horizon - config.n_obs_steps + 1),
            first=config.n_obs_steps - 1,
            action_dim=config.action_feature.shape[0],
        )
        self.schedule = _schedule(policy.diffusion.noise_scheduler, steps, config)
        of_images = 2 * config.spatial_softmax_num_keypoints * len(config.image_features)
        self.width = config.n_obs_steps * (config.robot_state_feature.shape[0] + of_images)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """See the base class; the features, one token, are the U-Net's condition: state, image keypoints."""
        diffusion = self.policy.diffusion
        condition = diffusion._prepare_global_conditioning(self._with_time(batch))

        def network(x: Tensor, timestep: int) -> Tensor:
            t = torch.full(x.shape[:1], timestep, dtype=torch.long, device=x.device)
            output: Tensor = diffusion.unet(x, t, global_cond=condition)
            return output.float()

        return Encoded(
            features=condition[:, None],
            mask=condition.new_ones(len(condition), 1).bool(),
            context=DiffusionContext(network=network),
        )

    def stock(self, batch: dict[str, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
        """See the base class; LeRobot draws from the global generator, which is put back."""
        eps = torch.zeros(len(self.schedule), *noise.shape, device=noise.device)
        self.policy.reset()
        with torch.random.fork_rng([noise.device] if noise.device.type == "cuda" else []):
            torch.manual_seed(0)
            chunk = self.policy.predict_action_chunk(self._with_time(batch), noise=noise)
            torch.manual_seed(0)
            for k, timestep in enumerate(self.schedule.timesteps):
                if self.schedule.scheduler == "DDPM" and timestep > 0:
                    eps[k] = torch.randn(noise.shape, device=noise.device)
        return chunk, eps.transpose(0, 1)

    def _with_time(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """As LeRobot's sampler wants it: state (B, O, S), images stacked (B, O, cameras, 3, H, W)."""
        from lerobot.utils.constants import OBS_IMAGES, OBS_STATE

        config = self.policy.config
        inputs = {key: batch[key] for key in (OBS_STATE, *config.image_features)}
        if config.n_obs_steps == 1:
            inputs = {key: value[:, None] for key, value in inputs.items()}
        elif inputs[OBS_STATE].shape[1:-1] != (config.n_obs_steps,):
            shape = tuple(inputs[OBS_STATE].shape)
            raise ValueError(
                f"observation.state is {shape}, but the policy reads {config.n_obs_steps} env steps at a "
                "time: make worlds with history=n_obs_steps"
            )
        images = [inputs[key] for key in config.image_features]
        return inputs | {OBS_IMAGES: torch.stack(images, dim=-4)}


def _schedule(scheduler: Any, steps: int, config: Any) -> Schedule:
    """The schedule that LeRobot's sampler goes through in so many steps."""
    scheduler.set_timesteps(steps)
    timesteps = tuple(int(t) for t in scheduler.timesteps)
    alphas = scheduler.alphas_cumprod.float().cpu()[list(timesteps)]
    return Schedule(
        timesteps=timesteps,
        alphas=alphas,
        following=torch.cat([alphas[1:], torch.ones(1)]),
        scheduler=config.noise_scheduler_type,
        prediction=config.prediction_type,
        clip=config.clip_sample_range if config.clip_sample else None,
    )
