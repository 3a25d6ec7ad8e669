# SPDX-License-Identifier: Apache-2.0
"""Warm start: hands a LeRobotDataset to LeRobot's own trainer and returns a LeRobot checkpoint.

The trainer is stock ``lerobot-train`` in a process of its own, under `guarded_train`; the exact command is
logged, so that anyone can repeat it.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from accerl_lerobot import errors
from accerl_lerobot.checkpoint.layout import CHECKPOINTS, LAST, PRETRAINED, displaced, relocate
from accerl_lerobot.checkpoint.safety import FileSource, read_json
from accerl_lerobot.config.parsing import as_text
from accerl_lerobot.config.ranges import Commit, DatasetConfig, LearningRate, Range, Section, Steps, Threads
from accerl_lerobot.demos.backbone import BackboneConfig, write_backbone
from accerl_lerobot.demos.dataset_files import local_folder, open_metadata, opened, read_labels
from accerl_lerobot.errors import InputError, check_absent, last_exception
from accerl_lerobot.experience import REWARD, SUCCESS
from accerl_lerobot.policies.config import check_registered, discovery, register_policies

logger = logging.getLogger(__name__)

TRUST = "--trust_remote_code="
PROGRESS = re.compile(
    r"(\| (?P<bar>\d+)/\d+ \[.*)?"
    r"\bstep:(?P<step>\d+\.?\d*)(?P<suffix>[KM]?) .*\bloss:(?P<loss>nan|inf|\d+\.?\d*)\b"
)
"""LeRobot's lines such as ``Training: 4%| | 1200/30000 [01:02<…]INFO … step:1K … loss:0.512 …``."""
ANSWER = "accerl hands over: "
"""Begins the last line of a trainer; warnings and the last exception follow, as JSON."""
LOG_EVERY = 25  # steps
MOST_WARMUP = 3  # a warm-up of the learning rate lasts at most the steps divided by this


