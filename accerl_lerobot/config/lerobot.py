# SPDX-License-Identifier: Apache-2.0
"""Flags of ``lerobot-train`` and ``lerobot-eval`` that people type here, and what stands for each."""

from __future__ import annotations

import json
import shlex
from collections.abc import Set
from typing import Any

TRAINER = "lerobot-train"  # in `FLAGS`: the flag itself, handed on by `EXTRA`
EXTRA = "sft.extra_args"
NEW_POLICY = "sft.policy"  # in `FLAGS`: the same field of the policy that SFT begins with
PUSH = "leave it out, and use accerl push --path=POLICY --repo_id=USER/NAME afterwards"
TRAINER_ONLY = (
    "dataset.repo_id", "dataset.root", "dataset.revision", "dataset.repo_type", "dataset.episodes",
    "dataset.image_transforms", "dataset.use_imagenet_stats", "dataset.video_backend", "dataset.streaming",
    "dataset.return_uint8", "dataset.depth_output_unit", "dataset.eval_split", "wandb.enable",
    "wandb.project", "optimizer", "scheduler", "sample_weighting", "log_freq", "eval_steps", "tolerance_s",
    "max_eval_samples", "cudnn_deterministic", "prefetch_factor", "persistent_workers", "save_checkpoint",
    "dataloader_multiprocessing_context", "use_policy_training_preset",
)  # fmt: skip
FLAGS: dict[str, tuple[str, ...] | str] = {
    "steps": ("trainer.updates", "sft.steps"),
    "batch_size": ("trainer.batch_decisions", "sft.batch_size"),
    "num_workers": ("rollout.workers", TRAINER),
    "save_freq": ("save_every_updates", TRAINER),
    "eval_freq": ("evaluation.every_updates",),
    "env_eval_freq": ("evaluation.every_updates",),
    "eval.n_episodes": ("evaluation.episodes",),
    "eval.batch_size": ("rollout.environments",),
    "eval": "leave it out, the section evaluation says how it is done here",
    "rename_map": ("policy.rename_map",),
    "optimizer.lr": ("trainer.lr", "sft.lr"),
    "policy": (NEW_POLICY,),
    "policy.n_obs_steps": (NEW_POLICY,),
    "policy.type": ("policy.path", NEW_POLICY),
    "policy.pretrained_path": ("policy.path", "sft.init_path"),
    "policy.pretrained_revision": ("policy.revision",),
    "policy.device": ("device",),
    "policy.use_amp": ("policy.precision=bf16",),
    "policy.use_peft": ("policy.tuning.mode=lora",),
    "peft.r": ("policy.tuning.rank",),
    "peft.target_modules": ("policy.tuning.targets",),
    "peft": ("policy.tuning.mode=lora",),
    "policy.push_to_hub": PUSH,
    "policy.repo_id": PUSH,
    "policy.private": PUSH,
    "policy.tags": PUSH,
    "policy.license": PUSH,
    "save_checkpoint_to_hub": PUSH,
    "wandb.entity": ("$WANDB_ENTITY",),
    "wandb.mode": ("$WANDB_MODE",),
    "wandb.notes": ("$WANDB_NOTES",),
    "wandb.run_id": "leave it out, a resumed run keeps its own",
    "wandb.disable_artifact": "leave it out, no artifact is uploaded",
    "wandb.add_tags": "leave it out, no tag is set",
    "job": "leave it out, a run is of this machine or of the Ray cluster of launch.address",
    "job_name": "leave it out, output_dir names the folder",
    "resume": "leave it out, only accerl train resumes",
    "reward_model": ("rollout.reward_model.path",),
    "checkpoint_path": "leave it out, and resume with --resume=true --config_path=RUN/config.yaml",
    "trust_remote_code": ("policy.trust_remote_code", "sft.trust_remote_code"),
    **dict.fromkeys(TRAINER_ONLY, (TRAINER,)),
}  # fmt: skip
"""LeRobot's name, or the section that it begins with → fields of ours, the first with a value of its own;
``$NAME`` is a variable of the environment. A text says what to do where there is no such field."""


def hint_for(name: str, value: Any, fields: Set[str]) -> str | None:
    """Words on what to type in place of a flag of LeRobot's for a command of these fields; None: no flag."""
    parts = name.split(".")
    known = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    found = next((FLAGS[flag] for flag in known if flag in FLAGS), None)
    if found is None or isinstance(found, str):
        return found
    text = value if isinstance(value, str) else json.dumps(value)
    names, others = [], []
    for one in found:
        field, fixed, _ = one.partition("=")
        if one == TRAINER:
            argument = shlex.quote(f"--{EXTRA}={json.dumps([f'--{name}={text}'])}")
            others += [f"hand it to lerobot-train: {argument}"] if EXTRA in fields else []
        elif one.startswith("$"):
            others.append(f"set {shlex.quote(f'{one[1:]}={text}')} in the environment")
        elif field in fields and not (fixed and value is False):  # what is off there is off here
            names.append(f"sft.{name}" if one == NEW_POLICY else one)
    ways = ([f"use {' or '.join(names)}"] if names else []) + others
    return " or ".join(ways) or "leave it out, there is nothing like it here"
