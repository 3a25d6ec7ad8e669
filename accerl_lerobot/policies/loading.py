# SPDX-License-Identifier: Apache-2.0
"""A LeRobot checkpoint in, a stochastic policy out, and back into LeRobot's own format.

Config and processors load through LeRobot's `from_pretrained`, weights by `verify.load_weights`. All is saved
with `save_pretrained`, so stock `lerobot-eval` runs what we write. What is ours lies in ``accerl.json`` and
``value_head.safetensors`` beside it.
"""

from __future__ import annotations

import json
import logging
import string
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import draccus
import torch
from safetensors.torch import save_file
from torch import Tensor

from accerl_lerobot.checkpoint.isolation import rehearse
from accerl_lerobot.checkpoint.layout import BACKBONE, relocate
from accerl_lerobot.checkpoint.safety import Origin, brief, read_tensors
from accerl_lerobot.checkpoint.tensors import place, whole
from accerl_lerobot.config.imports import imported
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.family import Model
from accerl_lerobot.policies.files import (
    CONFIG,
    FAMILY,
    OURS,
    VALUE_HEAD,
    WEIGHTS,
    check_statistics,
    fetched_checkpoint,
)
from accerl_lerobot.policies.guard import Unfilled, guarded, input_error
from accerl_lerobot.policies.plugins import register_policies
from accerl_lerobot.policies.portable import keep_names, save_backbone, tokenizer_overrides, use_backbone
from accerl_lerobot.policies.processing import Processing, example_observations, example_requests
from accerl_lerobot.policies.samplers import SamplerConfig
from accerl_lerobot.policies.tuning import merged_state_dict, tune
from accerl_lerobot.policies.value_head import ValueHead
from accerl_lerobot.policies.verify import load_weights

logger = logging.getLogger(__name__)

MODELS = "accerl_lerobot.policies.models"
POLICIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "smolvla": (f"{MODELS}.smolvla:SmolVLA", ("flow", "noise_space")),
    "act": (f"{MODELS}.act:ACT", ("gaussian",)),
    "gaussian_actor": (f"{MODELS}.gaussian_actor:GaussianActor", ("gaussian",)),
    "diffusion": (f"{MODELS}.diffusion:Diffusion", ("diffusion",)),
    "pi0": (f"{MODELS}.pi0:Pi0", ("flow", "noise_space")),
    "pi05": (f"{MODELS}.pi0:Pi05", ("flow", "noise_space")),
    "pi0_fast": (f"{MODELS}.pi0_fast:Pi0Fast", ("tokens",)),
    "smolvla_bins": (f"{MODELS}.smolvla_bins:SmolVLABins", ("tokens",)),
}
"""LeRobot policy type → its model, and the families that suit it, the default one first."""
FAMILIES = {
    "flow": "accerl_lerobot.policies.flow:FlowFamily",
    "noise_space": "accerl_lerobot.policies.noise_space:NoiseSpaceFamily",
    "gaussian": "accerl_lerobot.policies.gaussian:GaussianFamily",
    "diffusion": "accerl_lerobot.policies.diffusion:DiffusionFamily",
    "tokens": "accerl_lerobot.policies.tokens:TokenFamily",
}
"""Family → class; its config is registered under the same name in `samplers`."""

ACTS_MOST = 10**9
"""Parameters of a policy that acts when its load is rehearsed; π0's four billion would take minutes."""
TEXT = f"Put the red cube on the plate {string.printable}"
"""Instruction of that decision: a tokeniser can be slow on some characters only."""


class Sizes(NamedTuple):
    """Numbers of a policy, and those of them that a run trains, the critic's included."""

    policy: int
    trained: int


_rehearsed: dict[str, Sizes] = {}
"""Checkpoints, and what was asked of them, that need no other rehearsal in this process."""

LOOK_BACK = ("diffusion",)
"""Types that read the observations of ``n_obs_steps`` env steps; the others read one."""
NO_DENSITY = {
    "tdmpc": "it plans by sampling and has no action density; LeRobot trains it with its own RL objective",
    "vqbet": "LeRobot does not return its code log-probs; use smolvla",
}


