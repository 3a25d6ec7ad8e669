# SPDX-License-Identifier: Apache-2.0
"""The networks: a world model of images and robot state by regression, and a success model of one image.

The world model predicts the change from the newest frame to the one after the chunk, in units of its usual
size. It sees the context, the task and the episode's first frame, behind which objects may reappear. A small
network of its own predicts the robot's state.

Shapes: see `contract.py`; C = 3·V channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from diffusers.models.unets.unet_2d import UNet2DModel
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, TASK_BITS, task_codes
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import (
    CONTEXT,
    Context,
    LearnableWorldModel,
    Prediction,
    State,
    Windows,
    WorldModelSpec,
)
from accerl_lerobot.world_model.latent import shifted

SPACE_TO_DEPTH = 4  # side of the pixel blocks that become channels
COARSE = 8  # side of the coarse view of the frame from which the robot's state is predicted
CONTEXT_NOISE = 0.02
"""Largest std of the noise on the context's frames in training, in units of [−1, 1]: imagined frames are
never as clean as recorded ones."""
HIDDEN = 128  # width of hidden layers
PLANES = 8  # channels of the planes that tell the actions
GRID = 4  # side of the success model's last feature map
NOISE = 0.06  # largest std of the noise on frames in the success model's training, in units of [−1, 1]
AT_ONCE = 256  # frames whose outcomes are predicted together
LIGHT = 0.1  # standard deviation of their brightness


class PixelWorldModel(LearnableWorldModel):
    """World model of images and robot state; its statistics are saved with the weights."""

    def __init__(self, spec: WorldModelSpec, config: PixelModelConfig) -> None:
        super().__init__(spec, config)
        multiple = SPACE_TO_DEPTH * 2 ** (len(config.channels) - 1)
        if any(side % multiple for side in spec.image_size):
            hint = f"use a multiple of {multiple}, or change world_model.model.channels"
            raise InputError("world_model.image_size", spec.image_size[0], hint)
        channels = 3 * len(spec.cameras)
        robot = spec.state_dim
        moving = (2 * spec.chunk + 1) * spec.action_dim + 3 * robot
        numbers = moving + spec.chunk + TASK_BITS
        self.network = FrameNetwork(channels, (CONTEXT + 1) * channels, numbers, config.channels)
        self.motion = nn.Sequential(
            nn.Linear(numbers + channels * COARSE * COARSE, HIDDEN), nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN), nn.SiLU(),
            _zero(nn.Linear(HIDDEN, robot)),
        )  # fmt: skip
        for name, size in {"moving": moving, "motion": robot}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("change", torch.tensor(0.1))

    def fit_statistics(self, windows: Windows) -> None:
        steps = windows.steps[:, 0]
        valid = steps > 0
        state = self.begin(windows.context, windows.tasks)
        actions = windows.actions[:, 0] * self._executed(steps)[..., None]
        samples = {
            "moving": _moving(state, actions),
            "motion": (windows.robot[:, 0] - state["robot"][:, -1])[valid],
        }
        for name, values in samples.items():
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0, correction=0).clamp(min=1e-3))
        change = _to_floats(windows.frames[:, 0]) - _newest_frames(state)
        self.change.copy_(change[valid].square().mean().sqrt().clamp(min=1e-3))

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        codes = torch.from_numpy(task_codes(tasks)).to(context.robot)
        return context._asdict() | {TASK: codes}

    def step(self, state: State, actions: Tensor) -> Prediction:
        return self._predict(state, actions, torch.ones_like(actions[..., 0]))

    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, float]]:
        """Loss over every valid chunk; after the first, the model's own prediction is its input."""
        state = self.begin(windows.context, windows.tasks)
        images = []
        motions = []
        for r, steps in enumerate(windows.steps.unbind(1)):
            executed = self._executed(steps)
            actions = windows.actions[:, r] * executed[..., None]
            numbers = self._numbers(state, actions, executed)
            change = (_to_floats(windows.frames[:, r]) - _newest_frames(state)) / self.change
            error = self._change(state, numbers, CONTEXT_NOISE) - change
            images.append(error.square().mean((1, 2, 3)))
            motion = (windows.robot[:, r] - state["robot"][:, -1] - self.motion_mean) / self.motion_std
            error = self._motion(state, numbers) - motion
            motions.append(error.square().sum(1) / max(1, motion.shape[1]))
            if r + 1 < windows.steps.shape[1]:
                state = self._predict(state, actions, executed).state
        weight = (windows.steps > 0).float()
        count = weight.sum().clamp(min=1)
        image = (torch.stack(images, 1) * weight).sum() / count
        motion = (torch.stack(motions, 1) * weight).sum() / count
        return image + motion, {"image": image.item(), "state": motion.item()}

    @torch.no_grad()
    def _predict(self, state: State, actions: Tensor, executed: Tensor) -> Prediction:
        numbers = self._numbers(state, actions, executed)
        image = _newest_frames(state) + self.change * self._change(state, numbers)
        pixels = ((image + 1) * 127.5).round().clamp(0, 255).byte()
        frames = pixels.unflatten(1, (-1, 3)).movedim(2, -1)
        robot = state["robot"][:, -1] + self.motion_mean + self.motion_std * self._motion(state, numbers)
        following = state | {
            "frames": torch.stack([state["frames"][:, -1], frames], 1),
            "robot": torch.stack([state["robot"][:, -1], robot], 1),
            "actions": actions,
            "commanded_sum": state["commanded_sum"] + actions.sum(1),
        }
        return Prediction(state=following, frames=frames, robot=robot)

    def _executed(self, steps: Tensor) -> Tensor:
        """float32 (B, K), 1 for the actions of a chunk that were executed, of (B,) counts."""
        return (torch.arange(self.spec.chunk, device=steps.device) < steps[:, None]).float()

    def _change(self, state: State, numbers: Tensor, noise: float = 0.0) -> Tensor:
        """The change in usual changes, (B, C, H, W); the frames are seen with noise of up to this std."""
        seen = torch.cat([state["frames"], state["first_frame"][:, None]], 1)
        frames = _to_floats(seen.flatten(1, 2))
        if noise:
            level = noise * torch.rand(len(frames), 1, 1, 1, device=frames.device)
            frames = frames + level * torch.randn_like(frames)
        change: Tensor = self.network(frames, numbers)
        return change

    def _motion(self, state: State, numbers: Tensor) -> Tensor:
        """The robot's motion in usual motions, (B, S)."""
        view = functional.adaptive_avg_pool2d(_newest_frames(state), COARSE)
        motion: Tensor = self.motion(torch.cat([numbers, view.flatten(1)], 1))
        return motion

    def _numbers(self, state: State, actions: Tensor, executed: Tensor) -> Tensor:
        """Everything but the frames: what moves, normalised, which actions are executed, and the task."""
        moving = (_moving(state, actions) - self.moving_mean) / self.moving_std
        return torch.cat([moving, executed, state[TASK]], 1)


def _moving(state: State, actions: Tensor) -> Tensor:
    """Actions, those before, how far the robot was commanded to move since the episode began and has moved,
    its state, its velocity.

    No frame shows how fast the robot moves, nor how far it has still to go to where it is commanded.
    """
    before, newest = state["robot"].unbind(1)
    parts = [
        actions.flatten(1),
        state["actions"].flatten(1),
        state["commanded_sum"],
        newest - state["first_robot"],
        newest,
        newest - before,
    ]
    return torch.cat(parts, 1)


class SuccessModel(nn.Module):
    """P(an image shows the task achieved), by a convolutional network of 0.3 million weights."""

    threshold: Tensor
    """Scalar, P above which an imagined frame counts as a success."""

    def __init__(self, cameras: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.PixelUnshuffle(2)]
        for before, width in pairwise((12 * cameras, 32, 64, 96)):
            convolution = nn.Conv2d(before, width, 3, stride=2, padding=1)
            layers += [convolution, nn.GroupNorm(8, width), nn.SiLU()]
        self.convolutions = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(GRID), nn.Flatten())
        hidden = nn.Linear(96 * GRID * GRID + TASK_BITS, HIDDEN)
        self.out = nn.Sequential(hidden, nn.SiLU(), nn.Linear(HIDDEN, 1))
        self.register_buffer("threshold", torch.tensor(0.5))

    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        """Logits (N,), of images (N, 3·V, H, W) in [−1, 1] and task codes (N, 16)."""
        return self.out(torch.cat([self.convolutions(images), codes], 1))[:, 0]

    @torch.no_grad()
    def probabilities(self, frames: Tensor, codes: Tensor) -> Tensor:
        """float32 (N,), of frames uint8 (N, V, H, W, 3) and task codes (N, 16)."""
        parts = zip(frames.split(AT_ONCE), codes.split(AT_ONCE), strict=True)
        return torch.cat([self(_to_floats(some), of_these) for some, of_these in parts]).sigmoid()

    def loss(self, frames: Tensor, codes: Tensor, success: Tensor) -> Tensor:
        """Cross-entropy on frames that are shifted, lit and noisy at random; success is bool (N,)."""
        images = shifted(_to_floats(frames))
        light = 1 + LIGHT * torch.randn(len(images), 1, 1, 1, device=images.device)
        level = NOISE * torch.rand(len(images), 1, 1, 1, device=images.device)
        augmented = light * (images + 1) - 1 + level * torch.randn_like(images)
        logits = self(augmented.clamp(-1, 1), codes)
        return functional.binary_cross_entropy_with_logits(logits, success.float())


