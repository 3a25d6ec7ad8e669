# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts of a run: what imagines, the learner of its world model, and their two processes.

Imagination consumes decisions, real segments and world models that have passed validation, and produces
imagined segments; it waits for decisions, and while segments are pending at replay. The learner consumes real
segments and produces world models. Both end when replay says that the run is over. Until a model has passed,
batches are real; from then on the trainer waits for imagined segments as it does for real ones.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from accerl_lerobot import errors
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.preflight import policy_to_be
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import EnvironmentSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.loading import load_lerobot_config, resolve_device
from accerl_lerobot.replay.worker import News
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WAIT_OUT, WEIGHT_SYNC, open_clock
from accerl_lerobot.transport.endpoint import Endpoint, ReconnectingClient
from accerl_lerobot.world_model.config import IMAGINATION, WORLD_LEARNING
from accerl_lerobot.world_model.contract import WorldModel, WorldModelSpec
from accerl_lerobot.world_model.data import load_datasets, open_datasets
from accerl_lerobot.world_model.online import OnlineLearner, Promotion
from accerl_lerobot.world_model.reference import OracleModel, ShuffledModel, learned_part
from accerl_lerobot.world_model.rollouts import Imagination
from accerl_lerobot.world_model.store import check_predicts, load_failed, load_roles, load_world_model
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

logger = logging.getLogger(__name__)

LEARN = "imagination.learn.dataset"
MAX_PENDING = 2  # messages to replay that may be pending before imagination pauses
PAUSE_S, POLL_S = 0.02, 0.2
"""Sleep of a worker with nothing to do, and interval at which replay is asked for new real segments."""
SWAP_S = 30.0  # largest wait of a checkpoint for a promoted model to be taken over


def make_imagination(config: RunConfig, on_segment: Callable[[Segment], object]) -> Imagination:
    """Builds the imagination of a run; its ``policy.path`` must be set."""
    environment, model, success = _load(config, load_lerobot_config(config.policy))
    cost, seed = config.rollout.decision_cost, config.seed
    return Imagination(
        model, success, environment, config.imagination, on_segment, decision_cost=cost, seed=seed
    )


def make_learner(config: RunConfig) -> OnlineLearner:
    """Builds the learner of a run's world model, which starts at the saved one."""
    environment, model, success = _load(config, load_lerobot_config(config.policy))
    assert success is not None  # only an oracle has none
    roles = load_roles(Path(str(config.imagination.path)).expanduser(), IMAGINATION)
    known = load_datasets({LEARN: config.imagination.learn.dataset}, model.spec).get(LEARN, [])
    longest = _longest(environment, model.spec.chunk)
    settings = (config.imagination.learn, known, roles, longest, config.seed)
    return OnlineLearner(learned_part(model), success, *settings)


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what `make_imagination` would refuse in the middle of it; warns of a
    world model that is used as it is and has failed its validation."""
    _, model, _ = _load(config, policy_to_be(config), first=True)
    if config.imagination.learns:
        learn, episodes = config.imagination.learn, config.rollout.episodes
        if learn.dataset.repo_id is None and 0 < episodes < (least := math.ceil(1 / learn.held_out)):
            why = f"none is held out, so no world model can pass: use at least {least}, or name {LEARN}"
            raise InputError("rollout.episodes", episodes, why)
        open_datasets({LEARN: learn.dataset}, model.spec)
    elif config.imagination.needs_path:
        _warn_of_failed(Path(str(config.imagination.path)).expanduser())


def _warn_of_failed(path: Path) -> None:
    failed = load_failed(path, IMAGINATION)
    if failed == []:
        return
    why = "was never validated" if failed is None else f"failed its validation ({', '.join(failed)[:200]})"
    logger.warning(
        "the world model of imagination.path=%s %s and is used all the same; train it longer or on more "
        "episodes, or use imagination.learn.steps_per_episode, with which only one that passes is used",
        path, why,
    )  # fmt: skip


def _load(
    config: RunConfig, policy: Any, *, first: bool = False
) -> tuple[EnvironmentSpec, WorldModel, SuccessPairsRewardModel | None]:
    """The environment, and the models, which are checked to fit it and LeRobot's config of the policy.

    A world model that nobody has loaded before predicts a chunk (`first`). Oracles have no success model.
    """
    imagination, executed = config.imagination, getattr(policy, "n_action_steps", 1)
    if (reward := getattr(config.env, "reward", "success")) != "success":
        why = "use success with imagination.share: imagined rollouts end with a success, and pay for it"
        raise InputError("env.reward", reward, why)
    if config.env.state_size:
        why = "no policy reads it, and nothing imagined has it; leave it out, or use imagination.share=0"
        raise InputError("env.environment_state", getattr(config.env, "environment_state", None), why)
    if policy.n_obs_steps > 1:
        why = "the policy looks back so many env steps, and only one frame per decision is imagined; use a"
        raise InputError("policy.n_obs_steps", policy.n_obs_steps, f"{why} policy with 1, or no imagination")
    with closing(make_environment(config.env)) as environment:
        spec = environment.spec
    imagination.imagined_replay(config.replay).check(
        batch_decisions=config.trainer.batch_decisions, segment_decisions=_longest(spec, executed)
    )
    success_model = config.rollout.reward_model
    if not imagination.needs_path:
        oracle = OracleModel(spec, executed, lambda: make_environment(config.env, reward_model=success_model))
        return spec, oracle, None
    device = resolve_device(config.policy.device)
    path, package = Path(str(imagination.path)).expanduser(), imagination.discover_packages_path
    learned, success = load_world_model(path, package, section=IMAGINATION)
    if first:
        check_predicts(path, learned, success, section=IMAGINATION)
    check_fit(learned.spec, spec, executed)
    if first:  # the driver keeps off the GPU
        return spec, learned, success
    success.config.device = str(device)
    success.to(device)
    model = learned.to(device)
    return spec, ShuffledModel(model) if imagination.model == "shuffled" else model, success


def check_fit(spec: WorldModelSpec, environment: EnvironmentSpec, executed: int) -> None:
    """Refuses one that does not fit environment and policy, which executes so many actions per decision."""
    field, again = f"{IMAGINATION}.path", "train one of this environment"
    if missing := [camera for camera in environment.images if camera not in spec.cameras]:
        why = f"the environment shows this camera, the world model {spec.cameras!r}; {again}"
        raise InputError(field, missing[0], why)
    for name in ("state_dim", "action_dim", "fps"):
        theirs, ours = getattr(spec, name), getattr(environment, name)
        if theirs != ours:
            why = f"is the world model's {name}, and the environment's is {ours}; {again}"
            raise InputError(field, theirs, why)
    if spec.tasks and (others := [task for task in environment.tasks if not _is_of(task, spec.tasks)]):
        hint = f"the world model is of {spec.tasks!r}; name these, or train one of it"
        raise InputError("env.task", others[0], hint)
    if spec.chunk != executed:
        why = f"env steps per prediction, and the policy executes {executed} actions per decision"
        raise InputError(field, spec.chunk, f"{why}; train one with world_model.chunk={executed}")


def _is_of(task: str, known: Sequence[str]) -> bool:
    """True if the task is known. A task of a suite that is played alone may have the suite's name only."""
    suite, _, number = task.partition("/")
    return task in known or suite in known or (not number and any(k.startswith(f"{suite}/") for k in known))


