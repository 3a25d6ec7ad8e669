# SPDX-License-Identifier: Apache-2.0
"""Our learned world model: frames by regression, the robot's state by a small ensemble.

The network predicts the change from the newest frame to the one after the chunk, in units of its usual size.
It sees the context, the task, and the anchor, the real frame where the rollout started.

The state is predicted apart from the image, by several heads from state, chunk and a coarse view of the
frame; their disagreement is the uncertainty.

Shapes: see `contract.py`; C = 3·V channels, R chunks of a window.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import torch
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
    context_of,
)

COARSE = 8  # side of the coarse view that the state heads get
CONTEXT_NOISE = 0.02
"""Largest std of the noise on context and anchor in training, in units of [−1, 1]: imagined frames are never
as clean as recorded ones."""
HEADS = 3  # size of the ensemble that predicts the robot's state; its disagreement is the uncertainty
CONDITION, PLANES = 128, 8
"""Width of the conditioning vector that the adaptive norms read; channels of the action planes."""


class PixelWorldModel(LearnableWorldModel):
    """World model of images and robot state; its statistics are saved with the weights."""

    def __init__(self, spec: WorldModelSpec, config: PixelModelConfig) -> None:
        super().__init__(spec, config)
        self.config: PixelModelConfig = config
        channels = 3 * len(spec.cameras)
        robot, action = spec.state_dim, spec.action_dim
        chunk = spec.chunk * (action * spec.context + 1) + action + robot + TASK_BITS
        frames = (spec.context + 1) * channels
        self.network = FrameNetwork(channels, frames, chunk, spec.state_dim, config.channels)
        inputs = spec.state_dim * spec.context + chunk + channels * COARSE * COARSE
        self.heads = nn.ModuleList(_state_head(inputs, spec.state_dim) for _ in range(HEADS))
        for name, size in {"robot": robot, "action": action, "motion": robot, "commanded": action}.items():
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

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        given = context._asdict() | {TASK: torch.from_numpy(task_codes(tasks))}
        state = {name: x.to(self.change.device) for name, x in given.items()}
        return state | {"anchor": state["frames"][:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        actions = actions.to(self.change.device)
        return self._predict(state, actions, torch.ones_like(actions[..., 0], dtype=torch.bool))

    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss over every valid chunk; after the first, the model's own prediction is its input."""
        device = self.change.device
        arrays = (windows.frames, windows.state, windows.actions, windows.steps, windows.valid)
        frames, robot, actions, steps, valid = (torch.from_numpy(array).to(device) for array in arrays)
        state = self.begin(context_of(windows), windows.task)
        state["anchor"] = torch.from_numpy(windows.anchor).to(device)
        length, chunks = self.spec.context, steps.shape[1]
        images, robots = [], []
        for r in range(chunks):
            executed = torch.arange(self.spec.chunk, device=device) < steps[:, r, None]
            taken = actions[:, r] * executed[..., None]
            chunk = self._chunk(state, taken, executed)
            change = (_to_floats(frames[:, length + r]) - _to_floats(state["frames"][:, -1])) / self.change
            images.append((self._change(state, chunk, generator) - change).square().mean((1, 2, 3)))
            motion = (robot[:, length + r] - state["robot"][:, -1] - self.motion_mean) / self.motion_std
            error = (self._motions(state, chunk) - motion).square()
            robots.append(error.mean((0, 2)) if self.spec.state_dim else motion.new_zeros(len(motion)))
            if r + 1 < chunks:
                state = self._predict(state, taken, executed).state
        weight = valid.T.float().contiguous()
        total = weight.sum().clamp(min=1)
        image, state_loss = ((torch.stack(part) * weight).sum() / total for part in (images, robots))
        metrics = {"image": image.item(), "state": state_loss.item()}
        if chunks > 1:
            later = weight[1:].sum().clamp(min=1)
            metrics["image_imagined"] = ((torch.stack(images[1:]) * weight[1:]).sum() / later).item()
        return image + state_loss, metrics

    @torch.no_grad()
    def _predict(self, state: State, actions: Tensor, executed: Tensor) -> Prediction:
        chunk, newest = self._chunk(state, actions, executed), _to_floats(state["frames"][:, -1])
        image = (newest + self.change * self._change(state, chunk)).clamp(-1, 1)
        pixels = ((image + 1) * 127.5).round().clamp(0, 255).byte()
        frames = pixels.unflatten(1, (len(self.spec.cameras), 3)).movedim(2, -1)
        motions = self._motions(state, chunk)
        robot = state["robot"][:, -1] + self.motion_mean + self.motion_std * motions.mean(0)
        # Without a state it is NaN: the mean of nothing.
        uncertainty = motions.std(0).mean(-1) / self.uncertainty_scale
        # After rounding to bytes a NaN looks like any other pixel.
        finite = torch.isfinite(image).flatten(1).all(1)
        return Prediction(
            state=_advance(state, frames, robot, actions),
            frames=frames,
            robot=robot,
            uncertainty=torch.where(finite, uncertainty, torch.inf),
        )

    def _change(self, state: State, chunk: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The change in usual changes, (B, C, H, W); with a generator, the context is noisy."""
        frames = _to_floats(torch.cat([state["frames"], state["anchor"][:, None]], 1).flatten(1, 2))
        if generator is not None:
            level = CONTEXT_NOISE * torch.rand(len(frames), 1, 1, 1, generator=generator)
            frames = frames + (level * torch.randn(frames.shape, generator=generator)).to(frames)
        robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        change: Tensor = self.network(frames, chunk, robot)
        return change

    def _motions(self, state: State, chunk: Tensor) -> Tensor:
        """(heads, B, S), in units of usual motions."""
        view = functional.adaptive_avg_pool2d(_to_floats(state["frames"][:, -1]), COARSE).flatten(1)
        robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        velocity = (state["robot"][:, 1:] - state["robot"][:, :-1]) / self.motion_std
        inputs = torch.cat([robot, velocity.flatten(1), chunk, view], 1)
        return torch.stack([head(inputs) for head in self.heads])

    def _chunk(self, state: State, actions: Tensor, executed: Tensor) -> Tensor:
        """(B, K·(A + 1) + (L − 1)·K·A + A + S + 16): normalised actions, which of them are executed, those
        before, how far the robot was commanded to move since the beginning and has moved, and the task.

        No frame shows how fast the robot moves, nor how far it has still to go to where it is commanded.
        """
        normal = (actions - self.action_mean) / self.action_std * executed[..., None]
        before = (state["actions"] - self.action_mean) / self.action_std
        commanded = (state["commanded_sum"] - self.commanded_mean) / self.commanded_std
        moved = (state["robot"][:, -1] - state["initial_state"]) / self.robot_std
        known = (before.flatten(1), commanded, moved, state[TASK])
        return torch.cat([normal.flatten(1), executed.float(), *known], 1)


def _state_head(into: int, state: int) -> nn.Sequential:
    """Predicts the robot's motion; starts at the mean motion."""
    hidden = (nn.Linear(into, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU())
    return nn.Sequential(*hidden, _zero(nn.Linear(128, state)))


def _advance(state: State, frames: Tensor, robot: Tensor, actions: Tensor) -> State:
    """Shifts the context on to the newest frame; anchor and task stay."""
    newest = {"frames": frames, "robot": robot, "actions": actions}
    shifted = {key: torch.cat([state[key], new[:, None]], 1)[:, 1:] for key, new in newest.items()}
    kept = {key: state[key] for key in ("anchor", "initial_state", TASK)}
    return shifted | kept | {"commanded_sum": state["commanded_sum"] + actions.sum(1)}


def _to_floats(frames: Tensor) -> Tensor:
    """uint8 (B, V, H, W, 3) to float32 (B, 3·V, H, W) in [−1, 1]."""
    return (frames.float() / 127.5 - 1).movedim(-1, 2).flatten(1, 2)


class FrameNetwork(nn.Module):
    """(frames, chunk, state) → image: a small U-Net.

    Space-to-depth keeps it cheap on a CPU: pixels move into channels before the first convolution, so no
    layer works at full resolution. The chunk enters twice, through adaptive norms and as planes beside the
    frames. The last layers start at zero, so an untrained model predicts no change.

    `image` and `frames` are channels of the image that is made and of the frames it is conditioned on;
    `action` is how many numbers describe a chunk; `state` is S, which may be 0.
    """

    def __init__(self, image: int, frames: int, action: int, state: int, channels: Sequence[int]) -> None:
        super().__init__()
        pixels, first = SPACE_TO_DEPTH**2, channels[0]
        self.chunk = nn.Sequential(nn.Linear(action, CONDITION), nn.SiLU(), nn.Linear(CONDITION, CONDITION))
        self.state = nn.Linear(state, CONDITION) if state else None
        self.mix = nn.Sequential(nn.SiLU(), nn.Linear(CONDITION, CONDITION), nn.SiLU())
        self.plane = nn.Linear(action, PLANES)
        self.enter = nn.Conv2d(frames * pixels + PLANES, first, 3, padding=1)
        self.down, self.up = nn.ModuleList([nn.ModuleList([Block(first, first)])]), nn.ModuleList()
        for finer, width in pairwise(channels):
            shrink = nn.Conv2d(finer, width, 3, stride=2, padding=1)
            self.down.append(nn.ModuleList([shrink, Block(width, width)]))
        coarsest = channels[-1]
        self.middle = nn.ModuleList(
            [Block(coarsest, coarsest), Attention(coarsest), Block(coarsest, coarsest)]
        )
        for finer, width in reversed(list(pairwise(channels))):
            block, grow = Block(2 * width, width), nn.Conv2d(width, finer, 3, padding=1)
            self.up.append(nn.ModuleList([block, nn.Upsample(scale_factor=2.0), grow]))
        self.up.append(nn.ModuleList([Block(2 * first, first)]))
        self.leave = nn.Sequential(
            _norm(first), nn.SiLU(), _zero(nn.Conv2d(first, image * pixels, 3, padding=1))
        )

    def forward(self, frames: Tensor, chunk: Tensor, state: Tensor) -> Tensor:
        """(B, frames, H, W), (B, action) and (B, S) to (B, image, H, W); zero before training."""
        condition = self.chunk(chunk)
        if self.state is not None:
            condition = condition + self.state(state)
        condition = self.mix(condition)
        h = functional.pixel_unshuffle(frames, SPACE_TO_DEPTH)
        planes = self.plane(chunk)[:, :, None, None].expand(-1, -1, *h.shape[2:])
        h = self.enter(torch.cat([h, planes], 1))
        kept = []
        for level in self.down:
            h = _through(level, h, condition)
            kept.append(h)
        h = _through(self.middle, h, condition)
        for level in self.up:
            h = _through(level, torch.cat([h, kept.pop()], 1), condition)
        return functional.pixel_shuffle(self.leave(h), SPACE_TO_DEPTH)


def _through(steps: Iterable[nn.Module], h: Tensor, condition: Tensor) -> Tensor:
    for step in steps:
        h = step(h, condition) if isinstance(step, Block) else step(h)
    return h


class Block(nn.Module):
    """Two convolutions with adaptive group norms and a skip connection; starts as the identity."""

    def __init__(self, into: int, out: int) -> None:
        super().__init__()
        self.skip = nn.Conv2d(into, out, 1) if into != out else nn.Identity()
        self.norms = nn.ModuleList([_norm(into, affine=False), _norm(out, affine=False)])
        self.convs = nn.ModuleList([nn.Conv2d(i, out, 3, padding=1) for i in (into, out)])
        self.adapt = nn.ModuleList([nn.Linear(CONDITION, 2 * i) for i in (into, out)])
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


def _zero[M: nn.Module](layer: M) -> M:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer
