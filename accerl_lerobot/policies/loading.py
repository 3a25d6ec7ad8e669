# SPDX-License-Identifier: Apache-2.0
"""Load a LeRobot checkpoint as a stochastic policy.

    open_checkpoint ─► load_processors ─► build_network ─► load_weights ─► adapter ─► check ─► tune

LeRobot's loaders of weights take what fits and leave the rest at random, some of them after printing what
went wrong; here file and policy must hold the same tensors of the same shapes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from accerl_lerobot.checkpoint.layout import BACKBONE
from accerl_lerobot.checkpoint.safety import FileSource, read_json, read_tensors, tensor_shapes
from accerl_lerobot.config.machine import computes_bf16
from accerl_lerobot.config.parsing import discover, imported
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter, ValueHead
from accerl_lerobot.policies.config import (
    POLICIES,
    ChunkNoiseConfig,
    PolicyConfig,
    Precision,
    check_observations,
    check_registered,
    override,
    register_policies,
    sampler_config,
)
from accerl_lerobot.policies.family import Model, NoDensityError
from accerl_lerobot.policies.processing import (
    Processing,
    check_statistics,
    correct_inputs,
    load_processors,
    use_own_files,
)
from accerl_lerobot.policies.saving import tune
from accerl_lerobot.policies.stock import StockAdapter
from accerl_lerobot.policies.untrusted import (
    ADAPTER,
    ADAPTER_CONFIG,
    CONFIG,
    WEIGHTS,
    Unfilled,
    fetched_checkpoint,
    guarded,
    is_adapter,
    refusing,
)

ACTS_MOST = 10**9  # parameters of a policy that acts in a dry run; π0's four billion would take minutes

PROCESSORS_HINT = (
    f"a tokeniser that is not to be had from the Hub goes into {BACKBONE}/ beside config.json; one from "
    "before LeRobot's processors is converted by python -m lerobot.processor.migrate_policy_normalization"
)


class Sizes(NamedTuple):
    """Numbers of parameters: the policy's, and those that a run trains, the critic's included."""

    policy: int
    trained: int


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A LeRobot checkpoint whose files have been checked."""

    folder: Path
    source: FileSource
    config: Any  # LeRobot's config of the policy, with the run's choices in it
    hub_names: dict[str, str]  # see `use_own_files`
    run: PolicyConfig

    @property
    def model_class(self) -> type[Model]:
        """The model of a policy type that has a likelihood; `Model` itself for any other type."""
        if self.config.type not in POLICIES:
            return Model
        path, _ = POLICIES[self.config.type]
        model_class: type[Model] = imported(path)
        return model_class

    @property
    def precision(self) -> Precision:
        """fp32 or bf16."""
        return precision_on(torch.device(self.config.device), self.run.precision)

    @contextlib.contextmanager
    def acting(self) -> Iterator[None]:
        """Holds while the policy acts for the first time, when some load tokenisers and encoders."""
        with refusing(self.source, "it cannot act here"), guarded("policy", self.run.trust_remote_code):
            yield


_known_sizes: dict[tuple[str, bool, bool], Sizes] = {}  # of the dry runs of this process


def resolve_device(name: str, field: str = "policy.device") -> torch.device:
    """The device of this name; ``auto`` is CUDA when there is one. The error names `field`."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = torch.device(name)
    # There may be a GPU that torch cannot use.
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device.type == "cuda" and (device.index or 0) >= count:
        here = f"there are {count} such devices here, numbered from 0" if count else "no CUDA device here"
        raise InputError(field, name, f"{here}; use cpu or auto")
    return device


def precision_on(device: torch.device, precision: Precision) -> Precision:
    """fp32 or bf16; for ``auto``, bf16 where the device itself computes in it."""
    if precision != "auto":
        return precision
    return "bf16" if computes_bf16(device) else "fp32"


def load_lerobot_config(config: PolicyConfig) -> Any:
    """The checkpoint's LeRobot policy config, without its weights; see `open_checkpoint`."""
    return open_checkpoint(config).config