@dataclass(frozen=True, kw_only=True)
class SFTConfig(Section, section="sft"):
    """Supervised fine-tuning before RL."""

    steps: Steps = 0
    """Optimiser steps; 0 skips this stage."""
    batch_size: Annotated[int, Range("[1, 65536]")] = 64
    """Frames per step."""
    lr: LearningRate = 1e-3
    """Peak learning rate. Where LeRobot's preset of the policy type has a schedule, it rises for as many
    steps as there, at most a third of `steps`, and then decays."""
    pick: Literal["all", "successes", "failures"] = "all"
    """Episodes that are imitated, by ``next.success``, or ``next.reward`` without it; the others stay in the
    dataset."""
    num_threads: Threads = 2
    """CPU threads of the trainer."""
    init_path: str | None = None
    """LeRobot checkpoint to start from; None starts a new policy from `policy`."""
    policy: dict[str, Any] = field(default_factory=lambda: {"type": "smolvla"})
    """Fields of LeRobot's own policy config for a new policy, ``type`` among them."""
    backbone: BackboneConfig | None = None
    """Write a random backbone of this size for the new policy instead of loading one from the Hub."""
    trust_remote_code: Commit | None = None
    """Commit of the Hub repository that the policy names:
    its Python code, which you have read, runs with your rights, and no other does."""
    extra_args: list[str] = field(default_factory=list)
    """Further ``lerobot-train`` arguments, which count more than ours, such as ``--num_workers=4``,
    ``--dataset.image_transforms.enable=true`` or ``--policy.scheduler_warmup_steps=500``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.init_path is None and "type" not in self.policy:
            raise InputError("sft.policy", self.policy, "name LeRobot's policy type, e.g. {type: smolvla}")


def sft_command(
    config: SFTConfig,
    dataset: DatasetConfig,
    output_dir: Path,
    seed: int,
    device: str,
    episodes: Sequence[int] | None = None,
) -> list[str]:
    """The ``lerobot-train`` command line of this warm start; `episodes`: see `picked`."""
    from accerl_lerobot.policies.untrusted import is_adapter  # imports torch

    start = config.init_path
    adapts = False
    if start is None:
        kind = str(config.policy["type"])
        policy = dict(config.policy)
        if config.backbone is not None:
            policy["vlm_model_name"] = str((output_dir.parent / "backbone").resolve())
            policy["load_vlm_weights"] = False
        known = policy_fields(kind, "sft.policy.type")
    else:
        stored = read_json(Path(start) / "config.json", FileSource("sft.init_path", start))
        kind = str(stored.get("type"))
        policy = {"path": start}
        adapts = is_adapter(Path(start))
        if adapts or stored.get("use_peft"):
            policy["use_peft"] = adapts
        known = policy_fields(kind, "sft.init_path")
        if "pretrained_backbone_weights" in known:
            policy["pretrained_backbone_weights"] = None  # the checkpoint's replace them; spares a download
    preset = {
        "optimizer_lr": config.lr,
        "scheduler_warmup_steps": min(known.get("scheduler_warmup_steps", 0), config.steps // MOST_WARMUP),
        "scheduler_decay_steps": config.steps,
    }
    policy = {name: value for name, value in preset.items() if name in known} | policy
    policy |= {"device": device, "push_to_hub": False}
    data = {
        "repo_id": dataset.repo_id,
        "root": local_folder(dataset),
        "revision": dataset.revision,
        "episodes": episodes,
    }
    flags = {f"policy.{name}": value for name, value in policy.items()}
    flags |= {f"dataset.{name}": value for name, value in data.items() if value is not None}
    flags |= {
        "output_dir": str(output_dir),
        "steps": config.steps,
        "batch_size": config.batch_size,
        "num_workers": 0,  # best where the dataset fits into memory, see `guarded_train`
        "seed": seed,
        "save_freq": config.steps,
        "log_freq": LOG_EVERY,
        "env_eval_freq": 0,
        "wandb.enable": False,
        "dataset.video_backend": "pyav",
    }
    if adapts:  # LeRobot writes an adapter's config.json only if a method is named; it is the adapter's own
        flags["peft.method_type"] = "LORA"
    if config.trust_remote_code is not None:
        flags["trust_remote_code"] = config.trust_remote_code
    command = [sys.executable, "-m", "accerl_lerobot.demos.guarded_train", *discovery(kind)]
    command += [f"--{name}={as_text(value)}" for name, value in flags.items()]
    return command + config.extra_args


def run_sft(
    config: SFTConfig,
    dataset: DatasetConfig,
    output_dir: Path,
    seed: int,
    device: str = "cpu",
    texts: Sequence[str] = (),
    on_step: Callable[[int, float], None] | None = None,
) -> Path:
    """Trains and returns the ``pretrained_model`` folder; the parent of `output_dir` gets ``sft.log``.

    A new backbone's tokeniser learns `texts`, the dataset's instructions. `on_step` receives step and loss as
    progress is reported.

    Raises:
        InputError: `output_dir` exists; the checkpoint to start from, or the dataset, is not to be trusted.
        RuntimeError: the trainer failed; carries its last exception and the place of its log.
    """
    check_absent(output_dir)
    output_dir.parent.mkdir(parents=True, exist_ok=True)
    if config.init_path is not None:
        config = replace(config, init_path=str(_start(config.init_path, output_dir.parent / "init")))
    elif config.backbone is not None:
        write_backbone(output_dir.parent / "backbone", texts, config.backbone)
    command = sft_command(config, dataset, output_dir, seed, device, picked(dataset, config.pick))
    logger.info("%s", shlex.join(command))
    # With Ray's token a process can run code in Ray's workers; a trainer has no business there.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    environment |= {
        "OMP_NUM_THREADS": str(config.num_threads),
        "OMP_WAIT_POLICY": "PASSIVE",
        "TOKENIZERS_PARALLELISM": "false",
    }
    log = output_dir.parent / "sft.log"
    with (
        log.open("w") as file,
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            errors="replace",
        ) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                file.write(line)
                progress = PROGRESS.search(line)
                if progress is not None and on_step is not None:
                    on_step(_step(progress), float(progress["loss"]))
        except BaseException:
            process.terminate()  # nobody reads on: it must not train alone
            raise
    _check_end(process.returncode, log)
    return output_dir / CHECKPOINTS / LAST / PRETRAINED


def _start(path: str, copy: Path) -> Path:
    """The checkpoint to start from: a copy if its backbone is no longer at the place that its files name."""
    from accerl_lerobot.policies.untrusted import fetched_checkpoint  # imports torch

    start = fetched_checkpoint(path, None, "sft.init_path")
    if not displaced(start):
        return start
    shutil.rmtree(copy, ignore_errors=True)  # of an SFT that was stopped
    shutil.copytree(start, copy)
    relocate(copy, copy)
    return copy


def _check_end(code: int, log: Path) -> None:
    """Show a trainer's warnings, and raise its last exception if it failed."""
    text, found, rest = log.read_text().rpartition(ANSWER)
    answer: dict[str, Any] = {}
    if found:
        line, _, after = rest.partition("\n")
        answer = json.loads(line)
        rest = text + after
    errors.show_warnings(answer.get("warnings", ()))
    if code == 0:
        return
    errors.raise_refusal(answer)
    reason = answer.get("error") or last_exception(rest)
    if code < 0:
        reason = f"was ended by {signal.Signals(-code).name}"
    raise RuntimeError(f"lerobot-train failed, see {log}: {reason}")


def picked(dataset: DatasetConfig, pick: str) -> list[int] | None:
    """Indices of the episodes that ``sft.pick`` names; None: all.

    Raises:
        InputError: there is no such episode, or they are not labelled.
    """
    if pick == "all":
        return None
    meta = open_metadata(dataset)
    if not {SUCCESS, REWARD} & set(meta.features):
        hint = f"the dataset's episodes are not labelled by {SUCCESS} or {REWARD}; use all"
        raise InputError("sft.pick", pick, hint)
    with opened(dataset, meta) as data:
        labels = read_labels(data, dataset, one_task=False)
    wanted = [episode.index for episode in labels if episode.success is (pick == "successes")]
    if not wanted:
        raise InputError("sft.pick", pick, f"none of the dataset's {meta.total_episodes} episodes; use all")
    return wanted


def policy_fields(kind: str, field: str) -> dict[str, Any]:
    """Fields of LeRobot's config of a policy type, with their defaults; an unknown type is refused."""
    from lerobot.configs.policies import PreTrainedConfig

    register_policies(kind)
    check_registered(kind, field)
    return {own.name: own.default for own in fields(PreTrainedConfig.get_choice_class(kind))}


def _step(progress: re.Match[str]) -> int:
    """The step of a line of progress.

    From 1000 on it is the bar's, which may be a moment old, or without a bar (under Slurm) a rounded number.
    """
    scale = {"": 1, "K": 1_000, "M": 1_000_000}[progress["suffix"]]
    if scale > 1 and progress["bar"]:
        return int(progress["bar"])
    return int(float(progress["step"]) * scale)
