# SPDX-License-Identifier: Apache-2.0
"""The learnt world models: frames by one of three objectives, the robot's state by a small ensemble.

The image that is made is, for ``refiner`` and ``flow``, the change from the newest frame to the one after the
chunk, in units of its usual size; for ``edm`` the frame itself, as in DIAMOND. It is conditioned on the
context, and on the anchor, the frame at which imagination began, which no error of the model has touched.

The state is predicted apart from the image, by several heads from state, chunk and a coarse look at the
frame; where they disagree the model is asked for something it has not seen.

Shapes: see `contract.py`; C = 3·V channels, R chunks of a window.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import objectives
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import (
    Context,
    Dream,
    History,
    LearnableWorldModel,
    State,
    WorldModelSpec,
)
from accerl_lerobot.world_model.episodes import Windows
from accerl_lerobot.world_model.network import Denoiser

SIGMA_FRAME = 0.5
"""Standard deviation of frames in [−1, 1], EDM's σ_data of natural images."""
LOOK = 8
"""Side of the coarse look that the state heads take."""


class PixelWorldModel(LearnableWorldModel):
    """Trainable; `fit_statistics` comes before the first loss, and is saved with the weights.

    Args:
        spec: of the world.
        config: how it learns and dreams.

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
        self.network = Denoiser(
            channels, (spec.context + 1) * channels, chunk, spec.state_dim, config.network
        )
        look = channels * LOOK * LOOK
        self.heads = nn.ModuleList(
            StateHead(spec.state_dim * spec.context + chunk + look, spec.state_dim)
            for _ in range(config.heads)
        )
        for name, size in (
            ("robot", spec.state_dim),
            ("action", spec.action_dim),
            ("motion", spec.state_dim),
            ("told", spec.action_dim),
        ):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("change", torch.tensor(0.1))

    # What it is told.

    def fit_statistics(self, windows: Windows) -> None:
        """Means and sizes of states, actions, motions and changes, from many windows of real experience."""
        valid, now = windows.valid[:, 0], windows.context - 1
        state = windows.state[:, now]
        motion = (windows.state[:, now + 1] - state)[valid]
        made = np.arange(self.spec.chunk) < windows.steps[:, 0, None]
        sizes = {
            "robot": state,
            "motion": motion,
            "action": windows.actions[:, 0][made],
            "told": windows.told,
        }
        for name, values in sizes.items():
            getattr(self, f"{name}_mean").copy_(torch.from_numpy(values.mean(0)))
            getattr(self, f"{name}_std").copy_(torch.from_numpy(values.std(0)).clamp(min=1e-3))
        frames = windows.frames[valid, now : now + 2].astype(np.float32) / 127.5
        change = float(np.sqrt(np.square(frames[:, 1] - frames[:, 0]).mean()))
        self.change.fill_(max(change, 1e-3))

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        """See the base class."""
        state = {name: x.to(self.change.device) for name, x in context._asdict().items()}
        return state | {"anchor": state["frames"][:, -1]}

    @torch.no_grad()
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        """See the base class."""
        actions = actions.to(self.change.device)
        steps = torch.full(actions.shape[:1], self.spec.chunk, device=actions.device)
        chunk = self._chunk(state, actions, self._made(steps))
        image = self._sample(state, chunk, self._noise(seeds, state["frames"]), self.config.steps)
        frames = _to_bytes(image, len(self.spec.cameras))
        robot, doubt = self._robot(state, chunk)
        following = _following(state, frames, robot, actions)
        # As bytes, what is no number looks like any other picture.
        drawn = torch.isfinite(image).flatten(1).all(1)
        doubt = torch.where(drawn, doubt / self.doubt, torch.inf)
        return Dream(state=following, frames=frames, robot=robot, uncertainty=doubt)

    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss over every valid chunk of the windows; after the first it sees its own dreams.

        Returns:
            The loss, and ``image``, ``state`` and, of the dreamt ones, ``image_dreamt``.
        """
        device = self.change.device
        tensors = {
            key: torch.from_numpy(getattr(windows, key)).to(device)
            for key in ("frames", "anchor", "state", "before", "told", "first", "actions", "steps", "valid")
        }
        length, chunks = self.spec.context, tensors["steps"].shape[1]
        state = {
            "frames": tensors["frames"][:, :length],
            "anchor": tensors["anchor"],
            "robot": tensors["state"][:, :length],
            "actions": tensors["before"],
            "told": tensors["told"],
            "first": tensors["first"],
        }
        images, robots, weights = [], [], []
        for r in range(chunks):
            valid = tensors["valid"][:, r].float()
            made = self._made(tensors["steps"][:, r])
            actions = tensors["actions"][:, r] * made[..., None]
            chunk = self._chunk(state, actions, made)
            wanted = _to_floats(tensors["frames"][:, length + r])
            images.append(self._image_loss(state, chunk, wanted, generator))
            robots.append(self._robot_loss(state, chunk, tensors["state"][:, length + r]))
            weights.append(valid)
            if r + 1 < chunks:
                state = self._dreamt(state, chunk, actions, generator)
        weight = torch.stack(weights)
        total = weight.sum().clamp(min=1)
        image, robot = ((torch.stack(part) * weight).sum() / total for part in (images, robots))
        metrics = {"image": image.item(), "state": robot.item()}
        if chunks > 1:
            later = weight[1:].sum().clamp(min=1)
            metrics["image_dreamt"] = ((torch.stack(images[1:]) * weight[1:]).sum() / later).item()
        return image + self.config.state_weight * robot, metrics

    # How frames are made.

    def _image_loss(self, state: State, chunk: Tensor, wanted: Tensor, generator: torch.Generator) -> Tensor:
        b = len(wanted)
        newest, network = _to_floats(state["frames"][:, -1]), self._network(state, chunk, generator)
        noise = torch.randn(wanted.shape, generator=generator).to(wanted)
        spread = torch.randn(b, generator=generator).to(wanted)
        if self.config.objective == "edm":
            return objectives.edm_loss(network, wanted, noise, (1.2 * spread - 0.4).exp(), SIGMA_FRAME)
        residual = (wanted - newest) / self.change
        if self.config.objective == "flow":
            # Dreams begin at t = 1, so some rows do.
            t = torch.rand(b, generator=generator).mul(1.1).clamp(max=1).to(wanted)
            return objectives.flow_loss(network, residual, noise, t)
        # A model that is to dream in one pass has no use for refining; others spend half on each.
        alone = 0.5 if self.config.steps > 1 else 1.0
        predict = (torch.rand(b, generator=generator) < alone).to(wanted.device)
        return objectives.refiner_loss(network, residual, noise, (spread - 2.0).exp(), predict, 1.0)

    def _sample(self, state: State, chunk: Tensor, noise: Tensor, steps: int) -> Tensor:
        """The frame after the chunk, (B, C, H, W) in [−1, 1]; noise (B, steps, C, H, W)."""
        network = self._network(state, chunk, None)
        if self.config.objective == "edm":
            levels = objectives.edm_levels(steps, 0.002, self.config.sigma_max)
            return objectives.edm_sample(network, noise[:, 0], levels, SIGMA_FRAME).clamp(-1, 1)
        newest = _to_floats(state["frames"][:, -1])
        if self.config.objective == "flow":
            residual = objectives.flow_sample(network, noise[:, 0], steps)
        else:
            levels = np.geomspace(*self.config.refine_levels, max(1, steps - 1))[: steps - 1].tolist()
            residual = objectives.refiner_sample(network, noise[:, : steps - 1], levels, 1.0)
        return (newest + self.change * residual).clamp(-1, 1)

    def _network(self, state: State, chunk: Tensor, generator: torch.Generator | None) -> objectives.Network:
        """The network with all but image and label bound; with a generator, what it is shown is noisy."""
        shown = _to_floats(torch.cat([state["frames"], state["anchor"][:, None]], 1).flatten(1, 2))
        if generator is not None and self.config.context_noise:
            level = self.config.context_noise * torch.rand(len(shown), 1, 1, 1, generator=generator)
            shown = shown + (level * torch.randn(shown.shape, generator=generator)).to(shown)
        robot = None
        if self.spec.state_dim:
            robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        return lambda x, label: self.network(x, label, shown, chunk, robot)[0]

    def _dreamt(self, state: State, chunk: Tensor, actions: Tensor, generator: torch.Generator) -> State:
        """Where the model itself believes to be after a chunk, for the next one to be learnt from there."""
        with torch.no_grad():
            b, side = len(chunk), state["frames"].shape[3:5]
            noise = torch.randn(b, 1, 3 * len(self.spec.cameras), *side, generator=generator).to(chunk)
            frames = _to_bytes(self._sample(state, chunk, noise, 1), len(self.spec.cameras))
            robot, _ = self._robot(state, chunk)
        return _following(state, frames, robot, actions)

    def _noise(self, seeds: Sequence[int], frames: Tensor) -> Tensor:
        """(B, steps, C, H, W), each row from its own seed."""
        size = (self.config.steps, 3 * len(self.spec.cameras), *frames.shape[3:5])
        if self.config.objective == "refiner" and self.config.steps == 1:
            return frames.new_zeros(len(frames), *size, dtype=torch.float32)
        rows = [np.random.default_rng(seed).standard_normal(size, dtype=np.float32) for seed in seeds]
        return torch.from_numpy(np.stack(rows)).to(frames.device)

    # How the robot moves.

    def _robot(self, state: State, chunk: Tensor) -> tuple[Tensor, Tensor]:
        """Where it is after the chunk, (B, S), and how far the heads disagree, (B,)."""
        motions, robot = self._motions(state, chunk), state["robot"][:, -1]
        moved = robot + self.motion_mean + self.motion_std * motions.mean(0)
        return moved, motions.std(0).mean(-1) if self.spec.state_dim else robot.new_full(
            (len(robot),), torch.nan
        )

    def _robot_loss(self, state: State, chunk: Tensor, wanted: Tensor) -> Tensor:
        motion = (wanted - state["robot"][:, -1] - self.motion_mean) / self.motion_std
        motions = self._motions(state, chunk)
        if not self.spec.state_dim:
            return motion.new_zeros(len(motion))
        return (motions - motion).square().mean((0, 2))

    def _motions(self, state: State, chunk: Tensor) -> Tensor:
        """(heads, B, S), in units of usual motions."""
        look = functional.adaptive_avg_pool2d(_to_floats(state["frames"][:, -1]), LOOK).flatten(1)
        robot = (state["robot"][:, -1] - self.robot_mean) / self.robot_std
        came = (state["robot"][:, 1:] - state["robot"][:, :-1]) / self.motion_std
        seen = torch.cat([robot, came.flatten(1), chunk, look], 1)
        return torch.stack([head(seen) for head in self.heads])

    def _made(self, steps: Tensor) -> Tensor:
        """bool (B, K), the first so many of a chunk."""
        return torch.arange(self.spec.chunk, device=steps.device) < steps[:, None]

    def _chunk(self, state: State, actions: Tensor, made: Tensor) -> Tensor:
        """(B, K·(A + 1) + (L − 1)·K·A + A + S): normalised actions, which of them are executed, those before,
        and how far the robot was told to go since the beginning and has gone.

        How fast it is moving is in no frame, but in what it was told last; nor is how far it has still to go.
        """
        normal = (actions - self.action_mean) / self.action_std * made[..., None]
        before = (state["actions"] - self.action_mean) / self.action_std
        told = (state["told"] - self.told_mean) / self.told_std
        gone = (state["robot"][:, -1] - state["first"]) / self.robot_std
        return torch.cat([normal.flatten(1), made.float(), before.flatten(1), told, gone], 1)