def dry_run_config(config: PolicyConfig, *, fine_tuned: bool = False, learns: bool = False) -> Any:
    """`load_lerobot_config` of a checkpoint that has passed `policy_sizes`."""
    policy_sizes(config, fine_tuned=fine_tuned, learns=learns)
    return load_lerobot_config(config)


def policy_sizes(config: PolicyConfig, *, fine_tuned: bool = False, learns: bool = False) -> Sizes:
    """`Sizes` of a checkpoint's policy, which has been built on the CPU and has acted once, in a dry run.

    If it is to be `fine_tuned`, statistics that it lacks are no reason to refuse it. If it `learns`, an
    option that keeps it from learning is one. A policy is built once in a process.

    Raises:
        InputError: see `open_checkpoint` and `load_adapter`.
    """
    text = repr(config)
    for key in ((text, fine_tuned, learns), (text, fine_tuned, True)):  # a policy that can learn can act
        if key in _known_sizes:
            return _known_sizes[key]
    load = load_adapter if learns else load_acting
    precision = precision_on(resolve_device(config.device), config.precision)
    on_cpu = replace(config, device="cpu", precision=precision)
    # What LeRobot prints is dropped: the standard output of a command is its result.
    with contextlib.redirect_stdout(io.StringIO()), torch.random.fork_rng(devices=[]):
        sizes = sizes_of(load(on_cpu, dry_run=True, fine_tuned=fine_tuned))
    _known_sizes[text, fine_tuned, learns] = sizes
    return sizes


def sizes_of(adapter: Any) -> Sizes:
    policy = sum(parameter.numel() for parameter in adapter.policy.parameters())
    trained = sum(parameter.numel() for parameter in adapter.trainable().values())
    return Sizes(policy, trained)


def load_acting(
    config: PolicyConfig, *, dry_run: bool = False, fine_tuned: bool = False
) -> LeRobotAdapter | StockAdapter:
    """A policy of any of LeRobot's types, to act: by `load_adapter` if it has an exact likelihood."""
    checkpoint = open_checkpoint(config)
    if checkpoint.config.type in POLICIES:
        with contextlib.suppress(NoDensityError):
            return load_adapter(config, dry_run=dry_run, fine_tuned=fine_tuned)
    policy, processing = _load_parts(checkpoint, dry_run, fine_tuned)
    adapter = StockAdapter(policy, processing, checkpoint.precision)
    with checkpoint.acting():
        adapter.try_out()
    return adapter


def load_adapter(
    config: PolicyConfig, *, dry_run: bool = False, fine_tuned: bool = False
) -> LeRobotAdapter | StockAdapter:
    """Loads policy, processors and critic; proves that the sampler is LeRobot's.

    In a `dry_run` the weights are not read, and a decision is made in place of that proof. `policy_sizes`
    explains `fine_tuned`.

    Raises:
        InputError: see `open_checkpoint` and `LeRobotAdapter.self_check`; or a file did not load.
    """
    checkpoint = open_checkpoint(config, learns=True)
    sampler = sampler_config(config, checkpoint.config.type)
    policy, processing = _load_parts(checkpoint, dry_run, fine_tuned)
    with checkpoint.acting():
        if isinstance(sampler, ChunkNoiseConfig):
            stock = StockAdapter(policy, processing, checkpoint.precision, sampler)
            tune(policy, config.tuning, checkpoint.model_class.backbone)
            stock.self_check(dry_run)
            return stock
        model = checkpoint.model_class(policy)
        family = imported(sampler.family)(model, sampler)
        critic = ValueHead(model.width)
        adapter = LeRobotAdapter(policy, processing, model, family, critic, checkpoint.precision)
        _load_ours(adapter, checkpoint)
        requests = adapter.example_requests()
        if not dry_run:
            adapter.self_check(*stack_observations(requests))
        elif sizes_of(adapter).policy <= ACTS_MOST:
            adapter.decide(requests[:1], 0)
        tune(policy, config.tuning, model.backbone, model.idle)
    return adapter


