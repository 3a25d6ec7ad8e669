# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What a world model is told: its size, its objective, how it learns, and what it takes to pass.

Free of torch, as all configs are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

import draccus

from accerl_lerobot.errors import InputError
from accerl_lerobot.safety import check_remote_code

Objective = Literal["refiner", "edm", "flow"]
PIXELS = "pixels"
"""The type of our own class of world models that learn."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """How large it is."""

    space_to_depth: int = 4
    """Side of the pixel blocks that become channels; image height and width are multiples of it times 2 for
    every further level."""
    channels: tuple[int, ...] = (64, 96)
    """Of each level, finest first."""
    blocks: int = 1
    """Residual blocks per level, at least 1."""
    condition: int = 128
    """Width of what the adaptive norms read."""
    planes: int = 8
    """Channels of the action planes; 0: none."""

    def __post_init__(self) -> None:
        for name in ("space_to_depth", "blocks", "condition"):
            if getattr(self, name) < 1:
                raise InputError(f"world_model.model.network.{name}", getattr(self, name), "use at least 1")
        if not self.channels or min(self.channels) < 1:
            raise InputError("world_model.model.network.channels", self.channels, "name a level's width")
        if self.planes < 0:
            raise InputError("world_model.model.network.planes", self.planes, "use 0 (none) or more")

    @property
    def multiple(self) -> int:
        """What image sides must be a multiple of."""
        return self.space_to_depth * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True, kw_only=True)
class LearnableModelConfig(draccus.ChoiceRegistry):
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

    context: int = 2
    """Frames it sees, the newest included, a chunk apart."""

    def __post_init__(self) -> None:
        if self.context < 1:
            raise InputError("world_model.model.context", self.context, "use at least 1")

    @property
    def type(self) -> str:
        """The registered name."""
        return str(self.get_choice_name(self.__class__))

    @property
    def multiple(self) -> int:
        """What image sides must be a multiple of."""
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
    steps: int = 1
    """Network passes per chunk, at least 1. One pass of the refiner is regression."""
    context_noise: float = 0.02
    """Largest standard deviation of the noise on context and anchor in training, in units of [−1, 1]; ≥ 0.
    What it dreams is never as clean as what it learns from."""
    refine_levels: tuple[float, float] = (0.2, 0.05)
    """Noise of the first and last refinement, in usual changes; those between are spaced evenly in log."""
    sigma_max: float = 5.0
    """Noise an edm dream starts from."""
    heads: int = 3
    """Of the robot's state, at least 2, or they cannot disagree."""
    state_weight: float = 1.0
    """Of the state's loss beside the image's."""
    network: NetworkConfig = field(default_factory=NetworkConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.objective not in get_args(Objective):
            raise InputError(
                "world_model.model.objective", self.objective, f"use {' or '.join(get_args(Objective))}"
            )
        for name, least in (("steps", 1), ("heads", 2), ("state_weight", 0)):
            if getattr(self, name) < least:
                raise InputError(f"world_model.model.{name}", getattr(self, name), f"use at least {least}")
        if not self.context_noise >= 0:
            raise InputError("world_model.model.context_noise", self.context_noise, "use 0 (none) or more")
        if not self.refine_levels[0] >= self.refine_levels[1] > 0:
            raise InputError(
                "world_model.model.refine_levels", self.refine_levels, "use two falling numbers > 0"
            )
        if not self.sigma_max > 0.002:
            raise InputError(
                "world_model.model.sigma_max", self.sigma_max, "use more than 0.002, where it ends"
            )

    @property
    def multiple(self) -> int:
        """See the base class."""
        return self.network.multiple

    def provides(self, state_dim: int) -> frozenset[str]:
        """See the base class. Where no heads of a state can disagree, it has no doubts."""
        return super().provides(state_dim) | ({"uncertainty"} if state_dim else set())


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """How a world model is trained."""

    steps: int = 1500
    """Gradient steps of the pre-training, at least 1."""
    batch: int = 16
    """Windows in each, at least 2."""
    lr: float = 1e-3
    """Peak; falls to a tenth by a cosine."""
    warmup: int = 50
    """Steps in which it rises."""
    weight_decay: float = 1e-2
    grad_clip: float = 1.0
    """Largest gradient norm; > 0."""
    average: float = 0.99
    """[0, 1): how slowly the weights that serve follow those that are trained."""
    chunks: int = 2
    """Length of a window. From its second chunk on, the model learns from its own dream."""
    anchors: int = 15
    """The anchor lies up to so many chunks back, as far as dreams will go."""
    validate_every: int = 250
    """Gradient steps of the pre-training until the loss on held-out windows is taken again; 0: never. What is
    learnt is the same with it and without it."""

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("batch", 2), ("chunks", 1)):
            if getattr(self, name) < least:
                raise InputError(f"world_model.learn.{name}", getattr(self, name), f"use at least {least}")
        for name in ("warmup", "weight_decay", "anchors", "validate_every"):
            if not getattr(self, name) >= 0:
                raise InputError(f"world_model.learn.{name}", getattr(self, name), "use 0 or more")
        if not 0 < self.lr < 1:
            raise InputError("world_model.learn.lr", self.lr, "use a value in (0, 1), e.g. 1e-3")
        if not self.grad_clip > 0:
            raise InputError("world_model.learn.grad_clip", self.grad_clip, "use a positive norm")
        if not 0 <= self.average < 1:
            raise InputError("world_model.learn.average", self.average, "use a value in [0, 1)")

    def lr_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0; beyond `steps` it stays at its end."""
        if step < self.warmup:
            return self.lr * (step + 1) / self.warmup
        done = min(1.0, (step - self.warmup) / max(1, self.steps - self.warmup))
        return self.lr * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * done)))


@dataclass(frozen=True, kw_only=True)
class SuccessLearnConfig:
    """How it is trained."""

    steps: int = 400
    """Gradient steps, at least 1."""
    batch: int = 32
    """Pairs of frames in each, at least 2."""
    lr: float = 1e-3
    weight_decay: float = 1e-2
    dreamt: float = 0.5
    """Share of pairs, in [0, 1], that are dreamt: real episodes, with the actions that were made in them."""
    depth: int = 15
    """Chunks of such a dream at most."""
    episodes: int = 48
    """Episodes that are dreamt at a time,"""
    every: int = 50
    """and gradient steps until others are."""
    validate_every: int = 50
    """Gradient steps of the pre-training until it is tried on held-out pairs again; 0: never."""

    def __post_init__(self) -> None:
        for name, least in (
            ("steps", 1), ("batch", 2), ("weight_decay", 0), ("depth", 1), ("episodes", 2), ("every", 1),
            ("validate_every", 0),
        ):  # fmt: skip
            if not getattr(self, name) >= least:
                raise InputError(f"world_model.success.{name}", getattr(self, name), f"use at least {least}")
        if not 0 < self.lr < 1:
            raise InputError("world_model.success.lr", self.lr, "use a value in (0, 1), e.g. 1e-3")
        if not 0 <= self.dreamt <= 1:
            raise InputError("world_model.success.dreamt", self.dreamt, "use a share in [0, 1]")


@dataclass(frozen=True, kw_only=True)
class TrialConfig:
    """What is tried, and what it takes to pass."""

    depth: int = 6
    """Chunks dreamt, the horizon it is judged for."""
    every: int = 10
    """A trial begins every so many env steps of an episode."""
    most: int = 400
    """Trials at most, drawn at random."""
    whole: bool = True
    """Outcomes are tried on episodes dreamt to their ends, from the beginning and from one later place each;
    false: on dreams of `depth` chunks that begin anywhere."""
    skill_first: float = 0.3
    """Least skill on changed pixels after one chunk,"""
    skill_last: float = 0.0
    """and at the horizon, more than this; there on all pixels too, or what should not move does."""
    sensitivity: float = 1.2
    """What the lower end of the sensitivity's interval after one chunk must exceed."""
    auroc: float = 0.9
    """What the lower end of the interval of the AUROC of dreams' outcomes must exceed."""
    false_success: float = 0.25
    """Largest share of dreams that may be taken for a success although they cannot be one: with the true
    actions of episodes that failed, and with none."""
    false_positives: float = 0.1
    """[0, 1). The success model's threshold lets no larger share of failures be taken for a success in a
    dream: failures that were held out, or in a run all of the policy's newest. Of all that do not, it is the
    one that tells most successes from failures."""
    recall: float = 0.3
    """What the share of successes must exceed that are dreamt, and taken, for such."""

    def __post_init__(self) -> None:
        for name in ("depth", "every", "most"):
            if getattr(self, name) < 1:
                raise InputError(f"world_model.trial.{name}", getattr(self, name), "use at least 1")
        if not 0 <= self.false_positives < 1:
            remedy = "use a share in [0, 1), e.g. 0.02"
            raise InputError("world_model.trial.false_positives", self.false_positives, remedy)


