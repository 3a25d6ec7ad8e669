# SPDX-License-Identifier: Apache-2.0
"""Held-out evaluation of a world model on one or two datasets; ``accerl world-model-eval``.

held out    episodes of the dataset it was trained on that were held out; or dataset: all of another one
online      a policy's episodes, as ``accerl export`` writes them; of those, too, the held-out ones

<output_dir>/
  validation.json            results on the first; under ``datasets`` on the other
  preview.mp4                real, predicted, and predicted with another episode's actions
  preview_<dataset>.mp4      the same of the other
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.console import Console
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.data import (
    Episode,
    check_metadata,
    count_episodes,
    fingerprint,
    load_episodes,
)
from accerl_lerobot.world_model.model.store import (
    Source,
    find_source,
    load_sources,
    load_world_model,
    rehearse_world_model,
)
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from accerl_lerobot.world_model.validation.validate import preview_video, validate

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun, WorldModelRun
    from accerl_lerobot.config.dataset import DatasetConfig
    from accerl_lerobot.world_model.config import ValidationConfig
    from accerl_lerobot.world_model.model.contract import LearnableWorldModel, WorldModelSpec

HELD_OUT, DATASET, ONLINE = "held out", "dataset", "online"
"""Names of datasets in the results."""
PREVIEW, RESULT = "preview.mp4", "validation.json"


@dataclass(frozen=True, kw_only=True)
class DatasetRoles:
    """How the datasets of a validation count, by their names."""

    trained_on: Collection[str] = ()
    """Those of which the model was trained on other episodes. Their checks count, too."""
    fresh: str | None = None
    """The one on which the success threshold is chosen: of each fold, on the others. All other datasets are
    judged by the present threshold."""
    keep_threshold: bool = False
    """Keep the threshold that is chosen on all of `fresh`, for the other datasets too."""


def validate_datasets(
    model: LearnableWorldModel,
    datasets: dict[str, list[Episode]],
    config: ValidationConfig,
    success: SuccessPairsRewardModel | None,
    directory: Path,
    roles: DatasetRoles,
    seed: int = 0,
) -> dict[str, Any]:
    """Validates a world model on each dataset and makes a video of it.

    Args:
        model: in eval mode.
        datasets: name → episodes that it was not trained on.
        config: data and checks.
        success: None: outcomes are not checked.
        directory: receives the videos.
        roles: of the datasets.
        seed: of windows and shuffles.

    Returns:
        Results of `validate` on the first, with its ``name`` and how many episodes were ``tried``; and
        ``datasets``: name → the same of the others. Checks of others that count are among the first's, as
        ``<dataset>.<check>``, and ``passed`` is True if all hold.
    """
    first, *others = datasets
    results: dict[str, dict[str, Any]] = {}
    for name in sorted(datasets, key=lambda name: name != roles.fresh):
        episodes = datasets[name]
        threshold = None if success is None else success.config.threshold
        result = validate(model, episodes, config, success, seed, name == roles.fresh)
        results[name] = {"name": name} | result | {"tried": count_episodes(episodes)}
        video = directory / (PREVIEW if name == first else f"preview_{name}.mp4")
        preview_video(video, model, episodes, config, seed)
        if success is not None and threshold is not None and not roles.keep_threshold:
            success.config.threshold = threshold
    checks = dict(results[first]["checks"])
    for name in others:
        if name in roles.trained_on:
            checks |= {f"{name}.{check}": held for check, held in results[name]["checks"].items()}
    passed = all(check["holds"] for check in checks.values())
    rest = {name: results[name] for name in others}
    return results[first] | {"checks": checks, "passed": passed, "datasets": rest}


class _Part(NamedTuple):
    """A dataset's part in an evaluation."""

    source: Source | None
    """The record of it in the world model; None: it was not trained on it."""
    episodes: list[int]
    """Indices of those to evaluate on."""