def load_network(config: PolicyConfig) -> tuple[Any, Processing]:
    """LeRobot's policy of any type, and its processors, for another use than to act."""
    return _load_parts(open_checkpoint(config))


def pinned(config: PolicyConfig) -> PolicyConfig:
    """With the commit that a Hub checkpoint has now, which all processes and a resumed run then load."""
    if config.path is None or expanded(config.path, "policy.path").exists():
        return config
    folder = fetched_checkpoint(config.path, config.revision, "policy.path")
    return replace(config, revision=folder.name)


def open_checkpoint(config: PolicyConfig, *, learns: bool = False) -> Checkpoint:
    """Fetches and checks a checkpoint's files, and reads its config; `override` explains `learns`.

    Raises:
        InputError: no checkpoint there, or one of a policy type that is not installed.
    """
    if config.path is None:
        hint = "give a LeRobot checkpoint directory or Hub id, or an sft section"
        raise InputError("policy.path", None, hint)
    folder = fetched_checkpoint(config.path, config.revision, "policy.path")
    source = FileSource("policy.path", config.path)
    discover(config.discover_packages_path, "policy")
    kind = read_json(folder / CONFIG, source).get("type")
    if kind is None:
        types = ", ".join(sorted(PreTrainedConfig.get_known_choices()))
        hint = f'{CONFIG} of {config.path} names no type; add "type": one of {types}'
        raise InputError("policy.type", None, hint)
    register_policies(str(kind))
    check_registered(kind, "policy.type", f"{config.path} is of this type: ")
    what = "its config.json is not one of this LeRobot's policies; remove the fields of another version"
    with refusing(source, what):
        policy_config = PreTrainedConfig.from_pretrained(folder)
        correct_inputs(policy_config, folder, source)
    policy_config.device = str(resolve_device(config.device))
    override(policy_config, config, learns=learns)
    check_observations(policy_config, "policy.n_obs_steps")
    hub_names = use_own_files(policy_config, folder, source)
    return Checkpoint(folder=folder, source=source, config=policy_config, hub_names=hub_names, run=config)


def _load_parts(
    checkpoint: Checkpoint, dry_run: bool = False, fine_tuned: bool = False
) -> tuple[Any, Processing]:
    """LeRobot's policy with the checkpoint's weights, and its processors."""
    folder, source, policy_config = checkpoint.folder, checkpoint.source, checkpoint.config
    model_class = checkpoint.model_class
    with guarded("policy", checkpoint.run.trust_remote_code), model_class.loading():
        with refusing(source, f"its LeRobot processors did not load; {PROCESSORS_HINT}"):
            processing = load_processors(policy_config, folder, checkpoint.run.rename_map)
        check_statistics(processing, policy_config, source, replaced=fine_tuned)
        with refusing(source, "its network cannot be built as its config.json says"), Unfilled():
            policy = _build_network(policy_config, folder)
    if policy_config.type in POLICIES:
        # LeRobot builds SmolVLA's backbone and expert in the backbone's bfloat16, in which small steps of a
        # gradient are lost.
        policy = policy.float()
    base = weights_folder(folder, source)
    load_weights(policy, model_class.unread, base / WEIGHTS, source, read=not dry_run)
    if base != folder:
        with refusing(source, "its adapter did not load"), guarded("policy"):
            policy = _merged(policy, folder, source)
    for field, name in checkpoint.hub_names.items():
        setattr(policy.config, field, name)
    policy.to(processing.device).eval()
    if processing.device.type == "cuda" and checkpoint.precision == "fp32":
        # torch convolves with 10 bits of mantissa there. For batches of different sizes cuDNN chooses other
        # algorithms; what they round differently is divided by the std of the noise in every log-prob.
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cuda.matmul.allow_tf32 = False
    return policy, processing


def _build_network(policy_config: Any, folder: Path) -> Any:
    """LeRobot's policy, without the backbone's weights, which its own file has, too.

    Types differ in the field that says so: ``load_vlm_weights``, or ``pretrained_path``, which LeRobot's
    command line sets to the checkpoint's `folder`.
    """
    values: dict[str, Any] = {"pretrained_path": folder}
    if hasattr(policy_config, "load_vlm_weights"):
        values["load_vlm_weights"] = False
    with patch.multiple(policy_config, **values):
        return get_policy_class(policy_config.type)(policy_config)