def resolve_device(name: str, field: str = "policy.device") -> torch.device:
    """``auto`` is CUDA when there is one.

    Raises:
        InputError: no such device; the error names `field`.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise InputError(field, name, "use cpu, cuda or auto")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(field, name, "no CUDA device here; use cpu or auto")
    count = torch.cuda.device_count() if device.type == "cuda" else 1
    if (device.index or 0) >= count:
        raise InputError(field, name, f"there are {count} such devices here, numbered from 0")
    return device


def no_tf32(device: torch.device) -> None:
    """Makes fp32 mean fp32 on a GPU, where torch convolves with 10 bits of mantissa unless told otherwise.

    Acting and learning see the same observation in batches of different sizes, for which cuDNN chooses other
    algorithms; what they round differently is divided by the std of the noise in every log-prob.
    """
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cuda.matmul.allow_tf32 = False


def check_type(policy_type: Any, field: str, prefix: str = "") -> str:
    """Refuses a LeRobot policy type that has no likelihood here; `prefix` begins the remedy.

    Raises:
        InputError: it has none.
    """
    if policy_type not in POLICIES:
        why = NO_DENSITY.get(policy_type, f"no likelihood for it here; use one of {', '.join(POLICIES)}")
        raise InputError(field, policy_type, prefix + why)
    return str(policy_type)


def check_observations(policy_config: Any, field: str) -> None:
    """Refuses a history that LeRobot's policy of this type does not read.

    Raises:
        InputError: it is to look back and cannot.
    """
    if policy_config.n_obs_steps != 1 and policy_config.type not in LOOK_BACK:
        remedy = f"only {', '.join(LOOK_BACK)} looks back; a {policy_config.type} policy takes 1"
        raise InputError(field, policy_config.n_obs_steps, remedy)


def sampler_config(config: PolicyConfig, policy_type: str) -> SamplerConfig:
    """How a policy of this type explores in this run.

    Raises:
        InputError: the sampler asked for is of a family that does not suit it.
    """
    families = POLICIES[policy_type][1]
    if config.sampler is None:
        default: SamplerConfig = SamplerConfig.get_choice_class(families[0])()
        return default
    if config.sampler.type not in families:
        remedy = f"a {policy_type} policy explores by {' or '.join(families)}"
        raise InputError("policy.sampler.type", config.sampler.type, remedy)
    return config.sampler


def load_lerobot_config(config: PolicyConfig) -> Any:
    """The checkpoint's LeRobot policy config, without its weights.

    Raises:
        InputError: no checkpoint there, or a policy type without a likelihood here.
    """
    from lerobot.configs.policies import PreTrainedConfig

    register_policies()
    folder = _checkpoint_folder(config)
    try:
        name = json.loads((folder / CONFIG).read_text()).get("type")
        kind = check_type(name, "policy.type", f"{config.path} is of this type: ")
        sampler = sampler_config(config, kind)
        lerobot_config = PreTrainedConfig.from_pretrained(folder)
    except InputError:
        raise
    except Exception as error:  # LeRobot takes the file at its word, and may fail over any of it
        remedy = f"its config.json is not one of this LeRobot's policies ({brief(error)})"
        raise InputError("policy.path", config.path, remedy) from error
    lerobot_config.device = str(resolve_device(config.device))
    override(lerobot_config, config)
    sampler.override(lerobot_config)
    check_observations(lerobot_config, "policy.n_obs_steps")
    use_backbone(lerobot_config, folder, config.path)
    return lerobot_config


def rehearsed_config(config: PolicyConfig) -> Any:
    """`load_lerobot_config` of a checkpoint that has been loaded and has acted once in a child process.

    The child has limits of memory and time (`isolation`), and it does not read the weights. Networks of more
    than `ACTS_MOST` numbers are built and do not act.

    Raises:
        InputError: see `load_lerobot_config`, `load_adapter` and `isolation.rehearse`.
    """
    register_policies()  # before the fork: it imports all of LeRobot's policies
    folder = _checkpoint_folder(config)
    key = _key(config, folder)
    if key not in _rehearsed:
        there = replace(config, device="cpu", precision="fp32")
        found = rehearse(lambda: _sizes(there), folder, Origin("policy.path", config.path))
        _rehearsed[key] = Sizes(*found)
    return load_lerobot_config(config)


def policy_sizes(config: PolicyConfig) -> Sizes:
    """`Sizes` of the policy of `rehearsed_config`, which has been called.

    Raises:
        InputError: there is no checkpoint any more.
    """
    return _rehearsed[_key(config, _checkpoint_folder(config))]


def _key(config: PolicyConfig, folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return repr((config, [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]))


def _sizes(config: PolicyConfig) -> Sizes:
    adapter = _load(config, rehearsal=True)
    of = (adapter.policy.parameters(), adapter.trainable().values())
    return Sizes(*(sum(parameter.numel() for parameter in parameters) for parameters in of))


def load_adapter(config: PolicyConfig) -> LeRobotAdapter:
    """Loads policy, processors and critic; proves that the sampler is LeRobot's.

    Raises:
        InputError: see `load_lerobot_config`; weights or processors did not load, or do not act as LeRobot's
            own sampler does, see `PolicyAdapter.self_check`.
    """
    return _load(config)


def _load(config: PolicyConfig, *, rehearsal: bool = False) -> LeRobotAdapter:
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    lerobot_config = load_lerobot_config(config)
    folder, origin = _checkpoint_folder(config), Origin("policy.path", config.path)
    model_class: type[Model] = imported(POLICIES[lerobot_config.type][0])
    try:
        with guarded("policy", config.code_revision), model_class.loading(), Unfilled():
            policy = get_policy_class(lerobot_config.type)(lerobot_config)
    except Exception as error:
        if (ours := input_error(error)) is not None:
            raise ours from error
        remedy = f"its network cannot be built as its config.json says ({brief(error)})"
        raise InputError("policy.path", config.path, remedy) from error
    load_weights(policy, model_class, folder / WEIGHTS, config.path, read=not rehearsal)
    device = torch.device(lerobot_config.device)
    policy.to(device).eval()
    model = model_class(policy)  # type: ignore[call-arg]
    if config.precision == "fp32":
        no_tf32(device)
    overrides = {"device_processor": {"device": str(device)}, **model.processor_overrides}
    check_statistics(folder, origin)
    try:
        overrides |= tokenizer_overrides(lerobot_config, folder)
        with guarded("policy", config.code_revision), model.loading():
            pre, post = make_pre_post_processors(
                lerobot_config, pretrained_path=str(folder), preprocessor_overrides=overrides
            )
        keep_names(lerobot_config, pre, folder)
    except Exception as error:
        if (ours := input_error(error)) is not None:
            raise ours from error
        remedy = f"its LeRobot processors did not load ({brief(error)})"
        if "tokenizer_processor" in str(error) and not (folder / BACKBONE).is_dir():
            remedy += f"; a tokeniser that cannot be had from the Hub goes into {BACKBONE}/ beside {CONFIG}"
        raise InputError("policy.path", config.path, remedy) from error
    try:
        processing = Processing(pre, post, device, config.rename_map)
        sampler = sampler_config(config, lerobot_config.type)
        family = imported(FAMILIES[sampler.type])(model, sampler)
        critic = ValueHead(model.width, config.value_head)
        adapter = LeRobotAdapter(policy, processing, model, family, critic, config.precision)
        if (folder / OURS).is_file():
            _load_ours(adapter, folder, origin)
        if not rehearsal:
            adapter.self_check(*example_observations(lerobot_config, config.rename_map))
        elif sum(parameter.numel() for parameter in policy.parameters()) <= ACTS_MOST:
            asked = example_requests(lerobot_config, config.rename_map)[0]
            adapter.decide([replace(asked, observation=asked.observation | {TASK: TEXT})], 0)
        tune(policy, model, family, config.tuning)
    except InputError:
        raise
    except Exception as error:  # what its files say fits nowhere, and may fail over any of it
        raise InputError("policy.path", config.path, f"it cannot act here ({brief(error)})") from error
    return adapter


class Weights(NamedTuple):
    """All of an adapter's, on the CPU, under the names that LeRobot gives them."""

    policy: dict[str, Tensor]
    value_head: dict[str, Tensor]
    family: dict[str, Tensor]


def copy_weights(adapter: LeRobotAdapter) -> Weights:
    """A copy to be saved while the adapter goes on learning."""
    modules = (adapter.value_head, adapter.family)
    policy = merged_state_dict(adapter.policy) or adapter.policy.state_dict()
    return Weights(_copied(policy), *(_copied(module.state_dict()) for module in modules))


def save_pretrained(
    adapter: LeRobotAdapter, directory: Path, config: PolicyConfig, weights: Weights | None = None
) -> None:
    """Writes LeRobot's ``pretrained_model`` layout, and what is ours beside it, into `directory`.

    Args:
        adapter: what is saved.
        directory: created if it is missing.
        config: what the adapter was loaded by.
        weights: those to be written; None: the adapter's of now.
    """
    weights = weights or copy_weights(adapter)
    directory.mkdir(parents=True, exist_ok=True)
    save_backbone(adapter.policy.config, adapter.processing.preprocessor, directory)
    adapter.policy.save_pretrained(directory, state_dict=weights.policy)
    adapter.processing.preprocessor.save_pretrained(directory)
    adapter.processing.postprocessor.save_pretrained(directory)
    relocate(directory, directory)
    for name, tensors in ((VALUE_HEAD, weights.value_head), (FAMILY, weights.family)):
        if tensors:
            save_file(tensors, directory / name)
    ours = {
        "sampler": draccus.encode(adapter.family.sampler, SamplerConfig),
        "value_head": asdict(config.value_head),
        "rename_map": config.rename_map,
    }
    (directory / OURS).write_text(json.dumps(ours, indent=2) + "\n")


