# SPDX-License-Identifier: Apache-2.0
"""Our learned world model: frames by regression, the robot's state by a small ensemble.

The network predicts the change from the newest frame to the one after the chunk, in units of its usual size.
It sees the context, and the anchor, the real frame where the rollout started.

The state is predicted apart from the image, by several heads from state, chunk and a coarse view of the
frame; their disagreement is the uncertainty.

Shapes: see `contract.py`; C = 3·V channels, R chunks of a window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import NetworkConfig, PixelModelConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    Reset,
    State,
    WorldModelSpec,
)
from accerl_lerobot.world_model.data import Windows

COARSE = 8
"""Side of the coarse view that the state heads get."""


class PixelWorldModel(LearnableWorldModel):
    """World model of images and robot state; its statistics are saved with the weights.

    Raises:
        InputError: the images do not divide into the network's blocks.
    """

    def __init__(self, spec: WorldModelSpec, config: PixelModelConfig) -> None:
        super().__init__(spec, config)
        self.config: PixelModelConfig = config
        multiple = config.multiple
        if any(side % multiple for side in spec.image_size):
            remedy = f"use sides that are multiples of {multiple}, or change world_model.model.network"
            raise InputError("world_model.image_size", spec.image_size, remedy)
        channels = 3 * len(spec.cameras)
        chunk = spec.chunk * (spec.action_dim * spec.context + 1) + spec.action_dim + spec.state_dim
        self.network = FrameNetwork(
            channels, (spec.context + 1) * channels, chunk, spec.state_dim, config.network
        )
        inputs = spec.state_dim * spec.context + chunk + channels * COARSE * COARSE
        self.heads = nn.ModuleList(StateHead(inputs, spec.state_dim) for _ in range(config.heads))
        for name, size in (
            ("robot", spec.state_dim),
            ("action", spec.action_dim),
            ("motion", spec.state_dim),
            ("commanded", spec.action_dim),
        ):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("change", torch.tensor(0.1))

    def fit_statistics(self, windows: Windows) -> None:
        valid, now = windows.valid[:, 0], windows.context - 1
        state = windows.state[:, now]
        executed = np.arange(self.spec.chunk) < windows.steps[:, 0, None]
        samples = {
            "robot": state,
            "motion": (windows.state[:, now + 1] - state)[valid],
            "action": windows.actions[:, 0][executed],
            "commanded": windows.commanded_sum,
        }
        for name, values in samples.items():
            getattr(self, f"{name}_mean").copy_(torch.from_numpy(values.mean(0)))
            getattr(self, f"{name}_std").copy_(torch.from_numpy(values.std(0)).clamp(min=1e-3))
        frames = windows.frames[valid, now : now + 2].astype(np.float32) / 127.5
        change = float(np.sqrt(np.square(frames[:, 1] - frames[:, 0]).mean()))
        self.change.fill_(max(change, 1e-3))

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        state = {name: x.to(self.change.device) for name, x in context._asdict().items()}
        return state | {"anchor": state["frames"][:, -1]}

    @torch.no_grad()
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        actions = actions.to(self.change.device)
        steps = torch.full(actions.shape[:1], self.spec.chunk, device=actions.device)
        chunk = self._chunk(state, actions, self._executed(steps))
        image = self._image(state, chunk)
        frames = _to_bytes(image, len(self.spec.cameras))
        robot, disagreement = self._robot(state, chunk)
        # After rounding to bytes a NaN looks like any other pixel.
        finite = torch.isfinite(image).flatten(1).all(1)
        return Prediction(
            state=_advance(state, frames, robot, actions),
            frames=frames,
            robot=robot,
            uncertainty=torch.where(finite, disagreement / self.uncertainty_scale, torch.inf),
        )

    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss over every valid chunk; after the first, the model's own prediction is its input.

        Returns:
            The loss, and ``image``, ``state`` and, of chunks after the first, ``image_imagined``.
        """
        device = self.change.device
        names = ("frames", "anchor", "state", "before", "commanded_sum", "initial_state", "actions", "steps")
        tensors = {name: torch.from_numpy(getattr(windows, name)).to(device) for name in (*names, "valid")}
        length, chunks = self.spec.context, tensors["steps"].shape[1]
        state = {
            "frames": tensors["frames"][:, :length],
            "anchor": tensors["anchor"],
            "robot": tensors["state"][:, :length],
            "actions": tensors["before"],
            "commanded_sum": tensors["commanded_sum"],
            "initial_state": tensors["initial_state"],
        }
        images, robots, weights = [], [], []
        for r in range(chunks):
            executed = self._executed(tensors["steps"][:, r])
            actions = tensors["actions"][:, r] * executed[..., None]
            chunk = self._chunk(state, actions, executed)
            target = _to_floats(tensors["frames"][:, length + r])
            images.append(self._image_loss(state, chunk, target, generator))
            robots.append(self._robot_loss(state, chunk, tensors["state"][:, length + r]))
            weights.append(tensors["valid"][:, r].float())
            if r + 1 < chunks:
                state = self._predicted(state, chunk, actions)
        weight = torch.stack(weights)
        total = weight.sum().clamp(min=1)
        image, robot = ((torch.stack(part) * weight).sum() / total for part in (images, robots))
        metrics = {"image": image.item(), "state": robot.item()}
        if chunks > 1:
            later = weight[1:].sum().clamp(min=1)
            metrics["image_imagined"] = ((torch.stack(images[1:]) * weight[1:]).sum() / later).item()
        return image + self.config.state_weight * robot, metrics

    # Frames.

    def _image_loss(self, state: State, chunk: Tensor, target: Tensor, generator: torch.Generator) -> Tensor:
        """Mean squared error of the change, (B,)."""
        change = (target - _to_floats(state["frames"][:, -1])) / self.change
        return (self._change(state, chunk, generator) - change).square().mean((1, 2, 3))

    def _image(self, state: State, chunk: Tensor) -> Tensor:
        """The frame after the chunk, (B, C, H, W) in [−1, 1]."""
        newest = _to_floats(state["frames"][:, -1])
        return (newest + self.change * self._change(state, chunk)).clamp(-1, 1)

    def _change(self, state: State, chunk: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The change in usual changes, (B, C, H, W); with a generator, the context is noisy."""
        frames = _to_floats(torch.cat([state["frames"], state["anchor"][:, None]], 1).flatten(1, 2))
        if generator is not None and self.config.context_noise:
            level = self.config.context_noise * torch.rand(len(frames), 1, 1, 1, generator=generator)
            frames = frames + (level * torch.randn(frames.shape, generator=generator)).to(frames)
        robot = None
        if self.spec.state_dim:
            robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        change: Tensor = self.network(frames, chunk, robot)
        return change

    def _predicted(self, state: State, chunk: Tensor, actions: Tensor) -> State:
        """State after the model's own prediction of a chunk, without gradient."""
        with torch.no_grad():
            frames = _to_bytes(self._image(state, chunk), len(self.spec.cameras))
            robot, _ = self._robot(state, chunk)
        return _advance(state, frames, robot, actions)

    # The robot's state.

    def _robot(self, state: State, chunk: Tensor) -> tuple[Tensor, Tensor]:
        """State after the chunk, (B, S), and how far the heads disagree, (B,)."""
        motions, robot = self._motions(state, chunk), state["robot"][:, -1]
        moved = robot + self.motion_mean + self.motion_std * motions.mean(0)
        if not self.spec.state_dim:
            return moved, robot.new_full((len(robot),), torch.nan)
        return moved, motions.std(0).mean(-1)

    def _robot_loss(self, state: State, chunk: Tensor, target: Tensor) -> Tensor:
        motion = (target - state["robot"][:, -1] - self.motion_mean) / self.motion_std
        motions = self._motions(state, chunk)
        if not self.spec.state_dim:
            return motion.new_zeros(len(motion))
        return (motions - motion).square().mean((0, 2))

    def _motions(self, state: State, chunk: Tensor) -> Tensor:
        """(heads, B, S), in units of usual motions."""
        view = functional.adaptive_avg_pool2d(_to_floats(state["frames"][:, -1]), COARSE).flatten(1)
        robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        velocity = (state["robot"][:, 1:] - state["robot"][:, :-1]) / self.motion_std
        inputs = torch.cat([robot, velocity.flatten(1), chunk, view], 1)
        return torch.stack([head(inputs) for head in self.heads])

    def _executed(self, steps: Tensor) -> Tensor:
        """bool (B, K), the first `steps` (B,) of a chunk."""
        return torch.arange(self.spec.chunk, device=steps.device) < steps[:, None]

    def _chunk(self, state: State, actions: Tensor, executed: Tensor) -> Tensor:
        """(B, K·(A + 1) + (L − 1)·K·A + A + S): normalised actions, which of them are executed, those before,
        and how far the robot was commanded to move since the beginning and has moved.

        No frame shows how fast the robot moves, nor how far it has still to go to where it is commanded.
        """
        normal = (actions - self.action_mean) / self.action_std * executed[..., None]
        before = (state["actions"] - self.action_mean) / self.action_std
        commanded = (state["commanded_sum"] - self.commanded_mean) / self.commanded_std
        moved = (state["robot"][:, -1] - state["initial_state"]) / self.robot_std
        return torch.cat([normal.flatten(1), executed.float(), before.flatten(1), commanded, moved], 1)


class StateHead(nn.Module):
    """Predicts the robot's motion; starts at the mean motion."""

    def __init__(self, into: int, state: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(into, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU())
        self.out = nn.Linear(128, state)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        """(B, into) to (B, S)."""
        out: Tensor = self.out(self.layers(inputs))
        return out


def _advance(state: State, frames: Tensor, robot: Tensor, actions: Tensor) -> State:
    """Shifts the context on to the newest frame; the anchor stays."""
    newest = {"frames": frames, "robot": robot, "actions": actions}
    shifted = {key: torch.cat([state[key], new[:, None]], 1)[:, 1:] for key, new in newest.items()}
    kept = {key: state[key] for key in ("anchor", "initial_state")}
    return shifted | kept | {"commanded_sum": state["commanded_sum"] + actions.sum(1)}


def _to_floats(frames: Tensor) -> Tensor:
    """uint8 (B, V, H, W, 3) to float32 (B, 3·V, H, W) in [−1, 1]."""
    return (frames.float() / 127.5 - 1).movedim(-1, 2).flatten(1, 2)


def _to_bytes(image: Tensor, cameras: int) -> Tensor:
    """Inverse of `_to_floats`, rounded."""
    return ((image + 1) * 127.5).round().clamp(0, 255).byte().unflatten(1, (cameras, 3)).movedim(2, -1)


# The network.


class FrameNetwork(nn.Module):
    """(frames, chunk, state) → image: a small U-Net.

    Space-to-depth keeps it cheap on a CPU: pixels move into channels before the first convolution, so no
    layer works at full resolution. The chunk enters twice, through adaptive norms and as planes beside the
    frames. The last layers start at zero, so an untrained model predicts no change.

    `image` and `frames` are channels of the image that is made and of the frames it is conditioned on;
    `action` is how many numbers describe a chunk; `state` is S, which may be 0.
    """

    def __init__(self, image: int, frames: int, action: int, state: int, config: NetworkConfig) -> None:
        super().__init__()
        self.config, width = config, config.condition
        pixels = config.space_to_depth**2
        self.chunk = nn.Sequential(nn.Linear(action, width), nn.SiLU(), nn.Linear(width, width))
        self.state = nn.Linear(state, width) if state else None
        self.mix = nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.plane = nn.Linear(action, config.planes) if config.planes else None
        first = config.channels[0]
        self.enter = nn.Conv2d(frames * pixels + config.planes, first, 3, padding=1)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        here = first
        for level, there in enumerate(config.channels):
            steps = nn.ModuleList()
            if level:
                steps.append(nn.Conv2d(here, there, 3, stride=2, padding=1))
            steps.extend(Block(there, there, width) for _ in range(config.blocks))
            self.down.append(steps)
            here = there
        self.middle = nn.ModuleList([Block(here, here, width), Attention(here), Block(here, here, width)])
        for level, there in reversed(list(enumerate(config.channels))):
            steps = nn.ModuleList([Block(here + there, there, width)])
            steps.extend(Block(there, there, width) for _ in range(config.blocks - 1))
            if level:
                steps.append(nn.Conv2d(there, config.channels[level - 1], 3, padding=1))
            self.up.append(steps)
            here = config.channels[level - 1] if level else there
        self.leave = nn.Sequential(_norm(first), nn.SiLU(), nn.Conv2d(first, image * pixels, 3, padding=1))
        _zero(self.leave[-1])

    def forward(self, frames: Tensor, chunk: Tensor, state: Tensor | None) -> Tensor:
        """(B, image, H, W), zero everywhere before training.

        Args:
            frames: (B, frames, H, W).
            chunk: (B, action).
            state: (B, S), if the network was built for one.
        """
        condition = self.chunk(chunk)
        if self.state is not None and state is not None:
            condition = condition + self.state(state)
        condition = self.mix(condition)
        h = functional.pixel_unshuffle(frames, self.config.space_to_depth)
        if self.plane is not None:
            planes = self.plane(chunk)[:, :, None, None].expand(-1, -1, *h.shape[2:])
            h = torch.cat([h, planes], 1)
        h = self.enter(h)
        kept = []
        for level in self.down:
            for step in level:
                h = step(h, condition) if isinstance(step, Block) else step(h)
            kept.append(h)
        for step in self.middle:
            h = step(h, condition) if isinstance(step, Block) else step(h)
        for level in self.up:
            h = torch.cat([h, kept.pop()], 1)
            for step in level:
                if isinstance(step, Block):
                    h = step(h, condition)
                else:
                    h = step(functional.interpolate(h, scale_factor=2.0, mode="nearest"))
        return functional.pixel_shuffle(self.leave(h), self.config.space_to_depth)


class Block(nn.Module):
    """Two convolutions with adaptive group norms and a skip connection; starts as the identity."""

    def __init__(self, into: int, out: int, condition: int) -> None:
        super().__init__()
        self.skip = nn.Conv2d(into, out, 1) if into != out else nn.Identity()
        self.norms = nn.ModuleList([_norm(into, affine=False), _norm(out, affine=False)])
        self.convs = nn.ModuleList([nn.Conv2d(i, out, 3, padding=1) for i in (into, out)])
        self.adapt = nn.ModuleList([nn.Linear(condition, 2 * i) for i in (into, out)])
        _zero(self.convs[1])

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, into, H, W) to (B, out, H, W)."""
        h = x
        for norm, conv, adapt in zip(self.norms, self.convs, self.adapt, strict=True):
            scale, shift = adapt(condition)[:, :, None, None].chunk(2, 1)
            h = conv(functional.silu(norm(h) * (1 + scale) + shift))
        return self.skip(x) + h


class Attention(nn.Module):
    """Self-attention over positions, in heads of 32 channels or fewer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = max(1, width // 32)
        while width % self.heads:
            self.heads -= 1
        self.norm = _norm(width)
        self.into, self.out = nn.Conv2d(width, 3 * width, 1), nn.Conv2d(width, width, 1)
        _zero(self.out)

    def forward(self, x: Tensor) -> Tensor:
        """(B, width, H, W) to the same."""
        b, c, h, w = x.shape
        parts = self.into(self.norm(x)).view(b, 3, self.heads, c // self.heads, h * w).transpose(3, 4)
        mixed = functional.scaled_dot_product_attention(*parts.unbind(1))
        return x + self.out(mixed.transpose(2, 3).reshape(b, c, h, w))


def _norm(channels: int, *, affine: bool = True) -> nn.GroupNorm:
    return nn.GroupNorm(math.gcd(channels, 8), channels, affine=affine)


def _zero(layer: nn.Module) -> None:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