@dataclass(frozen=True, kw_only=True)
class InverseConfig:
    """How the probe is learnt that reads actions off frames, see `inverse.py`."""

    steps: int = 400
    """Gradient steps; 0: there is no probe."""
    batch: int = 64
    """Pairs of frames in each, at least 2."""
    lr: float = 2e-3
    """Falls to 0 by a cosine."""
    episodes: int = 40
    """Episodes that it learns from at most, at least 1: such as the world model has learnt from, or, of a
    dataset that it does not know, half of all. On those it is not read."""

    def __post_init__(self) -> None:
        for name, least in (("steps", 0), ("batch", 2), ("episodes", 1)):
            if getattr(self, name) < least:
                raise InputError(f"inverse.{name}", getattr(self, name), f"use at least {least}")
        if not 0 < self.lr < 1:
            raise InputError("inverse.lr", self.lr, "use a value in (0, 1), e.g. 2e-3")


@dataclass(frozen=True, kw_only=True)
class PerturbedConfig:
    """Episodes that are played again with other actions, see `perturbed.py`."""

    episodes: int = 0
    """How many of the dataset's that are tried, at most; 0: none."""
    noise: float = 0.4
    """Standard deviation of what is added to each action, in halves of its range; > 0."""
    hold: int = 10
    """Env steps for which it stays the same, at least 1."""

    def __post_init__(self) -> None:
        for name, least in (("episodes", 0), ("hold", 1)):
            if getattr(self, name) < least:
                raise InputError(f"perturbed.{name}", getattr(self, name), f"use at least {least}")
        if not self.noise > 0:
            raise InputError("perturbed.noise", self.noise, "use a positive number, e.g. 0.4")


