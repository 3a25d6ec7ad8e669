# SPDX-License-Identifier: Apache-2.0
"""Hints of messages, applied: each leads to another message, or to none."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.config import parsing
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.errors import InputError

NAME = r"[\w-]+(?:\.[\w-]+)*(?:=[\w.]+)?"
FLAG = r"(?:'--[^']+'|--[\w.]+=[\w./-]+)"


def outcome(verb: str, arguments: list[str]) -> InputError | None:
    """The mistake in a command line, if there is one."""
    try:
        parse(CONFIGS[verb], arguments, recipe_class=RunConfig if verb != "train" else None)
    except InputError as error:
        return error
    return None


def proposals(verb: str, error: InputError, arguments: list[str]) -> Iterator[list[str]]:
    """Command lines that a message proposes, each in place of what it complains about."""
    text = error.hint
    fields = {name.partition(".")[0] for name in parsing.dotted_fields(CONFIGS[verb])}
    rest = [a for a in arguments if a.removeprefix("--").partition("=")[0] != error.field]
    typed = next((a.partition("=")[2] for a in arguments if a not in rest), "1")
    for flags in re.findall(rf"{FLAG}(?: {FLAG})*", text):
        added = shlex.split(flags)
        if not added[0].startswith("--path="):  # of another command, to be run afterwards
            given = {argument.partition("=")[0] for argument in added}
            yield [*(a for a in rest if a.partition("=")[0] not in given), *added]
    for words in re.findall(rf"(?:\buse(?! accerl)|did you mean) ((?:{NAME})(?: or {NAME})*)", text):
        for name in words.split(" or "):
            if name.partition(".")[0].partition("=")[0] in fields:
                yield [*rest, f"--{name}" if "=" in name else f"--{name}={typed}"]
            else:  # a value
                yield [*rest, f"--{error.field}={name}"]
    if "leave it out" in text or "leave the field out" in text:
        yield rest


MISTAKES: list[tuple[str, list[str]]] = [
    ("train", ["--lr=1e-5"]),
    ("train", ["--trainer.lrr=1e-5"]),
    ("train", ["--trainer.workers=3"]),
    ("train", ["--env.episodes=3"]),
    ("train", ["--algorithm.type=gippo"]),
    ("train", ["--env.type=metawrld"]),
    ("train", ["--wandb.enable=perhaps"]),
    ("train", ["--policy.path=x", "--sft.steps=5"]),
    ("train", ["--launch.placement={trainer: 1}"]),
    ("train", ["--launch.engine=local", "--launch.schedule=synchronous"]),
    ("train", ["--launch.engine=local", "--trainer.ranks=2"]),
    ("train", ["--env.type=simulated", "--algorithm.type=chunk_critic", "--world_model.type=simulator"]),
    ("train", ["--algorithm.type=awr", "--replay.samples_per_insert=4"]),
    ("eval", ["--eval.n_episodes=3"]),
]


def try_hints(verb: str, arguments: list[str]) -> None:
    error = outcome(verb, arguments)
    assert error is not None, arguments
    tried = list(proposals(verb, error, arguments))
    assert tried, f"nothing to try in: {error}"
    for proposal in tried:
        again = outcome(verb, proposal)
        same = again is not None and (again.field, again.hint) == (error.field, error.hint)
        assert not same and "no such field" not in str(again), f"{error}\n{proposal} → {again}"


@pytest.mark.parametrize(("verb", "arguments"), MISTAKES, ids=[f"{v} {' '.join(a)}" for v, a in MISTAKES])
def test_a_hint_leads_on(verb: str, arguments: list[str]) -> None:
    try_hints(verb, arguments)


@pytest.mark.parametrize("inside", ["", "checkpoints/000010", "checkpoints/000010/pretrained_model"])
def test_a_run_s_folder_is_its_recipe(inside: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "checkpoints" / "000010"):
        (folder / "pretrained_model").mkdir(parents=True)
        (folder / "config.yaml").write_text(json.dumps({"seed": 7}))
    assert parse(RunConfig, [f"--config_path={tmp_path / inside}"]).seed == 7
    path, _ = parsing.read_arguments([f"--config_path={tmp_path / inside}"])
    assert path is not None and path.name == "config.yaml"
    assert path.parent == (tmp_path / inside if "pretrained" not in inside else (tmp_path / inside).parent)
    (empty := tmp_path / "empty" / "empty").mkdir(parents=True)
    assert "a folder without config.yaml" in str(outcome("train", [f"--config_path={empty}"]))