def _checkpoint_folder(config: PolicyConfig) -> Path:
    """Where the checkpoint's files are, once checked; those of a Hub repository are fetched."""
    if config.path is None:
        remedy = "give a LeRobot checkpoint directory or Hub id, or an sft section"
        raise InputError("policy.path", None, remedy)
    return fetched_checkpoint(config.path, config.revision, "policy.path")


def _load_ours(adapter: LeRobotAdapter, folder: Path, origin: Origin) -> None:
    """Loads critic and family, and says where this run's options differ from those they were made with."""
    ours = json.loads((folder / OURS).read_text())
    there = ours.get("sampler", {})
    here = draccus.encode(adapter.family.sampler, SamplerConfig)
    differing = [k for k in here if k in there and there[k] != here[k]]
    if differing:
        logger.warning(
            "this run explores unlike the one that made the checkpoint (evaluation is not affected): %s",
            ", ".join(f"policy.sampler.{k}={here[k]}, there {there[k]}" for k in differing),
        )
    state = dict(read_tensors(folder / FAMILY, origin)) if (folder / FAMILY).is_file() else {}
    mine = adapter.family.state_dict()
    if {k: v.shape for k, v in state.items()} == {k: v.shape for k, v in mine.items()}:
        adapter.family.load_state_dict(state)
    elif state and mine:
        logger.warning("the checkpoint's weights of the sampler are not loaded: they are of another shape")
    there, here = ours.get("value_head", {}), asdict(adapter.value_head.config)
    differing = [k for k in ("pooling", "hidden", "bins") if there.get(k, here[k]) != here[k]]
    if differing:
        logger.warning(
            "the checkpoint's critic is not loaded, a new one starts at V = 0: %s",
            ", ".join(f"policy.value_head.{k}={here[k]}, there {there.get(k)}" for k in differing),
        )
    elif (folder / VALUE_HEAD).is_file():
        state = dict(read_tensors(folder / VALUE_HEAD, origin))
        try:
            adapter.value_head.load_state_dict(state)
        except RuntimeError as error:
            remedy = f"{OURS} says another critic than it is; remove both to start anew ({brief(error)})"
            raise origin.refuse(VALUE_HEAD, remedy) from error


def _copied(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Copies on the CPU; what shared its memory shares it again, so that it is written once."""
    places = {name: place(t) for name, t in tensors.items()}
    kept = {places[name]: t for name, t in tensors.items()}
    copies = {at: whole(t.detach()).to("cpu", copy=True).contiguous() for at, t in kept.items()}
    return {name: copies[at] for name, at in places.items()}


def override(lerobot_config: Any, config: PolicyConfig) -> None:
    """Puts a run's choices of denoising steps, executed rows and precision into the LeRobot config."""
    if hasattr(lerobot_config, "pretrained_backbone_weights"):
        # The checkpoint has them; LeRobot would download torchvision's first, even when told to stay offline.
        lerobot_config.pretrained_backbone_weights = None
    if config.num_steps is not None:
        name = steps_field(lerobot_config)
        if name is None:
            remedy = f"a {lerobot_config.type} policy does not denoise; leave the field out"
            raise InputError("policy.num_steps", config.num_steps, remedy)
        setattr(lerobot_config, name, config.num_steps)
    if hasattr(lerobot_config, "dtype"):
        lerobot_config.dtype = "float32"  # see `PolicyConfig.precision`
    if config.n_action_steps is not None:
        chunk = int(getattr(lerobot_config, "chunk_size", 0) or getattr(lerobot_config, "horizon", 1))
        if lerobot_config.type in LOOK_BACK:
            chunk -= lerobot_config.n_obs_steps - 1  # rows that stand for the past
        if config.n_action_steps > chunk:
            remedy = f"use 1 to {chunk}, the chunk the policy predicts"
            raise InputError("policy.n_action_steps", config.n_action_steps, remedy)
        lerobot_config.n_action_steps = config.n_action_steps


def steps_field(lerobot_config: Any) -> str | None:
    """Where a policy type's config has its denoising steps; None if it does not denoise."""
    return next((n for n in ("num_steps", "num_inference_steps") if hasattr(lerobot_config, n)), None)
