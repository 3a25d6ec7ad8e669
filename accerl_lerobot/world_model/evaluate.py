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

from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.dataset import fingerprint, load_episodes
from accerl_lerobot.world_model.episodes import Episode
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
    """Indices of episodes."""
    learnt: bool
    """True if the world model has learnt from others of them."""


def evaluate(config: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Tries a saved world model; `directory` exists and is empty.

    Returns:
        See `try_sources`; also in ``trial.json``.

    Raises:
        InputError: no such device, no world model there, a dataset of another kind, or nothing was held out.
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
    parts: dict[str, _Part] = {}
    for room, meta in open_rooms(rooms_of(config), spec).items():
        with named(room):
            parts[room] = _part(meta, sources_of)
    part = parts["dataset"]
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
        learnt=learnt, fresh=fresh, kept=kept, seed=config.seed,
    )  # fmt: skip
    (directory / "trial.json").write_text(json.dumps(result, indent=2) + "\n")
    return result


def _part(meta: Any, sources: Sequence[Source]) -> _Part:
    """Held-out part of a dataset that it has learnt from; of another one everything."""
    source = find(sources, fingerprint(meta))
    if source is None:
        return _Part(meta, None, list(range(meta.total_episodes)), False)
    if not source.held_out:
        remedy = "the world model has learnt from every episode of it; give another dataset"
        raise InputError("dataset.repo_id", meta.repo_id, remedy)
    return _Part(meta, source, list(source.held_out), True)
