# SPDX-License-Identifier: Apache-2.0
"""Facts around a folder that is pushed: the run it came from, and its measurements.

A number goes with a policy only if it was measured on it: a run's summary is of its last checkpoint, and an
evaluation says which policy it was of.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.kinds import POLICY, RECIPE, RUN, SUCCESS_MODEL, WORLD_MODEL, read_json

FOLDER = "accerl_run"
"""Where a policy or world model carries what is known of its run."""
EVALUATION, VALIDATION = "evaluation.json", "validation.json"
KEPT = {
    POLICY: (RECIPE, SUMMARY, EVALUATION, "success_curve.png", "before_after.mp4"),
    WORLD_MODEL: (RECIPE, VALIDATION, "preview.mp4", "preview_online.mp4"),
    SUCCESS_MODEL: (RECIPE, VALIDATION),
}
"""Kind → files of its run that go with it."""


@dataclass(frozen=True, kw_only=True)
class Around:
    """Facts around a folder."""

    recipe: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    """Summary of a run that ended with this very policy."""
    evaluation: dict[str, Any] = field(default_factory=dict)
    """By ``accerl eval``, of this very policy."""
    validation: dict[str, Any] = field(default_factory=dict)
    """Held-out validation of the world model."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Name in the repository → file that goes with the folder."""


def look_around(folder: Path, kind: str, evaluation: str | None) -> Around:
    """Finds the run of a folder, or what it carries of it.

    Args:
        folder: what is pushed.
        kind: of it.
        evaluation: folder or file of an evaluation.

    Raises:
        InputError: there is no such evaluation, or it is of another policy.
    """
    if evaluation is not None and kind not in (POLICY, RUN):
        raise InputError("evaluation", evaluation, f"only a policy is evaluated, this is a {kind}")
    known, files = _known(folder, kind)
    if evaluation is not None:
        path = Path(evaluation).expanduser()
        path = path / EVALUATION if path.is_dir() else path
        known["evaluation"] = _evaluation(path, folder, kind)
        files[EVALUATION if kind == RUN else f"{FOLDER}/{EVALUATION}"] = path
    return Around(**known, files=files)


def _known(folder: Path, kind: str) -> tuple[dict[str, Any], dict[str, Path]]:
    """Fields of an `Around`, and files of the run that go with the folder."""
    carried = folder / FOLDER
    if kind == RUN or carried.is_dir():  # an evaluation is there only if one was given to an earlier push
        home = folder if kind == RUN else carried
        records = {"summary": read_json(home / SUMMARY), "evaluation": read_json(home / EVALUATION)}
        names = KEPT.get(kind, ())
    elif (run := _run_of(folder.resolve(), kind)) is not None:
        home = run
        last = kind == POLICY and _is_last(folder.resolve(), run)
        records = {"summary": read_json(run / SUMMARY) if last else {}}
        names = KEPT[kind] if last or kind != POLICY else (RECIPE,)
        names = tuple(name for name in names if name != EVALUATION)
    else:
        return {}, {}
    known = records | {"recipe": _recipe(home / RECIPE), "validation": read_json(home / VALIDATION)}
    return known, {f"{FOLDER}/{name}": home / name for name in names if (home / name).is_file()}


def _run_of(folder: Path, kind: str) -> Path | None:
    if kind == POLICY and folder.name == PRETRAINED and folder.parents[1].name == CHECKPOINTS:
        run, sign = folder.parents[2], RECIPE
    elif kind in (WORLD_MODEL, SUCCESS_MODEL):
        run, sign = folder.parents[0 if kind == WORLD_MODEL else 1], VALIDATION
    else:
        return None
    return run if (run / sign).is_file() else None


def _is_last(folder: Path, run: Path) -> bool:
    """True if a run's summary is of the policy in `folder`."""
    return folder.parent.name.isdigit() and int(folder.parent.name) == read_json(run / SUMMARY).get("updates")


def _recipe(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text()) if path.is_file() else None
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    return tree if isinstance(tree, dict) else {}


def _evaluation(path: Path, folder: Path, kind: str) -> dict[str, Any]:
    found = read_json(path)
    if "success" not in found or "ci95" not in found:
        raise InputError("evaluation", str(path), "not what accerl eval writes; name its output_dir")
    measured = Path(str(found.get("policy"))).expanduser().resolve()
    pushed = folder.resolve() if kind == POLICY else (folder / CHECKPOINTS / LAST / PRETRAINED).resolve()
    if measured != pushed:
        raise InputError("evaluation", str(path), f"it is of another policy, {found.get('policy')}")
    return found