def _to_floats(frames: Tensor) -> Tensor:
    """uint8 (B, V, H, W, 3) to float32 (B, 3·V, H, W) in [−1, 1]."""
    return (frames.float() / 127.5 - 1).movedim(-1, 2).flatten(1, 2)


def _newest_frames(state: State) -> Tensor:
    """The newest frames of a state, float32 (B, 3·V, H, W) in [−1, 1]."""
    return _to_floats(state["frames"][:, -1])


class FrameNetwork(nn.Module):
    """(frames, numbers) → image: a U-Net of diffusers.

    Space-to-depth keeps it cheap on a CPU: pixels move into channels before the first convolution, so no
    layer works at full resolution. The numbers enter twice, through adaptive norms and as planes beside the
    frames. The last layer starts at zero, so an untrained model predicts no change.

    `image` and `frames` are channels of the predicted image and of the frames it is conditioned on.
    """

    def __init__(self, image: int, frames: int, numbers: int, channels: Sequence[int]) -> None:
        super().__init__()
        pixels = SPACE_TO_DEPTH**2
        hidden = nn.Linear(numbers, HIDDEN)
        condition = nn.Linear(HIDDEN, 4 * channels[0])
        self.condition = nn.Sequential(hidden, nn.SiLU(), condition)
        self.planes = nn.Linear(numbers, PLANES)
        self.unet = UNet2DModel(
            in_channels=frames * pixels + PLANES,
            out_channels=image * pixels,
            block_out_channels=tuple(channels),
            down_block_types=("DownBlock2D",) * len(channels),
            up_block_types=("UpBlock2D",) * len(channels),
            layers_per_block=1,
            norm_num_groups=math.gcd(8, *channels),
            attention_head_dim=math.gcd(32, channels[-1]),
            resnet_time_scale_shift="scale_shift",
            class_embed_type="identity",
        )
        _zero(self.unet.conv_out)

    def forward(self, frames: Tensor, numbers: Tensor) -> Tensor:
        """(B, frames, H, W) and (B, numbers) to (B, image, H, W); zero before training."""
        pixels = functional.pixel_unshuffle(frames, SPACE_TO_DEPTH)
        planes = self.planes(numbers)[:, :, None, None].expand(-1, -1, *pixels.shape[2:])
        seen = torch.cat([pixels, planes], 1)
        made = self.unet(seen, timestep=0, class_labels=self.condition(numbers)).sample
        return functional.pixel_shuffle(made, SPACE_TO_DEPTH)


def _zero[M: nn.Module](layer: M) -> M:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer
