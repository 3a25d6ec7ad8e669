# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A LeRobot checkpoint in, a stochastic policy out, and back into LeRobot's own format.

Everything is LeRobot's: config, weights and processors load through `from_pretrained` and are saved with
`save_pretrained`, so stock `lerobot-eval` runs what we write. What is ours lies in ``accerl.json`` and
``value_head.safetensors`` beside it.
"""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.checkpoint import BACKBONE
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.base import PolicyAdapter
from accerl_lerobot.policies.flow import FlowSamplerConfig
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.policies.value_head import ValueHeadConfig

logger = logging.getLogger(__name__)

OURS = "accerl.json"
VALUE_HEAD = "value_head.safetensors"
ADAPTERS = {"smolvla": "accerl_lerobot.policies.smolvla:SmolVLAAdapter"}
"""LeRobot policy type → adapter class. A further policy of a known family is one line."""

NO_DENSITY = {
    "tdmpc": "it plans by sampling and has no action density; LeRobot trains it with its own RL objective",
    "vqbet": "LeRobot does not return its code log-probs; use smolvla",
}


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Which policy is improved, and how it explores."""

    path: str | None = None
    """Local checkpoint directory or Hub id (``lerobot/smolvla_base``). None: the run's own SFT makes it."""
    revision: str | None = None
    """Hub revision."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    sampler: FlowSamplerConfig = field(default_factory=FlowSamplerConfig)
    value_head: ValueHeadConfig = field(default_factory=ValueHeadConfig)
    rename_map: dict[str, str] = field(default_factory=dict)
    """World feature name → policy feature name, as in LeRobot's ``--rename_map``."""
    num_steps: int | None = None
    """Denoising steps; None keeps the checkpoint's. Written into what is saved."""
    n_action_steps: int | None = None
    """Rows of a chunk that are executed before the next decision; None keeps the checkpoint's."""


