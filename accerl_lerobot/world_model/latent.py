# SPDX-License-Identifier: Apache-2.0
"""A latent state of images, learned by predicting itself: it takes the place of the simulator's state.

    images o ──random shift──► encoder ──► z ──with chunk──► predicted z', proprioception'
    images o'──random shift──► slow encoder ──► z'           InfoNCE against the batch's others

A convolutional encoder as in TD-MPC2 (arXiv 2310.16828), contrasted with a slow copy of itself one decision
later (InfoNCE, arXiv 1807.03748; the slow copy as in SPR, arXiv 2007.05929). The executed chunk and the
chunks of successes are read off the state too, so that it holds what decides them. The return is not: a
critic finds the outcome of a remembered episode in such a state, and hardly judges the chunk. Without the
random shift (DrQ-v2, arXiv 2107.09645) the state recognises episodes by their pixels.
Each pixel is measured from its own mean, in its own standard deviations, so that a small object that moves
on a still background is as loud as the robot's arm.

Shapes: B rows, Z latent numbers, S numbers of proprioception, K executed actions of A dims.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.checkpoint.tensors import fixed, follow
from accerl_lerobot.config.machine import computes_bf16
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK_BITS, Observations, task_codes
from accerl_lerobot.policies.features import STATE
from accerl_lerobot.world_model.config import LatentConfig
from accerl_lerobot.world_model.states import StateModel, StateSpec, Transitions

SIDE = 64  # pixels of the square that every image is resized to
SHIFT = 3  # pixels of the random shift at most, in each direction
CHANNELS = 32
KERNELS = (7, 5, 3, 3)
STRIDES = (2, 2, 2, 1)
WIDTH = 256
FOLLOW = 0.02  # share of the encoder that its slow copy takes over in a step
TEMPERATURE = 0.1  # of the contrast
CONTRAST = 0.1  # weights of the losses; that of proprioception is 1
INVERSE = 0.3
CLONING = 0.5
SMALLEST_STD = 1e-3
SMALLEST_PIXEL_STD = 0.05  # of a pixel's range
FARTHEST = 5.0  # standard deviations that a pixel may be from its mean
PIXEL_RATE = 0.002  # share of the newest images in the pixels' means, at least


class Encoder(nn.Module):
    """Images, float (B, C, 64, 64), to latents (B, Z) of mean 0 and variance 1.

    While it learns, it convolves in bf16 where the device computes in that; to act, in float32.
    """

    def __init__(self, channels: int, size: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        side = SIDE
        for kernel, stride in zip(KERNELS, STRIDES, strict=True):
            layers += [nn.Conv2d(channels, CHANNELS, kernel, stride), nn.SiLU()]
            channels = CHANNELS
            side = (side - kernel) // stride + 1
        layers[-1] = nn.Flatten()
        self.images = nn.Sequential(*layers)
        self.latent = network(CHANNELS * side**2, size, hidden=1)

    def forward(self, images: Tensor) -> Tensor:
        bf16 = self.training and computes_bf16(images.device)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
            seen = self.images(images)
        latent = self.latent(seen.float())
        return functional.layer_norm(latent, latent.shape[-1:])


class LatentModel(StateModel):
    """Its states are z, proprioception, and the share of the time limit gone."""

    def __init__(self, spec: StateSpec, config: LatentConfig) -> None:
        super().__init__()
        if not spec.cameras:
            hint = "the policy reads no images; use simulator, or another algorithm"
            raise InputError("world_model.type", config.type, hint)
        rows, dims = spec.chunk
        chunk = rows * dims
        seen = config.latents + spec.state
        self.cameras = tuple(spec.cameras)
        self.channels = list(spec.cameras.values())
        channels = sum(self.channels)
        self.latents = config.latents
        self.size = seen + 1
        self.encoder = Encoder(channels, config.latents)
        self.slow = copy.deepcopy(self.encoder).requires_grad_(False)
        self.dynamics = network(seen + chunk + TASK_BITS, seen, hidden=2)
        self.inverse = network(2 * seen, chunk, hidden=1)
        self.cloned = network(seen + TASK_BITS, chunk, hidden=1)
        pixels = channels, SIDE, SIDE
        self.pixel_mean = fixed(torch.zeros(pixels))
        self.pixel_square = fixed(torch.ones(pixels))
        self.batches = fixed(torch.zeros(()))  # that the two above are means of
        self.mean = fixed(torch.zeros(spec.state))
        self.std = fixed(torch.ones(spec.state))

    def encode(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        latent = self.encoder(self._scaled(self._images(observations)))
        late = torch.from_numpy(elapsed.astype(np.float32))[:, None].to(latent)
        return torch.cat([latent, self._proprioception(observations), late], 1)

    @torch.no_grad()
    def fit(self, observations: Observations) -> None:
        if not len(self.mean):
            return
        numbers = observations[STATE]
        numbers = numbers.reshape(len(numbers), -1)
        # In float64, or the rounding of a long sum would look like a spread.
        std = numbers.std(0, dtype=np.float64).clip(SMALLEST_STD)
        self.mean.copy_(torch.from_numpy(numbers.mean(0, dtype=np.float64)))
        self.std.copy_(torch.from_numpy(std))

    def loss(self, transitions: Transitions) -> tuple[Tensor, dict[str, float]]:
        follow(self.slow, self.encoder, FOLLOW)
        images = self._images(transitions.observations)
        self._fit_pixels(images)
        now = self._scaled(images)
        following = self._scaled(self._images(transitions.following))
        robot = self._robot(transitions.observations)
        robot_then = self._robot(transitions.following)
        code = torch.from_numpy(task_codes(transitions.tasks)).to(robot)
        chunk = transitions.chunk.flatten(1)

        seen = torch.cat([self.encoder(self._augmented(now)), robot], 1)
        seen_then = torch.cat([self.encoder(self._augmented(following)), robot_then], 1)
        with torch.no_grad():
            latent_then = self.slow(self._augmented(following))

        predicted = seen + self.dynamics(torch.cat([seen, chunk, code], 1))
        contrast = info_nce(predicted[:, : self.latents], latent_then)
        error = predicted[:, self.latents :] - robot_then
        proprioception = error.square().sum() / max(1, error.numel())
        between = self.inverse(torch.cat([seen, seen_then], 1))
        inverse = (between - chunk).square().mean()
        cloned = self.cloned(torch.cat([seen, code], 1))
        distance = (cloned - chunk).square().mean(1)
        cloning = (distance * transitions.success).mean()

        loss = CONTRAST * contrast + proprioception + INVERSE * inverse + CLONING * cloning
        metrics = {
            "contrast": contrast,
            "proprioception": proprioception,
            "inverse": inverse,
            "cloning": cloning,
        }
        return loss, {name: float(part.detach()) for name, part in metrics.items()}

    @torch.no_grad()
    def _fit_pixels(self, images: Tensor) -> None:
        """Take another batch of images (B, channels, 64, 64) into the pixels' means."""
        self.batches.add_(1)
        rate = max(1 / float(self.batches), PIXEL_RATE)
        self.pixel_mean.lerp_(images.mean(0), rate)
        self.pixel_square.lerp_(images.square().mean(0), rate)

    def _scaled(self, images: Tensor) -> Tensor:
        """Images (B, channels, 64, 64) in units of what each pixel varies by."""
        variance = self.pixel_square - self.pixel_mean.square()
        std = variance.clamp(min=SMALLEST_PIXEL_STD**2).sqrt()
        return ((images - self.pixel_mean) / std).clamp(-FARTHEST, FARTHEST)

    def _augmented(self, images: Tensor) -> Tensor:
        """Images (B, channels, 64, 64), those of each camera shifted by themselves."""
        cameras = [shifted(part) for part in images.split(self.channels, 1)]
        return torch.cat(cameras, 1).contiguous(memory_format=torch.channels_last)  # CPUs convolve it faster

    def _images(self, observations: Observations) -> Tensor:
        """All cameras', float (B, channels, 64, 64) in [−½, ½]; of several env steps the newest."""
        cameras = []
        for name in self.cameras:
            pixels = observations[name]
            if pixels.ndim == 5:
                pixels = pixels[:, -1]
            image = torch.from_numpy(np.ascontiguousarray(pixels)).to(self.mean.device)
            image = image.permute(0, 3, 1, 2).float()
            if image.shape[-2:] != (SIDE, SIDE):
                image = functional.interpolate(image, (SIDE, SIDE), mode="area")
            cameras.append(image / 255 - 0.5)
        return torch.cat(cameras, 1)

    def _robot(self, observations: Observations) -> Tensor:
        """Proprioception in standard deviations from its mean, (B, numbers)."""
        return (self._proprioception(observations) - self.mean) / self.std

    def _proprioception(self, observations: Observations) -> Tensor:
        if not len(self.mean):
            return self.mean.new_zeros(len(observations[self.cameras[0]]), 0)
        numbers = observations[STATE]
        return torch.from_numpy(numbers.reshape(len(numbers), -1)).to(self.mean)


def network(inputs: int, outputs: int, hidden: int) -> nn.Sequential:
    """Linear layers with LayerNorm and SiLU between them."""
    layers: list[nn.Module] = []
    size = inputs
    for _ in range(hidden):
        layers += [nn.Linear(size, WIDTH), nn.LayerNorm(WIDTH), nn.SiLU()]
        size = WIDTH
    return nn.Sequential(*layers, nn.Linear(size, outputs))


def info_nce(predicted: Tensor, observed: Tensor) -> Tensor:
    """Cross-entropy of telling each prediction's own observation (B, Z) from the others of the batch."""
    similarity = functional.normalize(predicted, dim=1) @ functional.normalize(observed, dim=1).T
    own = torch.arange(len(predicted), device=predicted.device)
    return functional.cross_entropy(similarity / TEMPERATURE, own)


def shifted(images: Tensor) -> Tensor:
    """Images (B, C, H, W), each moved by up to `SHIFT` pixels at random; edges are repeated."""
    height, width = images.shape[-2:]
    padded = functional.pad(images, (SHIFT,) * 4, mode="replicate")
    offsets = torch.randint(0, 2 * SHIFT + 1, (len(images), 2)).tolist()
    moved = []
    for image, (row, column) in zip(padded, offsets, strict=True):
        moved.append(image[:, row : row + height, column : column + width])
    return torch.stack(moved)
