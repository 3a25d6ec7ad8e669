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

from accerl_lerobot.experience import TASK, TASK_BITS, task_codes
from accerl_lerobot.world_model.config import SPACE_TO_DEPTH, PixelModelConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    State,
    Windows,
    WorldModelSpec,
)

COARSE = 8  # side of the coarse view of the frame from which the robot's state is predicted
CONTEXT_NOISE = 0.02
"""Largest std of the noise on the context's frames in training, in units of [−1, 1]: imagined frames are
never as clean as recorded ones."""
HIDDEN = 128  # width of hidden layers
PLANES = 8  # channels of the planes that tell the actions
GRID = 4  # side of the success model's last feature map
NOISE = 0.03  # largest std of the noise on frames in the success model's training, where 1 is white
SHIFT = 3  # their largest shift in pixels


class PixelWorldModel(LearnableWorldModel):
    """World model of images and robot state; its statistics are saved with the weights."""

    def __init__(self, spec: WorldModelSpec, config: PixelModelConfig) -> None:
        super().__init__(spec, config)
        channels = 3 * len(spec.cameras)
        robot = spec.state_dim
        action = spec.action_dim
        of_actions = spec.chunk * (action * spec.context + 1) + action
        of_robot = robot * (spec.context + 1)
        numbers = of_actions + of_robot + TASK_BITS
        self.network = FrameNetwork(channels, (spec.context + 1) * channels, numbers, config.channels)
        self.motion = nn.Sequential(
            nn.Linear(numbers + channels * COARSE * COARSE, HIDDEN), nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN), nn.SiLU(),
            _zero(nn.Linear(HIDDEN, robot)),
        )  # fmt: skip
        sizes = {"robot": robot, "action": action, "motion": robot, "commanded": action}
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("change", torch.tensor(0.1))

    def fit_statistics(self, windows: Windows) -> None:
        steps = windows.steps[:, 0]
        valid = steps > 0
        state = windows.context.robot[:, -1]
        newest = windows.context.frames[:, -1]
        samples = {
            "robot": state,
            "motion": (windows.robot[:, 0] - state)[valid],
            "action": windows.actions[:, 0][self._executed(steps)],
            "commanded": windows.context.commanded_sum,
        }
        for name, values in samples.items():
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0, correction=0).clamp(min=1e-3))
        change = _to_floats(windows.frames[valid, 0]) - _to_floats(newest[valid])
        self.change.copy_(change.square().mean().sqrt().clamp(min=1e-3))

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        given = context._asdict() | {TASK: torch.from_numpy(task_codes(tasks))}
        return {name: tensor.to(self.change.device) for name, tensor in given.items()}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        actions = actions.to(self.change.device)
        return self._predict(state, actions, torch.ones_like(actions[..., 0], dtype=torch.bool))

    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss over every valid chunk; after the first, the model's own prediction is its input."""
        device = self.change.device
        frames = windows.frames.to(device)
        robot = windows.robot.to(device)
        steps = windows.steps.to(device)
        state = self.begin(windows.context, windows.tasks)
        images = []
        motions = []
        for r in range(steps.shape[1]):
            executed = self._executed(steps[:, r])
            actions = windows.actions[:, r].to(device) * executed[..., None]
            numbers = self._numbers(state, actions, executed)
            change = (_to_floats(frames[:, r]) - _newest_frames(state)) / self.change
            error = self._change(state, numbers, generator) - change
            images.append(error.square().mean((1, 2, 3)))
            motion = (robot[:, r] - state["robot"][:, -1] - self.motion_mean) / self.motion_std
            error = self._motion(state, numbers) - motion
            motions.append(error.square().sum(1) / max(1, motion.shape[1]))
            if r + 1 < steps.shape[1]:
                state = self._predict(state, actions, executed).state
        weight = (steps > 0).float()
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
        motion = self.motion_mean + self.motion_std * self._motion(state, numbers)
        robot = state["robot"][:, -1] + motion
        following = state | {"commanded_sum": state["commanded_sum"] + actions.sum(1)}
        for name, newest in {"frames": frames, "robot": robot, "actions": actions}.items():
            following[name] = torch.cat([state[name], newest[:, None]], 1)[:, 1:]
        return Prediction(state=following, frames=frames, robot=robot)

    def _executed(self, steps: Tensor) -> Tensor:
        """bool (B, K), True for the actions of a chunk that were executed, of (B,) counts."""
        return torch.arange(self.spec.chunk, device=steps.device) < steps[:, None]

    def _change(self, state: State, numbers: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The change in usual changes, (B, C, H, W); with a generator, the frames that are seen are noisy."""
        seen = torch.cat([state["frames"], state["first_frame"][:, None]], 1)
        frames = _to_floats(seen.flatten(1, 2))
        if generator is not None:
            level = CONTEXT_NOISE * torch.rand(len(frames), 1, 1, 1, generator=generator)
            noise = level * torch.randn(frames.shape, generator=generator)
            frames = frames + noise.to(frames)
        change: Tensor = self.network(frames, numbers)
        return change

    def _motion(self, state: State, numbers: Tensor) -> Tensor:
        """The robot's motion in usual motions, (B, S)."""
        view = functional.adaptive_avg_pool2d(_newest_frames(state), COARSE)
        motion: Tensor = self.motion(torch.cat([numbers, view.flatten(1)], 1))
        return motion

    def _numbers(self, state: State, actions: Tensor, executed: Tensor) -> Tensor:
        """Everything but the frames, normalised: actions, which of them are executed, those before, how far
        the robot was commanded to move since the episode began and has moved, its state, velocity, the task.

        No frame shows how fast the robot moves, nor how far it has still to go to where it is commanded.
        """
        robot = state["robot"]
        newest = robot[:, -1]
        parts = [
            (actions - self.action_mean) / self.action_std * executed[..., None],
            executed.float(),
            (state["actions"] - self.action_mean) / self.action_std,
            (state["commanded_sum"] - self.commanded_mean) / self.commanded_std,
            (newest - state["first_robot"]) / self.robot_std,
            (newest - self.robot_mean) / self.robot_std,
            (robot[:, 1:] - robot[:, :-1]) / self.motion_std,
            state[TASK],
        ]
        return torch.cat([part.flatten(1) for part in parts], 1)


class SuccessModel(nn.Module):
    """P(an image shows the task achieved), by a convolutional network of 0.3 million weights.

    Cameras share their convolutions, and their features are averaged.
    """

    threshold: Tensor
    """Scalar, P above which an imagined frame counts as a success."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.PixelUnshuffle(2)]
        for before, width in pairwise((12, 32, 64, 96)):
            convolution = nn.Conv2d(before, width, 3, stride=2, padding=1)
            layers += [convolution, nn.GroupNorm(8, width), nn.SiLU()]
        self.convolutions = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(GRID), nn.Flatten())
        self.hidden = nn.Linear(96 * GRID * GRID + TASK_BITS, HIDDEN)
        self.out = nn.Linear(HIDDEN, 1)
        self.register_buffer("threshold", torch.tensor(0.5))

    def forward(self, images: Tensor, tasks: Tensor) -> Tensor:
        """Logits (B,), of images (B, V, 3, H, W) in [0, 1] and task codes (B, 16)."""
        features = self.convolutions(2 * images.flatten(0, 1) - 1)
        features = features.unflatten(0, images.shape[:2])
        codes = tasks[:, None].expand(-1, images.shape[1], -1)
        hidden = self.hidden(torch.cat([features, codes], 2))
        of_image = functional.silu(hidden).mean(1)
        return self.out(of_image)[:, 0]

    @torch.no_grad()
    def probabilities(self, frames: Tensor, tasks: Tensor) -> Tensor:
        """float32 (N,) on the CPU, of frames uint8 (N, V, H, W, 3) and task codes (N, 16)."""
        parts = []
        for part, codes in zip(frames.split(256), tasks.split(256), strict=True):
            logits = self(self._images(part), codes.to(self.threshold))
            parts.append(torch.sigmoid(logits))
        return torch.cat(parts).cpu()

    def loss(self, frames: Tensor, tasks: Tensor, success: Tensor, generator: torch.Generator) -> Tensor:
        """Cross-entropy on frames that are shifted, lit and noisy at random; success is bool (N,)."""
        images = self._images(frames)
        height, width = images.shape[-2:]
        # One shift for a batch is enough: there are many batches.
        y, x = torch.randint(2 * SHIFT + 1, (2,), generator=generator).tolist()
        padded = functional.pad(images.flatten(0, 1), (SHIFT,) * 4, mode="replicate")
        shifted = padded[..., y : y + height, x : x + width].unflatten(0, images.shape[:2])
        each = (len(images), 1, 1, 1, 1)
        light = 1 + 0.1 * torch.randn(each, generator=generator)
        level = NOISE * torch.rand(each, generator=generator)
        noise = level * torch.randn(images.shape, generator=generator)
        augmented = shifted * light.to(images) + noise.to(images)
        logits = self(augmented.clamp(0, 1), tasks.to(images))
        return functional.binary_cross_entropy_with_logits(logits, success.to(images))

    def _images(self, frames: Tensor) -> Tensor:
        return frames.to(self.threshold.device).movedim(-1, 2).float() / 255


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