class StateHead(nn.Module):
    """Where the robot goes; starts at the usual motion."""

    def __init__(self, into: int, state: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(into, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU())
        self.out = nn.Linear(128, state)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, seen: Tensor) -> Tensor:
        """(B, into) to (B, S)."""
        out: Tensor = self.out(self.layers(seen))
        return out


def _following(state: State, frames: Tensor, robot: Tensor, actions: Tensor) -> State:
    """The context rolls on to the newest frame; the anchor stays."""
    newest = {"frames": frames, "robot": robot, "actions": actions}
    rolled = {key: torch.cat([state[key], new[:, None]], 1)[:, 1:] for key, new in newest.items()}
    kept = {key: state[key] for key in ("anchor", "first")}
    return rolled | kept | {"told": state["told"] + actions.sum(1)}


def _to_floats(frames: Tensor) -> Tensor:
    """uint8 (B, V, H, W, 3) to float32 (B, 3·V, H, W) in [−1, 1]."""
    return (frames.float() / 127.5 - 1).movedim(-1, 2).flatten(1, 2)


def _to_bytes(image: Tensor, cameras: int) -> Tensor:
    """The other way, rounded."""
    return ((image + 1) * 127.5).round().clamp(0, 255).byte().unflatten(1, (cameras, 3)).movedim(2, -1)