def _longest(environment: EnvironmentSpec, chunk: int) -> int:
    return math.ceil(environment.max_steps / chunk)


class _Worker:
    """Becomes a threaded Ray actor in `launch`: `run` on one thread, everything else beside it."""

    name: str
    state_name: str
    step_name: str

    def __init__(self, config: RunConfig, state: Path | None = None, timeline: Path | None = None) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, self.name)
        import torch

        torch.set_num_threads(config.trainer.num_threads)
        torch.manual_seed(config.seed)
        self._limit, self._cursor, self._asked = config.launch.stall_s, 0, -math.inf
        self._core = self._make(config)
        self._changing = threading.Lock()  # held while the core changes; a validation is of a copy
        if state is not None:
            saved = snapshot.load(state / self.state_name)
            self._core.restore(saved["core"])
            self._cursor = saved["cursor"]
        self._clock.enter(WAIT_IN)

    def _make(self, config: RunConfig) -> Any:
        raise NotImplementedError

    def ready(self) -> int:
        return os.getpid()

    def metrics(self) -> dict[str, float]:
        self._clock.beat()
        metrics: dict[str, float] = self._core.metrics()
        return metrics

    def save(self, directory: Path) -> None:
        with self._unchanging(self._limit):
            self._write(directory)

    def _write(self, directory: Path) -> None:
        saved = {"core": self._core.state(), "cursor": self._cursor}
        snapshot.save(directory / TRAINING_STATE / self.state_name, saved)

    def _news(self, replay: Any, last: News) -> News:
        """Real segments that replay has got since `last`; it is asked every `POLL_S`."""
        self._clock.enter(TRANSPORT)
        if time.monotonic() < self._asked + POLL_S:
            return last._replace(segments=[])
        news: News = _await(replay.news.remote(last.cursor))
        self._asked = time.monotonic()
        return news

    @contextmanager
    def _unchanging(self, patience_s: float) -> Iterator[None]:
        if not self._changing.acquire(timeout=patience_s):
            hint = "raise launch.stall_s if one takes that long"
            raise TimeoutError(f"{self.step_name} has not ended for {patience_s:.0f} s or more; {hint}")
        try:
            yield
        finally:
            self._changing.release()


