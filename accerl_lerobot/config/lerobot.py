# SPDX-License-Identifier: Apache-2.0
"""Flags of ``lerobot-train`` and ``lerobot-eval`` that people type here, and what stands for each."""

from __future__ import annotations

import json
import shlex
from collections.abc import Set
from typing import Any

EXTRA = "sft.extra_args"
PUSH = "leave it out, and use accerl push --path=POLICY --repo_id=USER/NAME afterwards"
HANDED_ON = (
    "dataset.repo_id", "dataset.root", "dataset.revision", "dataset.repo_type", "dataset.episodes",
    "dataset.image_transforms", "dataset.use_imagenet_stats", "dataset.video_backend", "dataset.streaming",
    "dataset.return_uint8", "dataset.depth_output_unit", "dataset.eval_split", "wandb.enable",
    "wandb.project", "optimizer", "scheduler", "sample_weighting", "log_freq", "eval_steps", "tolerance_s",
    "max_eval_samples", "cudnn_deterministic", "prefetch_factor", "persistent_workers", "save_checkpoint",
    "dataloader_multiprocessing_context", "use_policy_training_preset",
)  # fmt: skip
"""Flags that `EXTRA` hands to ``lerobot-train``."""
PUSHED = (
    "policy.push_to_hub", "policy.repo_id", "policy.private", "policy.tags", "policy.license",
    "save_checkpoint_to_hub",
)  # fmt: skip
FLAGS: dict[str, str] = {
    **dict.fromkeys(HANDED_ON, ""),
    **dict.fromkeys(PUSHED, PUSH),
    "steps": "trainer.updates sft.steps",
    "batch_size": "trainer.batch_decisions sft.batch_size",
    "num_workers": "rollout.workers",
    "save_freq": "save_every_updates",
    "eval_freq": "evaluation.every_updates",
    "env_eval_freq": "evaluation.every_updates",
    "eval.n_episodes": "evaluation.episodes",
    "eval.batch_size": "rollout.environments",
    "eval": "leave it out, the section evaluation says how it is done here",
    "rename_map": "policy.rename_map",
    "optimizer.lr": "trainer.lr sft.lr",
    "policy": "sft.policy",
    "policy.type": "policy.path sft.policy",
    "policy.pretrained_path": "policy.path sft.init_path",
    "policy.pretrained_revision": "policy.revision",
    "policy.device": "device",
    "policy.use_amp": "policy.precision=bf16",
    "policy.use_peft": "policy.tuning.mode=lora",
    "peft": "policy.tuning.mode=lora",
    "peft.r": "policy.tuning.rank",
    "peft.target_modules": "policy.tuning.targets",
    "wandb.entity": "leave it out, and set WANDB_ENTITY in the environment",
    "wandb.mode": "leave it out, and set WANDB_MODE in the environment",
    "wandb.notes": "leave it out, and set WANDB_NOTES in the environment",
    "wandb.run_id": "leave it out, a resumed run keeps its own",
    "wandb.disable_artifact": "leave it out, no artifact is uploaded",
    "wandb.add_tags": "leave it out, no tag is set",
    "job": "leave it out, a run is of this machine or of the Ray cluster of launch.address",
    "job_name": "leave it out, output_dir names the folder",
    "resume": "leave it out, only accerl train resumes",
    "reward_model": "rollout.reward_model.path",
    "checkpoint_path": "leave it out, and resume with --resume=true --config_path=RUN/config.yaml",
    "trust_remote_code": "policy.trust_remote_code sft.trust_remote_code",
}
"""LeRobot's name, or the section that it begins with → fields of ours, or a sentence where there is none. No
field: the flag is one of `HANDED_ON`."""


def hint_for(name: str, value: Any, fields: Set[str]) -> str | None:
    """Words on what to type in place of a flag of LeRobot's for a command of these fields; None: no flag."""
    parts = name.split(".")
    known = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    text = next((FLAGS[flag] for flag in known if flag in FLAGS), None)
    if text is None or text.startswith("leave"):
        return text
    named = []
    for place in text.split():
        field, _, fixed = place.partition("=")
        if field in fields and not (fixed and value is False):  # what is off there is off here
            named.append(f"sft.{name}" if place == "sft.policy" else place)
    if named:
        return f"use {' or '.join(named)}"
    if EXTRA not in fields:
        return "leave it out, there is nothing like it here"
    plain = value if isinstance(value, str) else json.dumps(value)
    argument = f"--{EXTRA}={json.dumps([f'--{name}={plain}'])}"
    return f"hand it to lerobot-train: {shlex.quote(argument)}"
