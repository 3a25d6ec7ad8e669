# SPDX-License-Identifier: Apache-2.0
"""Trials of a world model on episodes from several sources: which they are, and which of them decide.

held out    of the dataset that it has learnt from, those that it has not; or dataset: all of another one
online      what a policy lived through, as ``accerl export`` writes it; of that, too, what was held out
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from accerl_lerobot.console import Console
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.dataset import check_metadata, fingerprint
from accerl_lerobot.world_model.episodes import Episode, amount
from accerl_lerobot.world_model.films import film
from accerl_lerobot.world_model.trial import try_out

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun, WorldModelRun
    from accerl_lerobot.config.dataset import DatasetConfig
    from accerl_lerobot.world_model.config import TrialConfig
    from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModelSpec
    from accerl_lerobot.world_model.stand_in import SuccessModel

HELD_OUT, DATASET, ONLINE = "held out", "dataset", "online"
"""Names of sources."""
PREVIEW = "preview.mp4"


def try_sources(
    model: LearnableWorldModel,
    sources: dict[str, list[Episode]],
    config: TrialConfig,
    success: SuccessModel | None,
    directory: Path,
    console: Console,
    *,
    learnt: Collection[str] = (),
    fresh: str | None = None,
    kept: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Tries a world model on each of them, and films it.

    Args:
        model: in inference.
        sources: name → episodes that it has not learnt from.
        config: what is tried, and what it takes to pass.
        success: what tells successes, if anything does.
        directory: where ``preview.mp4`` goes, of the first, and ``preview_<source>.mp4`` of the others.
        console: progress for people.
        learnt: sources of which it has learnt from other episodes. Their gates count, too.
        fresh: the source on whose episodes the success threshold is set: of some of them, for the others. All
            other sources are judged by the threshold there is.
        kept: whether what is set on all of `fresh` is the threshold from then on, for the other sources too.
        seed: of what is drawn.

    Returns:
        What `try_out` found on the first, with its ``name`` and how many episodes were ``tried``; and
        ``sources``: name → the same of the others. Gates of others that count are among the first's, as
        ``<source>.<gate>``, and ``passed`` says whether all hold.
    """
    first, *others = sources
    found: dict[str, dict[str, Any]] = {}
    for name in sorted(sources, key=lambda name: name != fresh):
        episodes = sources[name]
        there = None if success is None else success.config.threshold
        with console.stage(f"trial, {name}"):
            told = try_out(model, episodes, config, success, seed, name == fresh)
            found[name] = {"name": name} | told | {"tried": amount(episodes)}
            video = directory / (PREVIEW if name == first else f"preview_{name}.mp4")
            film(video, model, episodes, config, seed)
        if success is not None and there is not None and not kept:
            success.config.threshold = there
    result = found[first]
    gates = dict(result["gates"])
    for name in others:
        if name in learnt:
            gates |= {f"{name}.{gate}": held for gate, held in found[name]["gates"].items()}
    passed = all(gate["holds"] for gate in gates.values())
    rest = {name: found[name] for name in others}
    return result | {"gates": gates, "passed": passed, "sources": rest}


def rooms_of(run: WorldModelRun | WorldModelEvalRun) -> dict[str, DatasetConfig]:
    """``dataset``, which has to be there, and ``online``, if it is named."""
    return {DATASET: run.dataset} | ({} if run.online.repo_id is None else {ONLINE: run.online})


def open_rooms(rooms: dict[str, DatasetConfig], spec: WorldModelSpec) -> dict[str, Any]:
    """The metadata of each dataset that is named, before any image is read.

    Args:
        rooms: where on the command line → what is named there.
        spec: of the world that they have to be of.

    Raises:
        InputError: see `open_metadata` and `check_metadata`; or one is named twice.
    """
    opened: dict[str, Any] = {}
    prints: dict[str, str] = {}
    for room, dataset in rooms.items():
        with named(room):
            meta = opened[room] = open_metadata(dataset)
            check_metadata(meta, str(dataset.repo_id), spec)
            of = prints.setdefault(fingerprint(meta), room)
            if of != room:
                raise InputError("dataset.repo_id", dataset.repo_id, f"it is the one in {of}; name another")
    return opened


def check_apart(dataset: DatasetConfig, episodes: Sequence[Episode], others: Sequence[Episode]) -> None:
    """Refuses a dataset that shares episodes with another, where they may be held out while learnt from here.

    Raises:
        InputError: some are.
    """
    there = {episode.actions.tobytes() for episode in others}
    if twice := sum(episode.actions.tobytes() in there for episode in episodes):
        remedy = f"{twice} of its episodes are in the other dataset, too; name one that has only others"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy)


@contextmanager
def named(room: str) -> Iterator[None]:
    """Names the section of a dataset in errors about it."""
    try:
        yield
    except InputError as error:
        field = error.field.replace("dataset.", f"{room}.", 1)
        raise InputError(field, error.value, error.remedy) from error