class ImaginationWorker(_Worker):
    """The worker that imagines."""

    name = state_name = IMAGINATION
    step_name = "an imagination step"

    def _make(self, config: RunConfig) -> Imagination:
        # The engine notices inference that hangs after `stall_s`; this is in case it does not.
        self._patience_s = 2 * self._limit
        self._share, self._batch = config.imagination.share, config.inference.max_batch
        self._outbox: list[Segment] = []
        self._deciding = ReconnectingClient("inference")
        self._promoted: deque[Promotion] = deque(maxlen=1)
        self._may_promote = config.imagination.learns
        return make_imagination(config, self._outbox.append)

    def promote(self, promotion: Promotion) -> None:
        """Uses this model from the next chunk on."""
        self._promoted.append(promotion)

    def expect(self, may_promote: bool) -> None:
        self._may_promote = may_promote

    def move(self, inference: Endpoint) -> None:
        self._deciding.move(inference)

    def save(self, directory: Path) -> None:
        """Writes its part of a checkpoint, once it has taken over what was promoted."""
        began = time.monotonic()
        while self._promoted and time.monotonic() < began + min(SWAP_S, self._limit / 2):
            time.sleep(PAUSE_S)
        with self._unchanging(began + self._limit - time.monotonic()):
            self._write(directory)
            self._core.save_promoted(directory / WORLD_MODEL)

    def run(self, inference: Endpoint, inserting: Endpoint, replay: Any) -> None:
        """Imagines until replay is closed."""
        news, reported = News([], self._cursor, ended=False, closed=False), None
        deciding, connection = self._deciding, inserting.connect()
        deciding.move(inference)
        pending: set[int] = set()
        while not news.closed:
            news = self._news(replay, news)
            self._clock.enter(CHECKPOINT)
            with self._changing:
                may_promote = self._may_promote  # first: the last model comes before the word that it is
                self._swap()
                self._clock.enter(COMPUTE)
                for segment in news.segments:
                    self._core.remember(segment)
                self._cursor = news.cursor
            # Both at once: a run that imagines nothing and expects no model has nothing to wait for.
            if reported != (self._core.on, may_promote):
                reported = (self._core.on, may_promote)
                share = self._share if self._core.on else 0.0
                _await(replay.change.remote(share=share, awaited=any(reported)))
            self._clock.enter(TRANSPORT)
            for ticket, stored in connection.done(0.0):
                pending.discard(ticket)
                if not stored:
                    return
            self._clock.enter(COMPUTE)
            with self._changing:
                requests = [] if len(pending) >= MAX_PENDING else self._core.requests()
            if not requests:
                self._clock.enter(WAIT_OUT if len(pending) >= MAX_PENDING else WAIT_IN)
                time.sleep(PAUSE_S)
                continue
            parts = [requests[i : i + self._batch] for i in range(0, len(requests), self._batch)]
            self._clock.enter(WAIT_IN)
            answers = deciding.ask(parts, self._patience_s)
            self._clock.enter(CHECKPOINT)
            with self._changing:
                self._clock.enter(COMPUTE)
                fault_point("imagination.step")
                self._core.advance([decision for answer in answers for decision in answer])
                self._clock.enter(TRANSPORT)
                if self._outbox:
                    pending.add(connection.send(self._outbox))
                    self._outbox.clear()
        with self._changing:  # for the last checkpoint
            self._swap()

    def _swap(self) -> None:
        if self._promoted:
            self._clock.enter(WEIGHT_SYNC)
            self._core.swap(self._promoted.pop())


class WorldModelLearningWorker(_Worker):
    """The worker that trains the world model."""

    name, state_name = WORLD_LEARNING, "world_learner"
    step_name = "a step of learning"

    def _make(self, config: RunConfig) -> OnlineLearner:
        return make_learner(config)

    def run(self, imaginer: Any, replay: Any) -> None:
        """Trains until replay is closed."""
        news, learner = News([], self._cursor, ended=False, closed=False), self._core
        held = expected = None  # as last reported
        while not news.closed:
            news = self._news(replay, news)
            with self._changing:
                for segment in news.segments:
                    learner.add(segment)
                self._cursor = news.cursor
            last = news.ended
            if held is not (hold := learner.validation_due(last=False) and not last):
                held = hold
                _await(replay.change.remote(held=hold))
            if expected is not (may_promote := learner.may_promote(last)):
                expected = may_promote
                _await(imaginer.expect.remote(may_promote))
            if learner.pending_steps >= 1:
                self._clock.enter(CHECKPOINT)
                with self._changing:
                    self._clock.enter(COMPUTE)
                    fault_point("learning.step")
                    learner.step()
            elif learner.validation_due(last):
                self._clock.enter(COMPUTE)
                if promotion := learner.promote(last):
                    self._clock.enter(WEIGHT_SYNC)
                    _await(imaginer.promote.remote(promotion))
                    learner.mark_served()
            else:
                self._clock.enter(WAIT_IN)
                time.sleep(PAUSE_S)


def _await(reference: Any) -> Any:
    import ray  # the engine in one process uses this file too

    return ray.get(reference)
