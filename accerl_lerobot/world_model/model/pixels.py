# SPDX-License-Identifier: Apache-2.0
"""Our learned world model: frames by one of three objectives, the robot's state by a small ensemble.

For ``refiner`` and ``flow`` the image that is made is the change from the newest frame to the one after the
chunk, in units of its usual size; for ``edm`` it is the frame itself, as in DIAMOND. It is conditioned on the
context, and on the anchor, the real frame where the rollout started.

The state is predicted apart from the image, by several heads from state, chunk and a coarse view of the
frame; their disagreement is the uncertainty.

Shapes: see `contract.py`; C = 3·V channels, R chunks of a window.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.data import Windows
from accerl_lerobot.world_model.model import network
from accerl_lerobot.world_model.model.contract import (
    ActionHistory,
    Context,
    LearnableWorldModel,
    Prediction,
    State,
    WorldModelSpec,
)

SIGMA_FRAME = 0.5
"""Standard deviation of frames in [−1, 1], EDM's σ_data of natural images."""
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
        self.network = network.Denoiser(
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

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[ActionHistory | None] | None = None
    ) -> State:
        state = {name: x.to(self.change.device) for name, x in context._asdict().items()}
        return state | {"anchor": state["frames"][:, -1]}

    @torch.no_grad()
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        actions = actions.to(self.change.device)
        steps = torch.full(actions.shape[:1], self.spec.chunk, device=actions.device)
        chunk = self._chunk(state, actions, self._executed(steps))
        image = self._sample(state, chunk, self._noise(seeds, state["frames"]), self.config.steps)
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
                state = self._predicted(state, chunk, actions, generator)
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
        b = len(target)
        newest, net = _to_floats(state["frames"][:, -1]), self._network(state, chunk, generator)
        noise = torch.randn(target.shape, generator=generator).to(target)
        spread = torch.randn(b, generator=generator).to(target)
        if self.config.objective == "edm":
            return network.edm_loss(net, target, noise, (1.2 * spread - 0.4).exp(), SIGMA_FRAME)
        residual = (target - newest) / self.change
        if self.config.objective == "flow":
            # Sampling starts at t = 1, so some rows of the training do.
            t = torch.rand(b, generator=generator).mul(1.1).clamp(max=1).to(target)
            return network.flow_loss(net, residual, noise, t)
        # A model of one pass never refines; others spend half of the training on each.
        alone = 0.5 if self.config.steps > 1 else 1.0
        predict = (torch.rand(b, generator=generator) < alone).to(target.device)
        return network.refiner_loss(net, residual, noise, (spread - 2.0).exp(), predict, 1.0)

    def _sample(self, state: State, chunk: Tensor, noise: Tensor, steps: int) -> Tensor:
        """The frame after the chunk, (B, C, H, W) in [−1, 1]; noise (B, steps, C, H, W)."""
        net = self._network(state, chunk, None)
        if self.config.objective == "edm":
            levels = network.edm_levels(steps, 0.002, self.config.sigma_max)
            return network.edm_sample(net, noise[:, 0], levels, SIGMA_FRAME).clamp(-1, 1)
        newest = _to_floats(state["frames"][:, -1])
        if self.config.objective == "flow":
            residual = network.flow_sample(net, noise[:, 0], steps)
        else:
            levels = np.geomspace(*self.config.refine_levels, max(1, steps - 1))[: steps - 1].tolist()
            residual = network.refiner_sample(net, noise[:, : steps - 1], levels, 1.0)
        return (newest + self.change * residual).clamp(-1, 1)

    def _network(self, state: State, chunk: Tensor, generator: torch.Generator | None) -> network.Network:
        """The network with all but image and label bound; with a generator, its context is noisy."""
        frames = _to_floats(torch.cat([state["frames"], state["anchor"][:, None]], 1).flatten(1, 2))
        if generator is not None and self.config.context_noise:
            level = self.config.context_noise * torch.rand(len(frames), 1, 1, 1, generator=generator)
            frames = frames + (level * torch.randn(frames.shape, generator=generator)).to(frames)
        robot = None
        if self.spec.state_dim:
            robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        return lambda x, label: self.network(x, label, frames, chunk, robot)

    def _predicted(self, state: State, chunk: Tensor, actions: Tensor, generator: torch.Generator) -> State:
        """State after the model's own prediction of a chunk, without gradient."""
        with torch.no_grad():
            b, side = len(chunk), state["frames"].shape[3:5]
            noise = torch.randn(b, 1, 3 * len(self.spec.cameras), *side, generator=generator).to(chunk)
            frames = _to_bytes(self._sample(state, chunk, noise, 1), len(self.spec.cameras))
            robot, _ = self._robot(state, chunk)
        return _advance(state, frames, robot, actions)

    def _noise(self, seeds: Sequence[int], frames: Tensor) -> Tensor:
        """(B, steps, C, H, W), each row from its own seed."""
        size = (self.config.steps, 3 * len(self.spec.cameras), *frames.shape[3:5])
        if self.config.objective == "refiner" and self.config.steps == 1:
            return frames.new_zeros(len(frames), *size, dtype=torch.float32)
        rows = [np.random.default_rng(seed).standard_normal(size, dtype=np.float32) for seed in seeds]
        return torch.from_numpy(np.stack(rows)).to(frames.device)

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
