# SPDX-License-Identifier: Apache-2.0
"""Options of world models: network, training, and imagination in a run. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import draccus

from accerl_lerobot.config.ranges import DatasetConfig, LearningRate, Range, Section, registered_name
from accerl_lerobot.errors import InputError

WORLD_LEARNING = "world-model learning"  # name of the worker that trains the pixel world model


@dataclass(frozen=True, kw_only=True)
class StateModelConfig(Section, draccus.ChoiceRegistry, section="world_model"):
    """Base config of a type of world model that critic and teacher stand on, which is a `states.StateModel`.

    Example:
        >>> @StateModelConfig.register_subclass("mine")
        ... @dataclass(frozen=True, kw_only=True)
        ... class MyModelConfig(StateModelConfig):
        ...     make = "my_package.model:MyStateModel"
    """

    make: ClassVar[str]
    """``module:name`` of the class, which is built from a `states.StateSpec` and this config."""

    discover_packages_path: str | None = None
    """Package to import that registers ``world_model.type``, where that is not one of ours."""

    type = registered_name


@StateModelConfig.register_subclass("simulator")
@dataclass(frozen=True, kw_only=True)
class SimulatorStateConfig(StateModelConfig):
    """The simulator's own state, where the environment tells it; nothing is learned."""

    make = "accerl_lerobot.world_model.states:SimulatorState"


@StateModelConfig.register_subclass("latent")
@dataclass(frozen=True, kw_only=True)
class LatentConfig(StateModelConfig):
    """A latent state that is learned from images and proprioception during the run."""

    make = "accerl_lerobot.world_model.latent:LatentModel"

    latents: Annotated[int, Range("[1, 4096]")] = 64
    """Numbers of the latent state."""


@StateModelConfig.register_subclass("tdmpc")
@dataclass(frozen=True, kw_only=True)
class TDMPCStateConfig(StateModelConfig):
    """The latent state of a TD-MPC policy that ``lerobot-train`` has trained on play, failures included."""

    make = "accerl_lerobot.world_model.tdmpc:TDMPCModel"

    path: str | None = None
    """Its LeRobot checkpoint, on disk or the Hub. It sees one image."""
    learn: bool = True
    """False: it stays as it is."""


def default_state_model(tells_state: bool) -> StateModelConfig:
    """The type of a run that names none; `tells_state`: the simulator's state is there to be read."""
    if tells_state:
        return SimulatorStateConfig()
    return LatentConfig()


@dataclass(frozen=True, kw_only=True)
class LearnableModelConfig(Section, draccus.ChoiceRegistry, section="world_model.model"):
    """Base config of a type of pixel world model, which is a `contract.LearnableWorldModel`.

    Example:
        >>> @LearnableModelConfig.register_subclass("mine")
        ... @dataclass(frozen=True, kw_only=True)
        ... class MyModelConfig(LearnableModelConfig):
        ...     make = "my_package.model:MyWorldModel"
        ...     width: int = 64
    """

    make: ClassVar[str]
    """``module:name`` of the class, which is built from a `contract.WorldModelSpec` and this config."""

    type = registered_name


@LearnableModelConfig.register_subclass("pixels")
@dataclass(frozen=True, kw_only=True)
class PixelModelConfig(LearnableModelConfig):
    """Our own world model of images and robot state."""

    make = "accerl_lerobot.world_model.pixels:PixelWorldModel"

    channels: tuple[Annotated[int, Range("[1, 65536]")], ...] = (64, 96)
    """Channels of each level of the network, finest first. Image height and width are multiples of 4, times
    2 for every further level."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.channels:
            raise InputError("world_model.model.channels", self.channels, "name at least one width")


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig(Section, section="world_model"):
    """A pixel world model and its training. The default has 2 million weights and trains on two cores."""

    model: LearnableModelConfig = field(default_factory=PixelModelConfig)
    discover_packages_path: str | None = None
    """Package to import that registers the type of `model`, where that is not one of ours."""
    steps: Annotated[int, Range("[1, 1000000000]")] = 4000
    """Gradient steps of the pre-training."""
    lr: LearningRate = 1e-3
    """Peak learning rate; rises over 50 steps and falls to a tenth by a cosine."""
    image_size: Annotated[int, Range("[2, 1024]")] = 64
    """Height and width in pixels of the predicted frames."""
    chunk: Annotated[int, Range("[1, 10000]")] = 10
    """Env steps per prediction: the actions a policy executes per decision."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.image_size % 2:
            raise InputError("world_model.image_size", self.image_size, "use an even number")


@dataclass(frozen=True, kw_only=True)
class OnlineLearnConfig(Section, section="imagination.learn"):
    """Training of the world model on the policy's episodes during a run."""

    steps_per_episode: Annotated[float, Range("[0, 1000000]")] = 5.0
    """Gradient steps of the world model per real episode; 0: it stays as it is."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Dataset that the model of `imagination.path` was trained on: half of each batch comes from it."""


@dataclass(frozen=True, kw_only=True)
class ImaginationConfig(Section, section="imagination"):
    """Learning from imagined episodes, in environments that a world model predicts."""

    environments: Annotated[int, Range("[0, 1000]")] = 0
    """Imagined environments per rollout process, beside ``rollout.environments`` real ones; 0: none."""
    path: str | None = None
    """The folder ``world_model`` that ``accerl world-model`` has written. None: before training, the run
    records episodes and trains a world model on them."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model in `path`, where that is not one of ours;
    every machine of the cluster needs it."""
    policy_episodes: Annotated[int, Range("[0, 9999]")] = 100
    """Exploring episodes of the policy that are recorded for the pre-training."""
    expert_episodes: Annotated[int, Range("[0, 9999]")] = 100
    """Episodes of the scripted expert, disturbed, that are recorded for the pre-training."""
    steps: Annotated[int, Range("[1, 1000000000]")] = 4000
    """Gradient steps of the pre-training."""
    learn: OnlineLearnConfig = field(default_factory=OnlineLearnConfig)

    @property
    def learns(self) -> bool:
        """True if the world model is trained on during the run."""
        return self.environments > 0 and self.learn.steps_per_episode > 0
