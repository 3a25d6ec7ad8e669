# SPDX-License-Identifier: Apache-2.0
"""The latent state of LeRobot's TD-MPC policy, which stock ``lerobot-train`` has trained.

    image, proprioception ──its encoder──► z ──its dynamics, once for each action of the chunk──► predicted z'

While it goes on to learn, the last predicted z' is to equal the state that a slow copy of the encoder has of
the next observation, and the return is to be read off z by its value network (TD-MPC, arXiv 2203.04955, as in
FOWM, arXiv 2310.16029). Its policy, rewards and Q functions are not used.

Shapes: B rows, K executed actions of A dims.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from accerl_lerobot.checkpoint.tensors import fixed, follow
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.features import STATE
from accerl_lerobot.policies.loading import load_network
from accerl_lerobot.policies.processing import IMAGES, Processing
from accerl_lerobot.world_model.config import TDMPCStateConfig
from accerl_lerobot.world_model.latent import shifted
from accerl_lerobot.world_model.states import StateModel, StateSpec, Transitions

RETURN = 0.5  # weight of the return's squared error; consistency's is in the policy's own config
SMALLEST_SCALE = 1e-6


class TDMPCModel(StateModel):
    """Its states are z, proprioception, and the share of the time limit gone."""

    def __init__(self, spec: StateSpec, config: TDMPCStateConfig) -> None:
        super().__init__()
        policy, processing = _loaded(config)
        self.config = policy.config
        self.keeps_learning = config.learn
        self.path = config.path
        self.image = next(iter(self.config.image_features), None)
        self.camera = _camera(spec, self.image, config)
        self.numbers = spec.state
        _check_sizes(spec, policy.config, config)
        self.size = self.config.latent_dim + spec.state + 1
        self.encoder = policy.model._encoder
        self.dynamics = policy.model._dynamics
        self.value = policy.model._V
        self.slow = policy.model_target._encoder
        self.requires_grad_(config.learn)
        self.slow.requires_grad_(False)
        # What it normalises by, measured: LeRobot's normalisations are all affine.
        with torch.no_grad():
            one = torch.ones(1, 1, spec.chunk[1])
            zero = processing.normalise(torch.zeros_like(one))[0, 0]
            scale = processing.normalise(one)[0, 0] - zero
            if spec.units is not None:  # of the policy's normalised actions
                first, each = map(torch.from_numpy, spec.units)
                zero = zero + scale * first
                scale = scale * each
            self.action_zero = fixed(zero)
            self.action_scale = fixed(scale)
            if self.numbers:
                ends = np.repeat(np.array([[0], [1]], np.float32), self.numbers, 1)
                seen = {STATE: ends} | self._blank(2)
                low, high = processing.prepare(seen, ["", ""])[STATE]
                self.state_zero = fixed(low)
                self.state_scale = fixed(high - low)

    @property
    def learns(self) -> bool:
        return self.keeps_learning

    def encode(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        latent = self.encoder(self._read(observations))
        late = torch.from_numpy(elapsed.astype(np.float32))[:, None].to(latent)
        numbers = latent.new_zeros(len(latent), 0)
        if self.numbers:
            numbers = torch.from_numpy(observations[STATE]).to(latent)
        return torch.cat([latent, numbers, late], 1)

    def loss(self, transitions: Transitions) -> tuple[Tensor, dict[str, float]]:
        follow(self.slow, self.encoder, 1 - self.config.target_model_momentum)
        with torch.no_grad():
            target = self.slow(self._read(transitions.following, shift=True))
        latent = self.encoder(self._read(transitions.observations, shift=True))
        value = self.value(latent)[:, 0]
        actions = self.action_zero + self.action_scale * transitions.chunk
        for action in actions.unbind(1):
            latent = self.dynamics(torch.cat([latent, action], 1))
        consistency = functional.mse_loss(latent, target)
        returns = functional.mse_loss(value, transitions.returns)
        loss = self.config.consistency_coeff * consistency + RETURN * returns
        return loss, {"consistency": float(consistency.detach()), "return": float(returns.detach())}

    def _read(self, observations: Observations, shift: bool = False) -> dict[str, Tensor]:
        """Inputs of TD-MPC's encoder."""
        device = self.action_zero.device
        batch = {}
        if self.image is not None:
            pixels = torch.from_numpy(np.ascontiguousarray(observations[self.camera])).to(device)
            images = pixels.permute(0, 3, 1, 2).float() / 255
            self._check_images(images)
            if shift:
                images = shifted(images)
            batch[self.image] = images
        if self.numbers:
            numbers = torch.from_numpy(observations[STATE]).to(device)
            batch[STATE] = self.state_zero + self.state_scale * numbers
        return batch

    def _check_images(self, images: Tensor) -> None:
        """Refuses images (B, C, H, W) of another size, which its encoder has no weights for."""
        here = tuple(images.shape[1:])
        there = self.config.image_features[self.image].shape
        if here != there:
            hint = f"its images have the shape {there}, the run's {here}; train it on these, or change env"
            raise InputError("world_model.path", self.path, hint)

    def _blank(self, count: int) -> Observations:
        """Black images of TD-MPC's own name and size."""
        if self.image is None:
            return {}
        channels, height, width = self.config.image_features[self.image].shape
        return {self.image: np.zeros((count, height, width, channels), np.uint8)}


def _loaded(config: TDMPCStateConfig) -> tuple[Any, Processing]:
    if config.path is None:
        hint = "give the pretrained_model of a policy that lerobot-train --policy.type=tdmpc has trained"
        raise InputError("world_model.path", None, hint)
    try:
        policy, processing = load_network(PolicyConfig(path=config.path, device="cpu"))
    except InputError as error:
        field = error.field.replace("policy.", "world_model.", 1)
        raise InputError(field, error.value, error.hint) from error
    kind = policy.config.type
    if kind != "tdmpc":
        raise InputError("world_model.path", config.path, f"its type is {kind}; give one of type tdmpc")
    mode = policy.config.normalization_mapping.get("VISUAL", "IDENTITY")
    if mode != "IDENTITY":
        hint = f"its images are normalised by {mode.value}; train it with IDENTITY, LeRobot's default"
        raise InputError("world_model.path", config.path, hint)
    return policy, processing


def _camera(spec: StateSpec, image: str | None, config: TDMPCStateConfig) -> str:
    """The run's camera that TD-MPC sees: the one of its image's name, or the only one."""
    cameras = list(spec.cameras)
    if image is None:
        return ""
    if image in cameras:
        return image
    if len(cameras) == 1:
        return cameras[0]
    has = ", ".join(name.removeprefix(IMAGES) for name in cameras) or "none"
    hint = f"it sees {image}, and the policy's cameras are {has}; train it on one of these names"
    raise InputError("world_model.path", config.path, hint)


def _check_sizes(spec: StateSpec, lerobot_config: Any, config: TDMPCStateConfig) -> None:
    """Refuses a TD-MPC of another robot."""
    numbers = {STATE: spec.state, "action": spec.chunk[1]}
    features = lerobot_config.input_features | lerobot_config.output_features
    for name, ours in numbers.items():
        its = features[name].shape[0] if name in features else 0
        if its != ours:
            hint = f"{name} has {its} numbers there and {ours} here; train it on this robot's data"
            raise InputError("world_model.path", config.path, hint)
