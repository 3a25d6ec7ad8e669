# SPDX-License-Identifier: Apache-2.0
"""Options of world models: network, training, validation, and imagination in a run. Free of torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import draccus

from accerl_lerobot.config.ranges import DatasetConfig, LearningRate, Range, Section, registered_name
from accerl_lerobot.errors import InputError

PIXELS = "pixels"  # the type of our own class of learned world models
SPACE_TO_DEPTH = 4  # side of the pixel blocks that become channels in its network
IMAGINATION = "imagination"  # name of the config section
WORLD_LEARNING = "world-model learning"  # name of the worker that trains the world model


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

    discover_packages_path: str | None = field(default=None, metadata={"registers": True})
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
    return SimulatorStateConfig() if tells_state else LatentConfig()


@dataclass(frozen=True, kw_only=True)
class LearnableModelConfig(Section, draccus.ChoiceRegistry, section="world_model.model"):
    """Base config of a class of learned world models, which is a `contract.LearnableWorldModel`.

    Example:
        >>> @LearnableModelConfig.register_subclass("mine")
        ... @dataclass(frozen=True, kw_only=True)
        ... class MyModelConfig(LearnableModelConfig):
        ...     make = "my_package.model:MyWorldModel"
        ...     width: int = 64
    """

    make: ClassVar[str]
    """``module:name`` of the class, which is built from a `contract.WorldModelSpec` and this config."""

    context: Annotated[int, Range("[1, 1000]")] = 2
    """Frames the model sees, the newest included, a chunk apart."""

    type = registered_name

    @property
    def multiple(self) -> int:
        """Number that image sides must be a multiple of."""
        return 1


@LearnableModelConfig.register_subclass(PIXELS)
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

    @property
    def multiple(self) -> int:
        return SPACE_TO_DEPTH * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True, kw_only=True)
class LearnConfig(Section, section="world_model.learn"):
    """Training of a world model."""

    steps: Annotated[int, Range("[1, 1000000000]")] = 1500
    """Gradient steps of the pre-training."""
    batch: Annotated[int, Range("[2, 65536]")] = 16
    """Windows per gradient step."""
    lr: LearningRate = 1e-3
    """Peak learning rate; rises over 50 steps and falls to a tenth by a cosine."""
    chunks: Annotated[int, Range("[1, 10000]")] = 2
    """Chunks per window. From its second chunk on, the model is trained on its own prediction as input."""


@dataclass(frozen=True, kw_only=True)
class SuccessLearnConfig(Section, section="world_model.success"):
    """Training of the success model."""

    steps: Annotated[int, Range("[1, 1000000000]")] = 400
    """Gradient steps."""
    batch: Annotated[int, Range("[4, 65536]")] = 32
    """Pairs of frames per gradient step."""
    lr: LearningRate = 1e-3


@dataclass(frozen=True, kw_only=True)
class ValidationConfig(Section, section="world_model.validation"):
    """Held-out validation: its data, and the checks that a world model has to pass."""

    depth: Annotated[int, Range("[1, 100000]")] = 6
    """Chunks predicted from each window, the horizon that frames are compared at."""
    stride: Annotated[int, Range("[1, 1000000]")] = 10
    """Env steps between two windows of an episode."""
    max_windows: Annotated[int, Range("[1, 1000000]")] = 400
    """Windows at most, drawn at random."""
    skill: float = 0.3
    """The skill on changed pixels after one chunk must exceed this."""
    sensitivity: float = 1.2
    """The lower end of the sensitivity's interval after one chunk must exceed this."""
    auroc: float = 0.9
    """The lower end of the interval of the AUROC of rollouts' outcomes must exceed this."""
    false_positives: Annotated[float, Range("[0, 1)")] = 0.1
    """Largest share of failures above the success threshold when it is chosen. Of the thresholds that keep
    to it, the one that best separates successes from failures is taken."""


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig(Section, section="world_model"):
    """A world model and its success model. The default has 1.8 million weights and trains on two cores."""

    model: LearnableModelConfig = field(default_factory=PixelModelConfig)
    discover_packages_path: str | None = field(default=None, metadata={"registers": True})
    """Package to import that registers the type of `model`, where that is not one of ours."""
    learn: LearnConfig = field(default_factory=LearnConfig)
    success: SuccessLearnConfig = field(default_factory=SuccessLearnConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    longest: Annotated[int, Range("[1, 10000]")] = 15
    """Chunks of an imagined rollout at most: so far back lies the anchor, and so long are the imagined
    replays of real episodes that half of the pairs of frames come from."""
    held_out: Annotated[float, Range("(0, 1)")] = 0.2
    """Share of the episodes held out for validation."""
    image_size: Annotated[int, Range("[2, 1024]")] = 64
    """Height and width in pixels of the predicted frames."""
    chunk: Annotated[int, Range("[1, 10000]")] = 10
    """Env steps per prediction: the actions a policy executes per decision."""
    shuffle_actions: bool = False
    """Train with the actions of other windows: a placebo, which must fail validation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        multiple = math.lcm(2, self.model.multiple)  # the success model halves it first
        if self.image_size < multiple or self.image_size % multiple:
            hint = f"use a multiple of {multiple}, or change world_model.model"
            raise InputError("world_model.image_size", self.image_size, hint)


@dataclass(frozen=True, kw_only=True)
class OnlineLearnConfig(Section, section="imagination.learn"):
    """Training of the world model on the policy's episodes during a run."""

    steps_per_episode: Annotated[float, Range("[0, 1000000]")] = 5.0
    """Gradient steps of world model and success model each, per real episode; 0: both stay as they are."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Dataset of the pre-training, or both merged: half of each batch is from the episodes that the model was
    trained on."""


@dataclass(frozen=True, kw_only=True)
class ImaginationConfig(Section, section="imagination"):
    """Learning from imagined episodes, in environments that a world model predicts."""

    environments: Annotated[int, Range("[0, 1000]")] = 0
    """Imagined environments per rollout process, beside ``rollout.environments`` real ones; 0: none."""
    path: str | None = None
    """The folder ``world_model`` that ``accerl world-model`` has written."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model in `path`, where that is not one of ours;
    every machine of the cluster needs it."""
    learn: OnlineLearnConfig = field(default_factory=OnlineLearnConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.environments and self.path is None:
            hint = "give the folder world_model that accerl world-model has written"
            raise InputError("imagination.path", None, hint)

    @property
    def learns(self) -> bool:
        """True if the world model is trained on during the run."""
        return self.environments > 0 and self.learn.steps_per_episode > 0