def evaluate(config: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Evaluates a saved world model; `directory` exists and is empty.

    Returns:
        See `validate_datasets`; also in ``validation.json``.

    Raises:
        InputError: no such device, no world model there, a dataset of another kind, or nothing was held out.
    """
    device = resolve_device(config.device, "device")
    path = Path(str(config.path)).expanduser()
    rehearse_world_model(path, config.discover_packages_path)
    model, success = load_world_model(path, config.discover_packages_path)
    model = model.to(device)
    if success is not None:
        success = success.to(device)
    spec, sources = model.spec, load_sources(path)
    parts: dict[str, _Part] = {}
    for section, meta in open_datasets(dataset_sections(config), spec).items():
        with name_section(section):
            parts[section] = _part(meta, sources)
    for section, part in parts.items():
        if part.source is not None:
            console.say(
                f"trained on {getattr(config, section).repo_id} ({section}): evaluated on its "
                f"{len(part.episodes)} held-out episodes"
            )
    names = {DATASET: DATASET if parts[DATASET].source is None else HELD_OUT, ONLINE: ONLINE}
    datasets: dict[str, list[Episode]] = {}
    with console.stage("episodes"):
        datasets[names[DATASET]] = load_episodes(
            config.dataset, spec, both=success is not None, only=parts[DATASET].episodes
        )
        if ONLINE in parts:
            with name_section(ONLINE):
                datasets[ONLINE] = load_episodes(
                    config.online, spec, ONLINE, both=False, only=parts[ONLINE].episodes
                )
    # The threshold was chosen on what was held out of the last source: there, it is chosen in folds.
    fresh = next((names[r] for r, part in parts.items() if sources[-1:] == (part.source,)), None)
    trained_on = [names[section] for section, part in parts.items() if part.source is not None]
    roles = DatasetRoles(trained_on=trained_on, fresh=fresh)
    with console.stage("validation"):
        result = validate_datasets(model, datasets, config.validation, success, directory, roles, config.seed)
    (directory / RESULT).write_text(json.dumps(result, indent=2) + "\n")
    return result


def _part(meta: Any, sources: Sequence[Source]) -> _Part:
    """The held-out episodes of a dataset that the model was trained on; of another one all."""
    source = find_source(sources, fingerprint(meta))
    if source is None:
        return _Part(None, list(range(meta.total_episodes)))
    if not source.held_out:
        remedy = "the world model was trained on every episode of it; give another dataset"
        raise InputError("dataset.repo_id", meta.repo_id, remedy)
    return _Part(source, list(source.held_out))


def dataset_sections(run: WorldModelRun | WorldModelEvalRun) -> dict[str, DatasetConfig]:
    """``dataset``, and ``online`` if it is named."""
    return {DATASET: run.dataset} | ({} if run.online.repo_id is None else {ONLINE: run.online})


def open_datasets(sections: dict[str, DatasetConfig], spec: WorldModelSpec) -> dict[str, Any]:
    """Opens the metadata of each dataset, by its config section, before any image is read.

    Raises:
        InputError: see `open_metadata` and `check_metadata`; or one is named twice.
    """
    opened: dict[str, Any] = {}
    prints: dict[str, str] = {}
    for section, dataset in sections.items():
        with name_section(section):
            meta = opened[section] = open_metadata(dataset)
            check_metadata(meta, str(dataset.repo_id), spec)
            same = prints.setdefault(fingerprint(meta), section)
            if same != section:
                raise InputError("dataset.repo_id", dataset.repo_id, f"it is the one in {same}; name another")
    return opened


def check_disjoint(dataset: DatasetConfig, episodes: Sequence[Episode], others: Sequence[Episode]) -> None:
    """Refuses a dataset that shares episodes with another, where they may be on the other side of a split.

    Raises:
        InputError: some are shared.
    """
    known = {episode.actions.tobytes() for episode in others}
    if twice := sum(episode.actions.tobytes() in known for episode in episodes):
        remedy = f"{twice} of its episodes are in the other dataset, too; name one that has only others"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy)


@contextmanager
def name_section(section: str) -> Iterator[None]:
    """Puts the config section of a dataset into errors about it."""
    try:
        yield
    except InputError as error:
        field = error.field.replace("dataset.", f"{section}.", 1)
        raise InputError(field, error.value, error.remedy) from error