@dataclass(frozen=True, kw_only=True)
class StandInConfig:
    """A reward model of LeRobot that tells successes, see `stand_in.py`."""

    path: str | None = None
    """A folder, or an id on the Hub. None: the success model beside the world model."""
    revision: str | None = None
    """Hub revision."""
    trust_remote_code: bool = False
    """Whether Python code from a Hub repository that the model names, such as the backbone's of LeRobot's
    classifier, is run with your rights. It needs `code_revision`."""
    code_revision: str | None = None
    """Commit of that repository, 40 hexadecimal digits: the one whose code you have read. No other is run."""
    threshold: float | None = None
    """P above which a frame counts as a success, in [0, 1]. None: ``accerl world-model-eval`` sets it on the
    episodes, a run refuses."""
    discover_packages_path: str | None = None
    """Package to import that registers the model's type with LeRobot, where that is not LeRobot's own."""

    def __post_init__(self) -> None:
        check_remote_code(self.trust_remote_code, self.code_revision, "success")
        if self.threshold is not None and not 0 <= self.threshold <= 1:
            raise InputError("success.threshold", self.threshold, "use a value in [0, 1]")
        if self.path is None and self.threshold is not None:
            remedy = "it is of the model in success.path; the one beside the world model has its own"
            raise InputError("success.threshold", self.threshold, remedy)


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig(draccus.ChoiceRegistry):
    """A world model with its success model; `sizes.py` has those that can be named."""

    model: LearnableModelConfig = field(default_factory=PixelModelConfig)
    discover_packages_path: str | None = field(default=None, metadata={"registers": True})
    """Package to import that registers the type of `model`, where that is not one of ours."""
    learn: LearnConfig = field(default_factory=LearnConfig)
    success: SuccessLearnConfig = field(default_factory=SuccessLearnConfig)
    trial: TrialConfig = field(default_factory=TrialConfig)
    held_out: float = 0.2
    """Share of the episodes, in (0, 1), that it is judged on and does not learn from."""
    image_size: int = 64
    """Height and width in pixels of the frames it dreams."""
    chunk: int = 10
    """Env steps it goes at a time: the actions a policy executes per decision."""
    shuffle_actions: bool = False
    """Learn with the actions of other windows: a placebo, which must fail the trial."""

    @property
    def type(self) -> str:
        """The registered name."""
        return str(self.get_choice_name(self.__class__))

    def __post_init__(self) -> None:
        if not 0 < self.held_out < 1:
            raise InputError("world_model.held_out", self.held_out, "use a share in (0, 1), e.g. 0.2")
        if self.chunk < 1:
            raise InputError("world_model.chunk", self.chunk, "use at least 1")
        multiple = math.lcm(2, self.model.multiple)  # the success model halves it first
        if self.image_size < multiple or self.image_size % multiple:
            remedy = f"use a multiple of {multiple}, or change world_model.model"
            raise InputError("world_model.image_size", self.image_size, remedy)