def load_weights(
    policy: Any, unread: Sequence[str], file: Path, source: FileSource, *, read: bool = True
) -> None:
    """Fills a policy from a file with the same tensors, or only compares names and shapes if not `read`.

    Those named in `unread` may be missing.
    """
    if read:
        stored = dict(read_tensors(file, source))
    else:
        shapes = tensor_shapes(file, source)
        stored = {name: torch.empty(shape, device="meta") for name, (_, shape) in shapes.items()}
    stored = _renamed(stored, policy)
    expected = policy.state_dict()
    # Nor is a tensor missing that a policy holds under several names: savers keep one of them.
    both = stored.keys() & expected.keys()
    held = {expected[name].data_ptr() for name in both}
    absent = expected.keys() - both - set(unread)
    problems = {
        "missing": [name for name in absent if expected[name].data_ptr() not in held],
        "unexpected": list(stored.keys() - both),
        "of another shape": [name for name in both if stored[name].shape != expected[name].shape],
    }
    found = [f"{len(names)} {what} {sorted(names)[:3]}" for what, names in problems.items() if names]
    if found:
        hint = f"the weights did not load: tensors {', '.join(found)}; config.json and {file.name} disagree"
        raise InputError(source.field, source.value, hint)
    if read:
        policy.load_state_dict(stored, strict=False)


def _renamed(stored: dict[str, Tensor], policy: Any) -> dict[str, Tensor]:
    """Tensors of a file by the names that LeRobot's loader of this policy gives them.

    π0's reads files of openpi as well: without the leading ``model.``, with other names for some layers, and
    with the input embedding left out where it equals the output layer.
    """
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return stored
    renamed = _prefixed(rename(stored, policy.config))
    for name, tensor in _prefixed(stored).items():
        if name in renamed:  # what a file has under its own name goes before what is taken for it
            renamed[name] = tensor
    return renamed


def _prefixed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    prefix = "model."
    return {prefix + name.removeprefix(prefix): tensor for name, tensor in tensors.items()}


def weights_folder(folder: Path, source: FileSource) -> Path:
    """The folder with all of a policy's weights: `folder` itself, or, of an adapter, the policy it is for."""
    if not is_adapter(folder):
        return folder
    stored = read_json(folder / ADAPTER_CONFIG, source)
    base = stored.get("base_model_name_or_path")
    try:
        return fetched_checkpoint(str(base), stored.get("revision"), source.field)
    except InputError as error:
        why = f"{base!r}, the policy that the adapter is for: {error.hint}"
        raise source.refuse(f"{ADAPTER_CONFIG}: base_model_name_or_path", why) from error


def _merged(policy: Any, folder: Path, source: FileSource) -> Any:
    """The policy with the adapter of LeRobot's PEFT training in `folder` added to its weights.

    Parameters that were trainable in it are again.
    """
    from peft import PeftModel, get_peft_model_state_dict

    trainable = {name for name, parameter in policy.named_parameters() if parameter.requires_grad}
    stored = dict(read_tensors(folder / ADAPTER, source))
    wrapped = PeftModel.from_pretrained(policy, str(folder), torch_device="cpu")
    if get_peft_model_state_dict(wrapped).keys() != stored.keys():
        raise source.refuse(ADAPTER, f"its tensors are not those of {ADAPTER_CONFIG} and the policy")
    policy = wrapped.merge_and_unload()
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name in trainable)
    return policy


def _load_ours(adapter: LeRobotAdapter, checkpoint: Checkpoint) -> None:
    """Loads critic and family, where the checkpoint has them."""
    for name, module in adapter.parts.items():
        file = checkpoint.folder / f"{name}.safetensors"
        if name != "policy" and file.is_file():
            with refusing(checkpoint.source, f"{file.name}: not of this policy; remove it to start anew"):
                module.load_state_dict(dict(read_tensors(file, checkpoint.source)))
