# SPDX-License-Identifier: Apache-2.0
"""Checks that a world model can stand for a world."""

from __future__ import annotations

from collections.abc import Sequence

from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.contract import WorldModelSpec

SHOWN = 4
"""Tasks of a list that an error shows."""


def check_fit(spec: WorldModelSpec, world: WorldSpec, executed: int, history: int, judged: bool) -> None:
    """Refuses a world model that cannot stand for a world, before a run begins.

    Args:
        spec: what it shows.
        world: what the policy acts in.
        executed: actions that the policy executes per decision.
        history: env steps that the policy's observations hold.
        judged: whether there is a success model beside it.

    Raises:
        InputError: it shows other cameras, another robot or other tasks, goes another number of steps at a
            time, cannot tell a success, or the policy looks back at what is not imagined.
    """

    def refuse(value: object, why: str) -> InputError:
        return InputError("imagination.path", value, why)

    if missing := [camera for camera in world.images if camera not in spec.cameras]:
        theirs = ", ".join(spec.cameras)
        raise refuse(
            missing[0], f"the world shows this camera, the world model {theirs}; learn one of this world"
        )
    needed = {"pixels"} | ({"state"} if world.state_dim else set())
    if lacking := needed - spec.provides:
        why = "the policy reads it, and the world model does not provide it"
        raise refuse(sorted(lacking)[0], f"{why}; learn one with accerl world-model")
    for name in ("state_dim", "action_dim", "fps"):
        theirs, ours = getattr(spec, name), getattr(world, name)
        if theirs != ours:
            remedy = f"is the world model's {name}, and the world's is {ours}; learn one of this world"
            raise refuse(theirs, remedy)
    if spec.tasks and (others := [task for task in world.tasks if not _is_of(task, spec.tasks)]):
        more = "" if len(spec.tasks) <= SHOWN else f" and {len(spec.tasks) - SHOWN} more"
        remedy = (
            f"the world model is of {', '.join(spec.tasks[:SHOWN])}{more}; name these, or learn one of it"
        )
        raise InputError("env.task", others[0], remedy)
    if spec.chunk != executed:
        why = f"env steps to a dream's chunk, and the policy executes {executed} actions per decision"
        raise refuse(spec.chunk, f"{why}; learn one with world_model.chunk={executed}")
    if history > 1:
        why = "the policy looks back so many env steps, and dreams show one frame per decision"
        raise InputError("policy.n_obs_steps", history, f"{why}; use a policy with 1, or imagination.share=0")
    if not judged and "success" not in spec.provides:
        why = "there is no success model beside the world model, and it cannot tell a success"
        raise refuse(None, f"{why}; learn both with accerl world-model")


def _is_of(task: str, known: Sequence[str]) -> bool:
    """A suite of which one task is played alone has only its own name: it may be any of them."""
    suite, _, number = task.partition("/")
    return task in known or suite in known or (not number and any(k.startswith(f"{suite}/") for k in known))
