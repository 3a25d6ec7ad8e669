# SPDX-License-Identifier: Apache-2.0
"""Configuration of experience that is imagined while a policy learns. Free of torch, as all configs are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from accerl_lerobot.config.dataset import DatasetConfig
from accerl_lerobot.config.ranges import Choice, LearningRate, Positive, Range, Section, Share, Steps
from accerl_lerobot.errors import InputError
from accerl_lerobot.replay.pacing import ReplayConfig
from accerl_lerobot.world_model.config import StandInConfig, TrialConfig
from accerl_lerobot.world_model.kinds import KINDS, ModelKind

Reward = Literal["potential", "success"]
FILMS = "dreams"
"""Folder of a run with `OnlineLearnConfig.films`."""


@dataclass(frozen=True, kw_only=True)
class OnlineLearnConfig(Section, section="imagination.learn"):
    """How a world model goes on learning from what the policy lives through."""

    steps_per_episode: Annotated[float, Range("[0, 1000000]")] = 5.0
    """Gradient steps of world and success model each, per real episode; 0: it stays as it is.

    What only ever saw demonstrations takes a policy's failures for successes: on door-open, 39 % of them at a
    depth of four decisions, and 2 % after 100 steps on 64 episodes of that policy. So nothing is imagined
    before it has passed a trial on the policy's own episodes.
    """
    batch: Annotated[int, Range("[2, 65536]")] = 16
    """Windows in each."""
    lr: LearningRate = 3e-4
    """Constant after the first 50 steps."""
    offline: Share = 0.5
    """Share of windows from what it was pre-trained on, where `dataset` and `online` name it."""
    recent: Share = 0.7
    """Share of the others from the newest quarter of episodes."""
    failures: Share = 0.6
    """Share of those from episodes that failed, as long as there are both kinds."""
    held_out: Annotated[float, Range("(0, 1)")] = 0.2
    """Share of real episodes that it does not learn from and is tried on."""
    try_every: Annotated[int, Range("[1, 1000000]")] = 16
    """Real episodes between two trials of what it has become. Where real episodes are counted, no
    more are collected before the trial is over. Once all are in, it is tried again after as many steps as so
    many would have brought, `last_tries` times at most."""
    last_tries: Annotated[int, Range("[1, 1000000]")] = 5
    """Trials after the last real episode; after them, what has not passed never dreams."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Dataset of its pre-training: of it, it learns from the episodes that it knows, and is tried on those
    that were held out. Another dataset is learnt from whole."""
    online: DatasetConfig = field(default_factory=DatasetConfig)
    """Episodes of an earlier policy that it was pre-trained on, in the same way."""
    trial: TrialConfig = field(
        default_factory=lambda: TrialConfig(
            most=120, depth=4, auroc=0.6, false_success=0.5, recall=0.3, false_positives=0.3
        )
    )
    """Gates that it must pass to serve. Outcomes are tried on what `ImaginationConfig.horizon` says is
    dreamt. A dozen held-out episodes tell little; beyond that, `gap` watches."""
    memory: Annotated[int, Range("[2, 1000000]")] = 400
    """Real episodes kept to learn from."""
    films: Annotated[int, Range("[0, 1000000]")] = 1
    """A video after every so many trials, in the run's folder ``dreams``: the newest held-out episode beside
    what is dreamt of it with the same actions. 0: none."""


@dataclass(frozen=True, kw_only=True)
class ImaginationConfig(Section, section="imagination"):
    """Settings of the policy's learning from dreams."""

    share: Annotated[float, Range("[0, 1)")] = 0.0
    """Share of the decisions of a batch that are imagined; 0: none."""
    model: Annotated[str, Choice(KINDS)] = field(default="learned", metadata={"choices": KINDS})
    """World model of the dreams. shuffled and copy are placebos: what helps as much as they do is not the
    world model."""
    path: str | None = None
    """The folder ``world_model`` that ``accerl world-model`` has written; oracle needs none, copy one for its
    success model."""
    discover_packages_path: str | None = None
    """Package to import that registers the type of the world model in `path`, where that is not one of ours;
    every machine of the cluster needs it."""
    success: StandInConfig = field(default_factory=StandInConfig)
    """A reward model that tells successes in place of the one in `path`; it stays as it is, and so does the
    world model."""
    threshold: Share | None = None
    """P above which a frame of a dream counts as a success; an oracle knows. None: what was saved
    with the success model of `path`, and is set anew as that goes on learning.

    That one is set on dreams with the actions that were made. A policy that looks at its dreams is flattered
    more: ``python -m benchmarks ranking`` says at which one it succeeds as often in dreams as in reality.
    Trials are judged by it, too, so a strict one needs a lower `learn.trial.recall`.
    """
    calibrate: Steps = 0
    """First dreams, from beginnings of real episodes to their ends, that nothing is learnt from: the
    threshold is set, anew for each world model, so that as many of them succeed as of these episodes. 0:
    none, which did better on door-open where the world model had learnt long enough. An oracle needs none.

    It waits until `witnesses` episodes have ended, and as many more as are played at a time, or all there
    will be; where all end alike it leaves the threshold as it was. It asks for `horizon` None and a `memory`
    that holds these episodes. Each of several workers does it for itself.
    """
    workers: Annotated[int, Range("[1, 1000]")] = 1
    """Processes that dream, each with a copy of the world model, its own draws, and its part of `dreams`;
    they are dealt out over inference services as rollout workers are, from the last one on."""
    dreams: Annotated[int, Range("[1, 100000]")] = 32
    """Dreams at a time, of all workers; those of each are decided and dreamt as one batch."""
    horizon: Annotated[int, Range("[1, 100000]")] | None = None
    """None: dreams last until a success or the world's time limit. A number: they last so many decisions at
    most, and V of the last observation stands for the rest. Either way they end before what is too uncertain.

    Dreams to the end ask more of the world model and nothing of the critic. On door-open short ones of 4
    decisions taught a policy nothing, not even in a simulator.
    """
    beginnings: Share = 0.0
    """Share of dreams that begin where an episode began; others may, too. The later one begins,
    the less of it is dreamt, and the truer is how it ends."""
    keyframes: Share = 0.5
    """Share of the others that begin where the critic was surprised; the rest begin anywhere."""
    reward: Reward = "success"
    """success: 1 where P(success) exceeds the success model's threshold, which is what the world pays.
    potential: P(success) now less P(success) before, the start's own included, as AcceRL has it. Its sum is
    what a dream ended with less what it began with, while V, which stands for what follows the horizon, is
    also learnt from rewards of the world: a near miss may be worth more than a success. Either way a success
    ends the dream, and decisions cost what they always do."""
    doubt: Positive = 2.0
    """A dream ends before what the model is more uncertain about, where 1 is the 95th percentile. When
    `window` dreams in a row end so at once, nothing is imagined any more."""
    memory: Annotated[int, Range("[1, 10000000]")] = 4096
    """Newest real decisions that dreams begin at."""
    record: Annotated[int, Range("[0, 1000000]")] = 0
    """Newest dreams kept on disk, in the run's folder ``imagined``, of which
    ``accerl export --source=imagined`` makes a LeRobotDataset; 0: none. Each holds its pictures as they are:
    0.2 MB for 15 decisions seen by one camera of 64×64. Of several workers the first one's are kept."""
    gap: Positive = 0.5
    """Nothing is imagined any more once dreams succeed so much more often, of 1, than reality does.
    Dreams of episodes from beginning to end are held against real episodes of the same time; where
    `beginnings` is 0, dreams are held against the episodes they begin in, and may be ahead by what the policy
    has learnt since. A world model that was promoted since gets another chance. With `beginnings`, nothing is
    compared any more once all real episodes have been played."""
    window: Annotated[int, Range("[1, 1000000]")] = 100
    """Imagined episodes over which the gap is measured."""
    witnesses: Annotated[int, Range("[1, 1000000]")] = 16
    """With `beginnings`: real episodes required before the gap is evaluated."""
    replay: ReplayConfig = field(
        default_factory=lambda: ReplayConfig(
            capacity=2048, min_decisions=1, samples_per_insert=4.0, ahead=512
        )
    )
    """Size and pace of what is imagined; its `max_lag` is the lag of the policy that dreamt."""
    learn: OnlineLearnConfig = field(default_factory=OnlineLearnConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.calibrate and (self.horizon is not None or self.threshold is not None):
            remedy = (
                "leave imagination.horizon and threshold out: whole dreams are held against whole episodes"
            )
            raise InputError("imagination.calibrate", self.calibrate, remedy)
        if self.workers > self.dreams:
            remedy = f"use at most imagination.dreams, {self.dreams}: each worker needs one"
            raise InputError("imagination.workers", self.workers, remedy)
        if self.dreams < (least := self.kind.rows * self.workers):
            remedy = f"use at least {least}, or fewer imagination.workers"
            raise InputError(
                "imagination.dreams", self.dreams, f"{remedy}: {self.model} needs {self.kind.rows} in each"
            )
        if self.share and self.path is None and self.kind.folder:
            remedy = "give the folder world_model that accerl world-model has written"
            raise InputError("imagination.path", None, remedy)
        if self.threshold is not None and self.success.path is not None:
            remedy = "with a model that stands in, say it in imagination.success.threshold alone"
            raise InputError("imagination.threshold", self.threshold, remedy)
        if self.share and self.success.path is not None:
            if self.success.threshold is None:
                remedy = "say what counts as a success; accerl world-model-eval --success.path=… finds it"
                raise InputError("imagination.success.threshold", None, remedy)
            if self.kind.judges:
                remedy = f"leave it out: the {self.model} knows what has succeeded"
                raise InputError("imagination.success.path", self.success.path, remedy)
            if self.learns:
                remedy = "use 0 with imagination.success.path: a model that stands in does not learn"
                raise InputError("imagination.learn.steps_per_episode", self.learn.steps_per_episode, remedy)

    @property
    def kind(self) -> ModelKind:
        """Properties of `model`."""
        return KINDS[self.model]

    @property
    def learns(self) -> bool:
        """True if the world model goes on learning."""
        return self.share > 0 and self.kind.learns and self.learn.steps_per_episode > 0
