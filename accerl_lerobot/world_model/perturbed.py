# SPDX-License-Identifier: Apache-2.0
"""Real outcomes of actions that nobody demonstrated: episodes played again, pushed off their way.

An episode of a dataset is played from where it began with its own actions and noise on top. The noise is held
for some steps, as what is drawn anew at each of them averages out. What then happens is the truth that dreams
with these actions are held against.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from accerl_lerobot.demos.starts import Start
from accerl_lerobot.envs.base import World, WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observation
from accerl_lerobot.world_model.config import PerturbedConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.frames import seen

SOURCE = "perturbed"


def check_world(world: WorldSpec, spec: WorldModelSpec) -> None:
    """Refuses a world that the model is not of.

    Raises:
        InputError: it has other cameras, or another robot.
    """
    if missing := [camera for camera in spec.cameras if camera not in world.images]:
        remedy = f"the world shows {', '.join(world.images)}, and the model is of {missing[0]}"
        raise InputError("env.camera", ", ".join(world.images), remedy)
    for name in ("state_dim", "action_dim", "fps"):
        if getattr(world, name) != getattr(spec, name):
            remedy = f"the world's {name}, and the model's is {getattr(spec, name)}: it is another world's"
            raise InputError("env", getattr(world, name), remedy)


def perturbed_episodes(
    world: World,
    starts: Sequence[Start],
    episodes: Sequence[Episode],
    config: PerturbedConfig,
    spec: WorldModelSpec,
    seed: int,
    on_episode: Callable[[int], object] = lambda played: None,
) -> list[Episode]:
    """Plays each of them once more, with noise on its actions, until it ends or has no more of them.

    Args:
        world: in which they were recorded.
        starts: of the episodes.
        episodes: as they were recorded.
        config: how far they are pushed.
        spec: of the pictures that are wanted.
        seed: of the noise.
        on_episode: told how many have been played.

    Raises:
        InputError: an episode does not begin here as it began when it was recorded.
    """
    made = []
    for i, (start, episode) in enumerate(zip(starts, episodes, strict=True)):
        actions = perturbed(episode.actions, world.spec, config, np.random.default_rng((seed, 7, start[1])))
        made.append(_played(world, start, episode, actions, spec))
        on_episode(i + 1)
    return made


def perturbed(
    actions: np.ndarray, world: WorldSpec, config: PerturbedConfig, rng: np.random.Generator
) -> np.ndarray:
    """Actions float32 (T, A) with noise on top, within the world's bounds."""
    pieces = -(-len(actions) // config.hold)
    noise = config.noise * rng.standard_normal((pieces, actions.shape[1])).repeat(config.hold, 0)
    half = (world.action_high - world.action_low) / 2
    pushed = actions + noise[: len(actions)] * half
    return np.clip(pushed, world.action_low, world.action_high).astype(np.float32)


def _played(
    world: World, start: Start, recorded: Episode, actions: np.ndarray, spec: WorldModelSpec
) -> Episode:
    task, at = start
    if task not in world.spec.tasks:
        raise InputError("env.task", ", ".join(world.spec.tasks), f"the dataset's episodes are of {task}")
    observation = world.reset(at, task)
    shown = [_seen(observation, spec)]
    if not np.array_equal(shown[0][0], recorded.frames[0]):
        remedy = (
            f"an episode of {task} (seed {at}) does not begin as it was recorded; give the dataset's own env"
        )
        raise InputError("env", world.spec.tasks[0], remedy)
    made, success_at = 0, -1
    for action in actions:
        result = world.step_chunk(action[None])
        shown.append(_seen(result.observation, spec))
        if result.success and success_at < 0:
            success_at = made
        made += 1
        if result.done:
            break
    frames, robot = (np.stack(part) for part in zip(*shown, strict=True))
    return Episode(
        frames=frames,
        times=np.arange(made + 1),
        state=robot.astype(np.float32),
        actions=actions[:made],
        success_at=success_at,
        task=recorded.task,
        source=SOURCE,
    )


def _seen(observation: Observation, spec: WorldModelSpec) -> tuple[np.ndarray, np.ndarray]:
    """Frame (V, H, W, 3) and state (S,)."""
    one = {key: np.asarray(value)[None] for key, value in observation.items() if key != "task"}
    frames, robot = seen(one, spec)
    return frames[0], robot[0]
