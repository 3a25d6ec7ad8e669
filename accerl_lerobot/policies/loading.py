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

import importlib
import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.checkpoint import BACKBONE, relocate
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.base import OBS_STATE, PolicyAdapter
from accerl_lerobot.policies.flow import FlowSamplerConfig
from accerl_lerobot.policies.processing import IMAGES, Processing
from accerl_lerobot.policies.value_head import ValueHeadConfig

logger = logging.getLogger(__name__)

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
OURS = "accerl.json"
VALUE_HEAD = "value_head.safetensors"
FILES = ("*.json", WEIGHTS, "policy_*.safetensors", VALUE_HEAD, f"{BACKBONE}/*")
"""What is fetched of a checkpoint on the Hub."""
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

    def __post_init__(self) -> None:
        for name in ("num_steps", "n_action_steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"policy.{name}", value, "use at least 1, or null to keep the checkpoint's")


def resolve_device(name: str) -> torch.device:
    """``auto`` is CUDA when there is one.

    Raises:
        InputError: no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("policy.device", name, "no CUDA device here; use cpu or auto")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError("policy.device", name, "use cpu, cuda or auto") from error


def load_lerobot_config(config: PolicyConfig) -> Any:
    """The checkpoint's LeRobot policy config, without its weights.

    Raises:
        InputError: no checkpoint there, or a policy type without a likelihood here.
    """
    import draccus
    import lerobot.policies  # noqa: F401  fills the registry of policy types
    from lerobot.configs.policies import PreTrainedConfig

    folder = _checkpoint_folder(config)
    try:
        name = json.loads((folder / CONFIG).read_text()).get("type")
        if name not in ADAPTERS:
            why = NO_DENSITY.get(name, f"no likelihood for it yet; use one of {', '.join(ADAPTERS)}")
            raise InputError("policy.type", name, f"{config.path} is of this type: {why}")
        lerobot_config = PreTrainedConfig.from_pretrained(folder)
    except InputError:
        raise
    except (OSError, ValueError, AttributeError, draccus.utils.DraccusException) as error:
        remedy = f"its config.json is not one of this LeRobot's policies ({_brief(error)})"
        raise InputError("policy.path", config.path, remedy) from error
    lerobot_config.device = str(resolve_device(config.device))
    if config.num_steps is not None:
        lerobot_config.num_steps = config.num_steps
    if config.n_action_steps is not None:
        if config.n_action_steps > lerobot_config.chunk_size:
            remedy = f"use 1 to {lerobot_config.chunk_size}, the chunk the policy predicts"
            raise InputError("policy.n_action_steps", config.n_action_steps, remedy)
        lerobot_config.n_action_steps = config.n_action_steps
    if (folder / BACKBONE).is_dir():
        lerobot_config.vlm_model_name = str((folder / BACKBONE).resolve())
    backbone = Path(lerobot_config.vlm_model_name)
    if backbone.is_absolute() and not backbone.is_dir():
        remedy = (
            f"its backbone was in {backbone}, which is gone; put a copy into {BACKBONE}/ beside config.json"
        )
        raise InputError("policy.path", config.path, remedy)
    return lerobot_config


def load_adapter(config: PolicyConfig) -> PolicyAdapter:
    """Loads policy, processors and critic; proves that the weights are the file's and the sampler LeRobot's.

    Raises:
        InputError: see `load_lerobot_config`; or weights or processors that did not load.
        RuntimeError: the installed LeRobot samples differently, see `PolicyAdapter.self_check`.
    """
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    lerobot_config = load_lerobot_config(config)
    folder = _checkpoint_folder(config)
    try:
        policy = get_policy_class(lerobot_config.type).from_pretrained(folder, config=lerobot_config)
    except Exception as error:
        raise InputError("policy.path", config.path, f"the weights did not load ({_brief(error)})") from error
    _verify_weights(policy, folder, config)
    device = torch.device(lerobot_config.device)
    overrides: dict[str, Any] = {"device_processor": {"device": str(device)}}
    if (folder / BACKBONE).is_dir():
        overrides["tokenizer_processor"] = {"tokenizer_name": lerobot_config.vlm_model_name}
    try:
        pre, post = make_pre_post_processors(
            lerobot_config, pretrained_path=str(folder), preprocessor_overrides=overrides
        )
    except Exception as error:
        raise InputError(
            "policy.path", config.path, f"its LeRobot processors did not load ({_brief(error)})"
        ) from error
    module, _, name = ADAPTERS[lerobot_config.type].partition(":")
    adapter_class = getattr(importlib.import_module(module), name)
    processing = Processing(pre, post, device, config.rename_map)
    adapter: PolicyAdapter = adapter_class(policy, processing, config.sampler, config.value_head)
    if (folder / OURS).is_file():
        _load_ours(adapter, folder, config)
    adapter.self_check(*example_observations(lerobot_config, config.rename_map))
    return adapter


def save_pretrained(adapter: PolicyAdapter, directory: Path, config: PolicyConfig) -> None:
    """Writes LeRobot's ``pretrained_model`` layout plus our sampler options and critic into `directory`."""
    directory.mkdir(parents=True, exist_ok=True)
    lerobot_config = adapter.policy.config
    source = Path(lerobot_config.vlm_model_name)
    if source.is_absolute() and source.resolve() != (directory / BACKBONE).resolve():
        # The policy's own file holds the backbone's weights, unless LeRobot builds it from the backbone's.
        weights = () if lerobot_config.load_vlm_weights else ("*.safetensors", "*.bin", "*.pt", "*.pth")
        ignore = shutil.ignore_patterns(*weights)
        shutil.copytree(source, directory / BACKBONE, ignore=ignore, dirs_exist_ok=True)
    adapter.policy.save_pretrained(directory)
    adapter.processing.preprocessor.save_pretrained(directory)
    adapter.processing.postprocessor.save_pretrained(directory)
    relocate(directory, directory)
    critic = {k: v.detach().cpu().contiguous() for k, v in adapter.value_head.state_dict().items()}
    save_file(critic, directory / VALUE_HEAD)
    ours = {
        "sampler": asdict(config.sampler),
        "value_head": asdict(config.value_head),
        "rename_map": config.rename_map,
    }
    (directory / OURS).write_text(json.dumps(ours, indent=2) + "\n")


def example_observations(
    policy_config: Any, rename_map: dict[str, str]
) -> tuple[dict[str, np.ndarray], Sequence[str]]:
    """Two random observations as a world would give them to this policy, and instructions of unequal length.

    Args:
        policy_config: LeRobot's; names and sizes the inputs.
        rename_map: world feature name → policy feature name.
    """
    rng = np.random.default_rng(0)
    world_name = {policy: world for world, policy in rename_map.items()}
    observations: dict[str, np.ndarray] = {}
    for key, feature in policy_config.input_features.items():
        shape = tuple(feature.shape)
        if key.startswith(IMAGES) and ".empty_camera_" not in key:
            size = (2, *shape[1:], shape[0])
            observations[world_name.get(key, key)] = rng.integers(0, 256, size, dtype=np.uint8)
        elif key == OBS_STATE:
            observations[world_name.get(key, key)] = rng.standard_normal((2, *shape), dtype=np.float32)
    return observations, ("Go", "Put the red cube on the plate")


def _checkpoint_folder(config: PolicyConfig) -> Path:
    """Where the checkpoint's files are on this machine; those of a Hub repository are fetched."""
    from huggingface_hub import snapshot_download

    if config.path is None:
        remedy = "give a LeRobot checkpoint directory or Hub id, or an sft section"
        raise InputError("policy.path", None, remedy)
    folder = Path(config.path).expanduser()
    if not folder.exists() and not config.path.startswith((".", "/", "~")):
        try:
            folder = Path(
                snapshot_download(config.path, revision=config.revision, allow_patterns=list(FILES))
            )
        except (OSError, ValueError) as error:
            remedy = f"not a directory here and not loadable from the Hub ({_brief(error)})"
            raise InputError("policy.path", config.path, remedy) from error
    if not (folder / CONFIG).is_file():
        raise InputError(
            "policy.path", config.path, "no config.json there; give the folder named pretrained_model"
        )
    return folder


def _verify_weights(policy: Any, folder: Path, config: PolicyConfig) -> None:
    """Compares all tensors with the file: LeRobot loads non-strictly, some policies swallow load errors."""
    stored, loaded = load_file(folder / WEIGHTS), policy.state_dict()
    # No action is computed with the language model's output layer, and savers drop it where it is tied.
    missing = sorted(
        k for k in loaded.keys() - stored.keys() if not k.endswith("vlm_with_expert.vlm.lm_head.weight")
    )
    unexpected = sorted(stored.keys() - loaded.keys())
    if missing or unexpected:
        counts = (
            f"{len(missing)} tensors missing {missing[:2]}, {len(unexpected)} unexpected {unexpected[:2]}"
        )
        remedy = f"the weights did not load: {counts}; {CONFIG} and {WEIGHTS} disagree"
        raise InputError("policy.path", config.path, remedy)
    for name, tensor in stored.items():
        mine = loaded[name].cpu()
        if mine.shape != tensor.shape or not torch.equal(mine, tensor.to(mine.dtype)):
            remedy = f"the weights did not load: {name} differs from the file, or holds a NaN"
            raise InputError("policy.path", config.path, remedy)


def _load_ours(adapter: PolicyAdapter, folder: Path, config: PolicyConfig) -> None:
    """Loads the critic, and says where this run's options differ from those the checkpoint was made with."""
    ours = json.loads((folder / OURS).read_text())
    there, here = ours.get("sampler", {}), asdict(config.sampler)
    differing = [k for k in here if k in there and there[k] != here[k]]
    if differing:
        logger.warning(
            "this run explores unlike the one that made the checkpoint (evaluation is not affected): %s",
            ", ".join(f"policy.sampler.{k}={here[k]}, there {there[k]}" for k in differing),
        )
    there, here = ours.get("value_head", {}), asdict(config.value_head)
    differing = [k for k in ("pooling", "hidden") if there.get(k) != here[k]]
    if differing:
        logger.warning(
            "the checkpoint's critic is not loaded, a new one starts at V = 0: %s",
            ", ".join(f"policy.value_head.{k}={here[k]}, there {there.get(k)}" for k in differing),
        )
    elif (folder / VALUE_HEAD).is_file():
        adapter.value_head.load_state_dict(load_file(folder / VALUE_HEAD))


def _brief(error: BaseException) -> str:
    """The error's words on one line, not more than a line's worth."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else text[:159] + "…"
