# SPDX-License-Identifier: Apache-2.0
"""Settings of a world model: its size, its objective, how it learns, and the gates that it must pass.

Free of torch, as all configs are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import draccus

from accerl_lerobot.checkpoint.safety import check_remote_code
from accerl_lerobot.config.ranges import LearningRate, NonNegative, Positive, Range, Section, Share, Steps
from accerl_lerobot.errors import InputError

Objective = Literal["refiner", "edm", "flow"]
PIXELS = "pixels"
"""The type of our own class of world models that learn."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(Section, section="world_model.model.network"):
    """How large it is."""

    space_to_depth: Annotated[int, Range("[1, 64]")] = 4
    """Side of the pixel blocks that become channels; image height and width are multiples of it times 2 for
    every further level."""
    channels: tuple[Annotated[int, Range("[1, 65536]")], ...] = (64, 96)
    """Channels of each level, finest first."""
    blocks: Annotated[int, Range("[1, 1000]")] = 1
    """Residual blocks per level."""
    condition: Annotated[int, Range("[1, 65536]")] = 128
    """Width of what the adaptive norms read."""
    planes: Annotated[int, Range("[0, 65536]")] = 8
    """Channels of the action planes; 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.channels:
            raise InputError("world_model.model.network.channels", self.channels, "name at least one width")

    @property
    def multiple(self) -> int:
        """Number that image sides must be a multiple of."""
        return self.space_to_depth * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True, kw_only=True)
class LearnableModelConfig(Section, draccus.ChoiceRegistry, section="world_model.model"):
    """A class of world models that learn; each is a `contract.LearnableWorldModel` and a config like this.

    Example:
        >>> @LearnableModelConfig.register_subclass("mine")
        ... @dataclass(frozen=True, kw_only=True)
        ... class MyModelConfig(LearnableModelConfig):
        ...     make = "my_package.model:MyWorldModel"
        ...     width: int = 64
    """

    make: ClassVar[str]
    """``module:name`` of the class, which is made of a `contract.WorldModelSpec` and this config."""

    context: Annotated[int, Range("[1, 1000]")] = 2
    """Frames it sees, the newest included, a chunk apart."""

    @property
    def type(self) -> str:
        """The registered name."""
        return str(self.get_choice_name(self.__class__))

    @property
    def multiple(self) -> int:
        """Number that image sides must be a multiple of."""
        return 1

    def provides(self, state_dim: int) -> frozenset[str]:
        """See `contract.WorldModelSpec`, of a world whose robot's state has so many dims, maybe 0."""
        return frozenset({"pixels", "state"} if state_dim else {"pixels"})


