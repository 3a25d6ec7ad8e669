# SPDX-License-Identifier: Apache-2.0
"""A saved world model on episodes of one or several sources.

<output_dir>/
  trial.json                 what became of the first; under ``sources`` what became of the others
  preview.mp4                what happened, what it dreamt with those actions, and with another episode's
  preview_<source>.mp4       the same of the others
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from accerl_lerobot.console import Console
from accerl_lerobot.demos.starts import Start, read_starts
from accerl_lerobot.demos.windows import origin_of
from accerl_lerobot.envs import World, WorldSpec, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.contract import WorldModel, WorldModelSpec
from accerl_lerobot.world_model.dataset import fingerprint, load_episodes
from accerl_lerobot.world_model.deciding import (
    Decided,
    alike,
    check_policies,
    decide_twice,
    load_policy,
    replayed_whole,
)
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.inverse import InverseProbe, learn_probe
from accerl_lerobot.world_model.perturbed import SOURCE as PERTURBED
from accerl_lerobot.world_model.perturbed import check_world, perturbed_episodes
from accerl_lerobot.world_model.sources import (
    DATASET,
    HELD_OUT,
    ONLINE,
    named,
    open_rooms,
    rooms_of,
    try_sources,
)
from accerl_lerobot.world_model.stand_in import SuccessModel, load_stand_in, rehearse_stand_in
from accerl_lerobot.world_model.store import (
    Source,
    find,
    load_sources,
    load_world_model,
    rehearse_world_model,
)

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun


class _Part(NamedTuple):
    """A dataset's part in an evaluation."""

    meta: Any
    source: Source | None
    """As the world model knows it."""
    tried: list[int]
    """Indices of episodes,"""
    learnt: list[int]
    """and of those that the world model has learnt from; empty if it does not know the dataset."""