def resolve_device(name: str) -> torch.device:
    """``auto`` is CUDA when there is one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("policy.device", name, "no CUDA device here; use cpu or auto")
    return torch.device(name)


def load_lerobot_config(config: PolicyConfig) -> Any:
    """The checkpoint's LeRobot policy config, without its weights.

    Raises:
        InputError: no checkpoint there, or a policy type without a likelihood here.
    """
    import lerobot.policies  # noqa: F401  fills the registry of policy types
    from lerobot.configs.policies import PreTrainedConfig

    if config.path is None:
        raise InputError(
            "policy.path", None, "give a LeRobot checkpoint directory or Hub id, or an sft section"
        )
    local = Path(config.path).expanduser()
    if (local.exists() or config.path.startswith((".", "/", "~"))) and not (local / "config.json").is_file():
        raise InputError(
            "policy.path", config.path, "no config.json there; give the folder named pretrained_model"
        )
    try:
        lerobot_config = PreTrainedConfig.from_pretrained(config.path, revision=config.revision)
    except (OSError, FileNotFoundError) as error:
        raise InputError(
            "policy.path", config.path, f"not a directory here and not loadable from the Hub ({error})"
        ) from error
    name = lerobot_config.type
    if name not in ADAPTERS:
        why = NO_DENSITY.get(name, f"no likelihood for it yet; use one of {', '.join(ADAPTERS)}")
        raise InputError("policy.type", name, why)
    lerobot_config.device = str(resolve_device(config.device))
    if config.num_steps is not None:
        lerobot_config.num_steps = config.num_steps
    if config.n_action_steps is not None:
        if not 1 <= config.n_action_steps <= lerobot_config.chunk_size:
            remedy = f"use 1 to {lerobot_config.chunk_size}, the chunk the policy predicts"
            raise InputError("policy.n_action_steps", config.n_action_steps, remedy)
        lerobot_config.n_action_steps = config.n_action_steps
    backbone = local / BACKBONE
    if backbone.is_dir():
        lerobot_config.vlm_model_name = str(backbone.resolve())
    return lerobot_config


def load_adapter(config: PolicyConfig) -> PolicyAdapter:
    """Loads policy, processors and critic, and proves that the weights are those of the file.

    Raises:
        InputError: see `load_lerobot_config`; or weights that did not load.
    """
    import importlib

    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    lerobot_config = load_lerobot_config(config)
    path = str(config.path)
    policy = get_policy_class(lerobot_config.type).from_pretrained(
        path, config=lerobot_config, revision=config.revision
    )
    _verify_weights(policy, path, config.revision)
    device = torch.device(lerobot_config.device)
    overrides: dict[str, Any] = {"device_processor": {"device": str(device)}}
    if (Path(path) / BACKBONE).is_dir():
        overrides["tokenizer_processor"] = {"tokenizer_name": lerobot_config.vlm_model_name}
    pre, post = make_pre_post_processors(
        lerobot_config,
        pretrained_path=path,
        pretrained_revision=config.revision,
        preprocessor_overrides=overrides,
    )
    module, _, name = ADAPTERS[lerobot_config.type].partition(":")
    adapter_class = getattr(importlib.import_module(module), name)
    processing = Processing(pre, post, device, config.rename_map)
    adapter: PolicyAdapter = adapter_class(policy, processing, config.sampler, config.value_head)
    value_file = Path(path) / VALUE_HEAD
    if value_file.is_file():
        _load_value_head(adapter, value_file, config)
    return adapter


def save_pretrained(adapter: PolicyAdapter, directory: Path, config: PolicyConfig) -> None:
    """Writes LeRobot's ``pretrained_model`` layout plus our sampler options and critic into `directory`."""
    directory.mkdir(parents=True, exist_ok=True)
    lerobot_config = adapter.policy.config
    source = Path(getattr(lerobot_config, "vlm_model_name", ""))
    pre, post = adapter.processing.preprocessor, adapter.processing.postprocessor
    if source.is_dir() and source.is_absolute():
        target = directory / BACKBONE
        if source.resolve() != target.resolve():
            shutil.copytree(source, target, dirs_exist_ok=True)
    adapter.policy.save_pretrained(directory)
    pre.save_pretrained(directory)
    post.save_pretrained(directory)
    critic = {k: v.detach().cpu().contiguous() for k, v in adapter.value_head.state_dict().items()}
    save_file(critic, directory / VALUE_HEAD)
    ours = {
        "sampler": asdict(config.sampler),
        "value_head": asdict(config.value_head),
        "rename_map": config.rename_map,
    }
    (directory / OURS).write_text(json.dumps(ours, indent=2) + "\n")


def _verify_weights(policy: Any, path: str, revision: str | None) -> None:
    """LeRobot loads non-strictly and some policies swallow load errors: compare every tensor with the file."""
    file = Path(path) / "model.safetensors"
    if not file.is_file():
        from huggingface_hub import hf_hub_download

        file = Path(hf_hub_download(path, "model.safetensors", revision=revision))
    stored, loaded = load_file(file), policy.state_dict()
    tied = {
        k for k in loaded if k.endswith("lm_head.weight")
    }  # tied to the embedding, which safetensors keeps once
    missing = sorted(k for k in loaded.keys() - stored.keys() - tied)
    unexpected = sorted(stored.keys() - loaded.keys())
    if missing or unexpected:
        detail = (
            f"{len(missing)} tensors missing ({missing[:2]}), {len(unexpected)} unexpected ({unexpected[:2]})"
        )
        raise InputError(
            "policy.path",
            path,
            f"the weights did not load: {detail}; config.json and model.safetensors disagree",
        )
    for name, tensor in stored.items():
        mine = loaded[name]
        if mine.shape != tensor.shape or not torch.equal(mine.cpu(), tensor.to(mine.dtype)):
            raise InputError("policy.path", path, f"the weights did not load: {name} differs from the file")


def _load_value_head(adapter: PolicyAdapter, file: Path, config: PolicyConfig) -> None:
    ours = json.loads((file.parent / OURS).read_text())
    if ours["value_head"] != asdict(config.value_head):
        logger.warning(
            "critic not loaded: value_head is %s in the checkpoint, %s here",
            ours["value_head"],
            config.value_head,
        )
        return
    adapter.value_head.load_state_dict(load_file(file))