@LearnableModelConfig.register_subclass(PIXELS)
@dataclass(frozen=True, kw_only=True)
class PixelModelConfig(LearnableModelConfig):
    """How it learns and dreams."""

    make = "accerl_lerobot.world_model.pixels:PixelWorldModel"

    objective: Objective = "refiner"
    """refiner: predict the change, then refine it. edm: denoise the frame, as DIAMOND does. flow: rectified
    flow of the change."""
    steps: Annotated[int, Range("[1, 10000]")] = 1
    """Network passes per chunk. One pass of the refiner is regression."""
    context_noise: NonNegative = 0.02
    """Largest standard deviation of the noise on context and anchor in training, in units of [−1, 1].
    What it dreams is never as clean as what it learns from."""
    refine_levels: tuple[Positive, Positive] = (0.2, 0.05)
    """Noise of the first and last refinement, in usual changes; those between are spaced evenly in log."""
    sigma_max: Annotated[float, Range("(0.002, inf)")] = 5.0
    """Noise an edm dream starts from."""
    heads: Annotated[int, Range("[2, 1000]")] = 3
    """Predictions of the robot's state, several so that they can disagree."""
    state_weight: NonNegative = 1.0
    """Weight of the state's loss beside the image's."""
    network: NetworkConfig = field(default_factory=NetworkConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.refine_levels[0] < self.refine_levels[1]:
            raise InputError(
                "world_model.model.refine_levels", self.refine_levels, "use two falling numbers > 0"
            )

    @property
    def multiple(self) -> int:
        """See the base class."""
        return self.network.multiple

    def provides(self, state_dim: int) -> frozenset[str]:
        """See the base class. Where no heads of a state can disagree, it has no doubts."""
        return super().provides(state_dim) | ({"uncertainty"} if state_dim else set())


@dataclass(frozen=True, kw_only=True)
class LearnConfig(Section, section="world_model.learn"):
    """How a world model is trained."""

    steps: Annotated[int, Range("[1, 1000000000]")] = 1500
    """Gradient steps of the pre-training."""
    batch: Annotated[int, Range("[2, 65536]")] = 16
    """Windows in each."""
    lr: LearningRate = 1e-3
    """Peak; falls to a tenth by a cosine."""
    warmup: Steps = 50
    """Steps in which it rises."""
    weight_decay: NonNegative = 1e-2
    grad_clip: Positive = 1.0
    """Largest gradient norm."""
    average: Annotated[float, Range("[0, 1)")] = 0.99
    """How slowly the weights that serve follow those that are trained."""
    chunks: Annotated[int, Range("[1, 10000]")] = 2
    """Length of a window. From its second chunk on, the model learns from its own dream."""
    anchors: Annotated[int, Range("[0, 10000]")] = 15
    """The anchor lies up to so many chunks back, as far as dreams will go."""
    validate_every: Steps = 250
    """Gradient steps of the pre-training until the loss on held-out windows is taken again; 0: never. What is
    learnt is the same with it and without it."""

    def lr_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0; beyond `steps` it stays at its end."""
        if step < self.warmup:
            return self.lr * (step + 1) / self.warmup
        done = min(1.0, (step - self.warmup) / max(1, self.steps - self.warmup))
        return self.lr * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))


@dataclass(frozen=True, kw_only=True)
class SuccessLearnConfig(Section, section="world_model.success"):
    """How it is trained."""

    steps: Annotated[int, Range("[1, 1000000000]")] = 400
    """Gradient steps."""
    batch: Annotated[int, Range("[2, 65536]")] = 32
    """Pairs of frames in each."""
    lr: LearningRate = 1e-3
    weight_decay: NonNegative = 1e-2
    dreamt: Share = 0.5
    """Share of pairs that are dreamt: real episodes, with the actions that were made in them."""
    depth: Annotated[int, Range("[1, 100000]")] = 15
    """Chunks of such a dream at most."""
    episodes: Annotated[int, Range("[2, 1000000]")] = 48
    """Episodes that are dreamt at a time,"""
    every: Annotated[int, Range("[1, 1000000]")] = 50
    """and gradient steps until others are."""
    validate_every: Steps = 50
    """Gradient steps of the pre-training until it is tried on held-out pairs again; 0: never."""


@dataclass(frozen=True, kw_only=True)
class TrialConfig(Section, section="world_model.trial"):
    """Gates of a trial, and its data."""

    depth: Annotated[int, Range("[1, 100000]")] = 6
    """Chunks dreamt, the horizon it is judged for."""
    every: Annotated[int, Range("[1, 1000000]")] = 10
    """A trial begins every so many env steps of an episode."""
    most: Annotated[int, Range("[1, 1000000]")] = 400
    """Trials at most, drawn at random."""
    whole: bool = True
    """Outcomes are tried on episodes dreamt to their ends, from the beginning and from one later place each;
    false: on dreams of `depth` chunks that begin anywhere."""
    skill_first: float = 0.3
    """Least skill on changed pixels after one chunk,"""
    skill_last: float = 0.0
    """and at the horizon, more than this; there on all pixels too, or what should not move does."""
    sensitivity: float = 1.2
    """Value that the lower end of the sensitivity's interval after one chunk must exceed."""
    auroc: float = 0.9
    """Value that the lower end of the interval of the AUROC of dreams' outcomes must exceed."""
    false_success: float = 0.25
    """Largest share of dreams that may be taken for a success although they cannot be one: with the true
    actions of episodes that failed, and with none."""
    false_positives: Annotated[float, Range("[0, 1)")] = 0.1
    """The success model's threshold lets no larger share of failures be taken for a success in a
    dream: failures that were held out, or in a run all of the policy's newest. Of all that do not, it is the
    one that tells most successes from failures."""
    recall: float = 0.3
    """Value that the share of successes that are dreamt, and taken, for such must exceed."""


@dataclass(frozen=True, kw_only=True)
class StandInConfig(Section, section="success"):
    """A reward model of LeRobot that tells successes, see `stand_in.py`."""

    path: str | None = None
    """A folder, or an id on the Hub. None: the success model beside the world model."""
    revision: str | None = None
    """Hub revision."""
    trust_remote_code: bool = False
    """True if Python code from a Hub repository that the model names, such as the backbone's of LeRobot's
    classifier, is run with your rights. It needs `code_revision`."""
    code_revision: str | None = None
    """Commit of that repository, 40 hexadecimal digits: the one whose code you have read. No other is run."""
    threshold: Share | None = None
    """P above which a frame counts as a success. None: ``accerl world-model-eval`` sets it on the
    episodes, a run refuses."""
    discover_packages_path: str | None = None
    """Package to import that registers the model's type with LeRobot, where that is not LeRobot's own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_remote_code(self.trust_remote_code, self.code_revision, "success")
        if self.path is None and self.threshold is not None:
            remedy = "it is of the model in success.path; the one beside the world model has its own"
            raise InputError("success.threshold", self.threshold, remedy)


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig(Section, draccus.ChoiceRegistry, section="world_model"):
    """A world model with its success model; `sizes.py` has those that can be named."""

    model: LearnableModelConfig = field(default_factory=PixelModelConfig)
    discover_packages_path: str | None = field(default=None, metadata={"registers": True})
    """Package to import that registers the type of `model`, where that is not one of ours."""
    learn: LearnConfig = field(default_factory=LearnConfig)
    success: SuccessLearnConfig = field(default_factory=SuccessLearnConfig)
    trial: TrialConfig = field(default_factory=TrialConfig)
    held_out: Annotated[float, Range("(0, 1)")] = 0.2
    """Share of the episodes that it is judged on and does not learn from."""
    image_size: Annotated[int, Range("[2, 1024]")] = 64
    """Height and width in pixels of the frames it dreams."""
    chunk: Annotated[int, Range("[1, 10000]")] = 10
    """Env steps it goes at a time: the actions a policy executes per decision."""
    shuffle_actions: bool = False
    """Learn with the actions of other windows: a placebo, which must fail the trial."""

    @property
    def type(self) -> str:
        """The registered name."""
        return str(self.get_choice_name(self.__class__))

    def __post_init__(self) -> None:
        super().__post_init__()
        multiple = math.lcm(2, self.model.multiple)  # the success model halves it first
        if self.image_size < multiple or self.image_size % multiple:
            remedy = f"use a multiple of {multiple}, or change world_model.model"
            raise InputError("world_model.image_size", self.image_size, remedy)
