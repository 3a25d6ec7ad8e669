# SPDX-License-Identifier: Apache-2.0
"""Hints of messages, applied: each leads to another message, or to none."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.config import parsing
from accerl_lerobot.config.lerobot import FLAGS
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
    ("train", ["--dataset.episodes=[0,1]"]),
    ("train", ["--wandb.mode=offline"]),
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
    ("eval", ["--steps=3"]),
    ("eval", ["--eval.n_episodes=3"]),
    ("sft", ["--wandb.entity=team"]),
    ("sft", ["--num_workers=4"]),
    ("sft", ["--batch_size=8"]),
    ("sft", ["--policy.device=cpu"]),
    ("demos", ["--num_workers=2"]),
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


def lerobot_fields(config: type[Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names of LeRobot's own command line, with a value of each."""
    for field in dataclasses.fields(config):
        hint = typing.get_type_hints(config)[field.name]
        section = parsing.section_of(hint)
        if section is not None and not parsing.choices_of(section):
            yield from lerobot_fields(section, f"{path}{field.name}.")
        elif section is None or field.name in ("optimizer", "scheduler", "reward_model"):
            below = ".type" if section is not None else ""
            text = str(hint)
            value = "true" if "bool" in text else "3" if "int" in text else "0.5" if "float" in text else "x"
            yield f"{path}{field.name}{below}", "[0, 1]" if "list[int]" in text else value


def test_every_flag_of_lerobot_train_has_a_hint_that_leads_on() -> None:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig

    names = dict(lerobot_fields(TrainPipelineConfig)) | {"optimizer.lr": "1e-5"}
    names |= {f"policy.{name}": value for name, value in lerobot_fields(PreTrainedConfig)}
    names |= {"policy.chunk_size": "10", "policy.freeze_vision_encoder": "false"}
    unknown = {flag for flag in FLAGS if not any(f"{name}.".startswith(f"{flag}.") for name in names)}
    assert unknown <= {"eval_freq", "policy", "policy.type", "trust_remote_code"}, "not LeRobot's"
    hinted = 0
    for verb in ("train", "sft", "eval", "offline"):
        for name, value in names.items():
            needed = {"offline": ["--policy.path=p", "--dataset.repo_id=a/b"]}.get(verb, [])
            arguments = [*needed, f"--{name}={value}"]
            error = outcome(verb, arguments)
            if error is None or "no such field" not in str(error) and "LeRobot's" not in str(error):
                continue
            assert "the name is LeRobot's" in str(error), error
            try_hints(verb, arguments)
            hinted += 1
    assert hinted > 100


def test_a_flag_of_lerobot_train_is_handed_on() -> None:
    error = outcome("train", ["--dataset.image_transforms.enable=true"])
    assert error is not None
    assert "'--sft.extra_args=[\"--dataset.image_transforms.enable=true\"]'" in str(error)
    (proposal,) = proposals("train", error, ["--dataset.image_transforms.enable=true"])
    assert parse(RunConfig, proposal).sft.extra_args == ["--dataset.image_transforms.enable=true"]
    assert "set WANDB_MODE in the environment" in str(outcome("train", ["--wandb.mode=offline"]))
    assert "policy.tuning.mode=lora" in str(outcome("train", ["--peft.method_type=LORA"]))


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