def evaluate(config: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Tries a saved world model; `directory` exists and is empty.

    Returns:
        See `try_sources`, with ``alike`` of each source where policies are named (`deciding.alike`); also in
        ``trial.json``.

    Raises:
        InputError: no such device, no world model there, a dataset or a world of another kind, or nothing was
            held out.
    """
    device = resolve_device(config.device, "device")
    path = Path(str(config.path)).expanduser()
    success: SuccessModel | None
    rehearse_world_model(path, config.discover_packages_path)
    model, success = load_world_model(path, config.discover_packages_path)
    model = model.to(device)
    if config.success.path is not None:
        rehearse_stand_in(config.success, model.spec, "success")
        success = load_stand_in(config.success, model.spec, "success", device)
    elif success is not None:
        success = success.to(device)
    spec, sources_of = model.spec, load_sources(path)
    worlds = check_policies(config.policies, spec)
    parts: dict[str, _Part] = {}
    for room, meta in open_rooms(rooms_of(config), spec).items():
        with named(room):
            parts[room] = _part(meta, sources_of)
    part = parts["dataset"]
    world, starts = _world(config, part, spec)
    for room, one in parts.items():
        if one.learnt:
            console.say(
                f"it has learnt from {getattr(config, room).repo_id} ({room}): tried on the {len(one.tried)} "
                "episodes that were held out"
            )
    sources: dict[str, list[Episode]] = {}
    with console.stage("episodes"):
        first = HELD_OUT if part.learnt else DATASET
        sources[first] = load_episodes(config.dataset, spec, both=success is not None, only=part.tried)
        if ONLINE in parts:
            with named(ONLINE):
                theirs = load_episodes(config.online, spec, ONLINE, both=False, only=parts[ONLINE].tried)
                sources[ONLINE] = theirs
    if world is not None:
        chosen = _rng(config.seed).permutation(len(starts))[: config.perturbed.episodes].tolist()
        again = [sources[first][i] for i in chosen], [starts[i] for i in chosen]
        with console.stage("playing again", total=len(chosen)) as stage:
            try:
                sources[PERTURBED] = perturbed_episodes(
                    world, again[1], again[0], config.perturbed, spec, config.seed, stage.update
                )
            finally:
                world.close()
    probe = _probe(config, part, spec, sources[first], console)
    names = {"dataset": first, ONLINE: ONLINE}
    learnt = [names[room] for room, one in parts.items() if one.learnt]
    fresh, kept = None, False
    if config.success.path is None:
        # Its threshold was set on what was held out of the last of them: there, it is set on some episodes
        # and tried on others. Elsewhere it is what it is.
        fresh = next((names[r] for r, one in parts.items() if sources_of[-1:] == (one.source,)), None)
    elif config.success.threshold is None:  # one that stands in has none yet
        both = len({episode.success for episode in sources.get(ONLINE, ())}) == 2
        fresh, kept = (ONLINE if both else first), True
    result = try_sources(
        model, sources, config.trial, success, directory, console,
        learnt=learnt, fresh=fresh, kept=kept, seed=config.seed, probe=probe,
    )  # fmt: skip
    trial = directory / "trial.json"
    trial.write_text(json.dumps(result, indent=2) + "\n")
    if config.policies:
        said = _decisions(config.policies, worlds, model, sources, console)
        result |= {"alike": said[first]}
        for name, one in result["sources"].items():
            one["alike"] = said[name]
        trial.write_text(json.dumps(result, indent=2) + "\n")
    return result


def _decisions(
    policies: Sequence[str],
    worlds: Sequence[WorldSpec],
    model: WorldModel,
    sources: dict[str, list[Episode]],
    console: Console,
) -> dict[str, dict[str, Any]]:
    """Likeness of the decisions of each source, see `alike`."""
    with console.stage("dreams for policies"):
        again = {name: replayed_whole(model, episodes) for name, episodes in sources.items()}
    decided: dict[str, list[Decided]] = {name: [] for name in sources}
    with console.stage("policies", total=len(policies)) as stage:
        for number, (path, world) in enumerate(zip(policies, worlds, strict=True), start=1):
            adapter = load_policy(path)
            for name, dreams in again.items():
                decided[name].append(decide_twice(adapter, model.spec, world, dreams))
            del adapter  # before there is another one
            stage.update(number)
    return {name: alike(every) for name, every in decided.items()}


def _part(meta: Any, sources: Sequence[Source]) -> _Part:
    """Held-out part of a dataset that it has learnt from; of another one everything."""
    source = find(sources, fingerprint(meta))
    if source is None:
        return _Part(meta, None, list(range(meta.total_episodes)), [])
    if not source.held_out:
        remedy = "the world model has learnt from every episode of it; give another dataset"
        raise InputError("dataset.repo_id", meta.repo_id, remedy)
    return _Part(meta, source, list(source.held_out), list(source.learnt))


def _world(
    config: WorldModelEvalRun, part: _Part, spec: WorldModelSpec
) -> tuple[World | None, Sequence[Start]]:
    """Where episodes are played again, and how those that are tried began; None if none are to be."""
    if not config.perturbed.episodes:
        return None, ()
    starts = read_starts(Path(part.meta.root), part.meta.total_episodes, origin_of(config.dataset))
    world = make_world(config.env)
    try:
        check_world(world.spec, spec)
    except InputError:
        world.close()
        raise
    return world, [starts[i] for i in part.tried]


def _probe(
    config: WorldModelEvalRun,
    part: _Part,
    spec: WorldModelSpec,
    tried: Sequence[Episode],
    console: Console,
) -> InverseProbe | None:
    """Learnt on what the world model has learnt from; if that is not known, on half of what is tried."""
    if not config.inverse.steps:
        return None
    rng, most = _rng(config.seed), config.inverse.episodes
    with console.stage("inverse dynamics"):
        if part.learnt:
            chosen = sorted(rng.permutation(part.learnt)[:most].tolist())
            episodes, known = load_episodes(config.dataset, spec, both=False, only=chosen), []
        else:
            known = sorted(rng.permutation(len(tried))[: min(most, len(tried) // 2)].tolist())
            episodes = [tried[i] for i in known]
        return learn_probe(episodes, chunk=spec.chunk, config=config.inverse, seed=config.seed, known=known)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 8))
