# SPDX-License-Identifier: Apache-2.0
"""A LeRobot checkpoint in, a stochastic policy out.

Config and processors load through LeRobot's `from_pretrained`. LeRobot's loaders of weights take what fits
and leave the rest at random, some of them after printing what went wrong; here file and policy must hold the
same tensors of the same shapes.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import draccus
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from accerl_lerobot.checkpoint.layout import BACKBONE, CONFIG_FOLDERS, STEP_FOLDERS
from accerl_lerobot.checkpoint.safety import FileSource, brief, read_json, read_tensors, tensor_shapes
from accerl_lerobot.config.machine import computes_bf16
from accerl_lerobot.config.parsing import discover, imported
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies import untrusted
from accerl_lerobot.policies.adapter import LeRobotAdapter, Processing, ValueHead
from accerl_lerobot.policies.config import (
    POLICIES,
    ChunkNoiseConfig,
    PolicyConfig,
    Precision,
    SamplerConfig,
    check_observations,
    check_registered,
    check_sizes,
    override,
    register_policies,
    sampler_config,
)  # fmt: skip
from accerl_lerobot.policies.family import Model, NoDensityError
from accerl_lerobot.policies.normalisation import check_statistics, correct_inputs, stored_steps
from accerl_lerobot.policies.peft_adapters import merged, weights_folder
from accerl_lerobot.policies.saving import tune
from accerl_lerobot.policies.stock import StockAdapter

logger = logging.getLogger(__name__)

ACTS_MOST = 10**9  # parameters of a policy that acts in a dry run; π0's four billion would take minutes


class Sizes(NamedTuple):
    """Numbers of parameters: the policy's, and those that a run trains, the critic's included."""

    policy: int
    trained: int


_dry_runs: dict[tuple[Any, ...], Sizes] = {}  # of checkpoints and configs that need no other dry run


def resolve_device(name: str, field: str = "policy.device") -> torch.device:
    """The device of this name; ``auto`` is CUDA when there is one. The error names `field`."""
    here = torch.cuda.is_available()
    device = torch.device(("cuda" if here else "cpu") if name == "auto" else name)
    if device.type == "cuda" and not here:
        raise InputError(field, name, "no CUDA device here; use cpu or auto")
    if device.type == "cuda" and (device.index or 0) >= (count := torch.cuda.device_count()):
        raise InputError(field, name, f"there are {count} such devices here, numbered from 0")
    return device


def precision_on(device: torch.device, wanted: Precision) -> Precision:
    """fp32 or bf16: what is `wanted`, or, for ``auto``, bf16 where the device itself computes in it."""
    if wanted != "auto":
        return wanted
    return "bf16" if computes_bf16(device) else "fp32"


def load_lerobot_config(config: PolicyConfig) -> Any:
    """The checkpoint's LeRobot policy config, without its weights.

    Raises:
        InputError: no checkpoint there, or one of a policy type that is not installed.
    """
    folder, origin = _checkpoint_folder(config), FileSource("policy.path", config.path)
    _registered_type(config, folder)
    what = (
        "its config.json is not one of this LeRobot's policies; remove the fields of another version from it"
    )
    with _refusing(config, what):
        lerobot_config = PreTrainedConfig.from_pretrained(folder)
        correct_inputs(lerobot_config, folder, origin)
    check_sizes(lerobot_config, origin)
    lerobot_config.device = str(resolve_device(config.device))
    override(lerobot_config, config)
    check_observations(lerobot_config, "policy.n_obs_steps")
    _use_backbone(lerobot_config, folder, config.path)
    return lerobot_config


def dry_run_config(config: PolicyConfig, *, fine_tuned: bool = False) -> Any:
    """`load_lerobot_config` of a checkpoint that has passed `policy_sizes`."""
    policy_sizes(config, fine_tuned=fine_tuned)
    return load_lerobot_config(config)


def learning_config(config: PolicyConfig, *, fine_tuned: bool = False, imitates: bool = False) -> Any:
    """`dry_run_config` of a policy that learns, by LeRobot's training loss if it `imitates`."""
    policy_sizes(config, fine_tuned=fine_tuned, imitates=imitates, learns=True)
    lerobot_config = load_lerobot_config(config)
    sampler_config(config, lerobot_config.type, prefix=f"{config.path} is of this type: ")
    return lerobot_config


def policy_sizes(
    config: PolicyConfig, *, fine_tuned: bool = False, imitates: bool = False, learns: bool = False
) -> Sizes:
    """`Sizes` of a checkpoint's policy, which has been loaded on the CPU and has acted once.

    One that `imitates`, of a type without a likelihood, computes LeRobot's training loss too. If it is to be
    `fine_tuned`, statistics that it lacks are no reason to refuse it. If it `learns`, an option that has no
    exact likelihood is one. A checkpoint whose files have not changed since is not loaded again.

    Raises:
        InputError: see `load_lerobot_config` and `load_adapter`.
    """
    files = [path for path in sorted(_checkpoint_folder(config).rglob("*")) if path.is_file()]
    state = repr([(str(path), path.stat().st_mtime_ns) for path in files])
    key = (repr(config), state, fine_tuned, imitates)
    for learning in (learns, True):  # a policy that can learn can act
        if (*key, learning) in _dry_runs:
            return _dry_runs[*key, learning]
    sizes = dry_run(
        replace(config, precision="fp32"), sizes_of, fine_tuned=fine_tuned, imitates=imitates, learns=learns
    )
    return _dry_runs.setdefault((*key, learns), sizes)


def dry_run[T](
    config: PolicyConfig,
    task: Callable[[Any], T],
    *,
    fine_tuned: bool = False,
    imitates: bool = False,
    learns: bool = False,
) -> T:
    """Result of `task` with the policy of `policy_sizes`, whose weights are not read.

    What LeRobot prints is dropped: the standard output of a command is its result.
    """
    precision = precision_on(resolve_device(config.device), config.precision)
    config = replace(config, device="cpu", precision=precision)
    load = partial(load_adapter, explores=False) if imitates else partial(load_acting, learns=learns)
    with contextlib.redirect_stdout(io.StringIO()), torch.random.fork_rng(devices=[]):
        return task(load(config, dry_run=True, fine_tuned=fine_tuned))


def sizes_of(adapter: Any) -> Sizes:
    of = (adapter.policy.parameters(), adapter.trainable().values())
    return Sizes(*(sum(parameter.numel() for parameter in parameters) for parameters in of))


def load_acting(
    config: PolicyConfig, *, dry_run: bool = False, fine_tuned: bool = False, learns: bool = False
) -> LeRobotAdapter | StockAdapter:
    """A policy of any of LeRobot's types: by `load_adapter` if it has an exact likelihood, else to act only.

    If it `learns`, one of a type with a likelihood must have it.
    """
    lerobot_config = load_lerobot_config(config)
    if lerobot_config.type in POLICIES:
        with contextlib.suppress(*(() if learns else (NoDensityError,))):
            return load_adapter(config, dry_run=dry_run, fine_tuned=fine_tuned, explores=False)
    return _stock_adapter(config, lerobot_config, None, dry_run, fine_tuned)


def load_network(config: PolicyConfig) -> tuple[Any, Processing]:
    """LeRobot's policy of any type, and its processors, for another use than to act."""
    policy, processing, _ = _load_parts(config, load_lerobot_config(config), None, False, False)
    return policy, processing


def _stock_adapter(
    config: PolicyConfig,
    lerobot_config: Any,
    sampler: ChunkNoiseConfig | None,
    dry_run: bool,
    fine_tuned: bool,
) -> StockAdapter:
    """A policy of any type, which has acted once; with a `sampler` one that explores and learns."""
    known = POLICIES.get(lerobot_config.type)
    model_class: type[Model] | None = None if known is None else imported(known[0])
    policy, processing, precision = _load_parts(config, lerobot_config, model_class, dry_run, fine_tuned)
    adapter = StockAdapter(policy, processing, precision, sampler)
    with _refusing(config, "it cannot act here"):
        if sampler is None:
            adapter.decide(adapter.example_requests(), 0)
        else:
            tune(policy, config.tuning)
            adapter.self_check()
    return adapter


def load_adapter(
    config: PolicyConfig, *, dry_run: bool = False, fine_tuned: bool = False, explores: bool = True
) -> LeRobotAdapter | StockAdapter:
    """Loads policy, processors and critic; proves that the sampler is LeRobot's.

    In a `dry_run` the weights are not read, and a decision is made in place of that proof. `policy_sizes`
    explains `fine_tuned`.

    Raises:
        InputError: see `load_lerobot_config` and `LeRobotAdapter.self_check`; or a file did not load.
    """
    lerobot_config = load_lerobot_config(config)
    sampler = sampler_config(config, lerobot_config.type, prefix=f"{config.path} is of this type: ")
    if isinstance(sampler, ChunkNoiseConfig):
        return _stock_adapter(config, lerobot_config, sampler, dry_run, fine_tuned)
    model_class: type[Model] = imported(POLICIES[lerobot_config.type][0])
    policy, processing, precision = _load_parts(config, lerobot_config, model_class, dry_run, fine_tuned)
    folder, origin = _checkpoint_folder(config), FileSource("policy.path", config.path)
    with _refusing(config, "it cannot act here"):
        model = model_class(policy)
        family = imported(sampler.family)(model, sampler)
        critic = ValueHead(model.width)
        adapter = LeRobotAdapter(policy, processing, model, family, critic, precision)
        if (folder / untrusted.OURS).is_file():
            _load_ours(adapter, folder, origin, explores)
        requests = adapter.example_requests()
        if not dry_run:
            adapter.self_check(*stack_observations(requests))
        elif sum(parameter.numel() for parameter in policy.parameters()) <= ACTS_MOST:
            adapter.decide(requests[:1], 0)
        tune(policy, config.tuning, model.backbone, model.idle)
    return adapter


def _load_parts(
    config: PolicyConfig,
    lerobot_config: Any,
    model_class: type[Model] | None,
    dry_run: bool,
    fine_tuned: bool,
) -> tuple[Any, Processing, Precision]:
    """LeRobot's policy with the checkpoint's weights, its processors, and the precision it computes in."""
    folder, origin = _checkpoint_folder(config), FileSource("policy.path", config.path)
    loading = contextlib.nullcontext if model_class is None else model_class.loading
    with (
        _refusing(config, "its network cannot be built as its config.json says"),
        untrusted.guarded("policy", config.trust_remote_code),
        loading(),
        untrusted.Unfilled(),
    ):
        policy = _built(lerobot_config)
        if model_class is not None:
            # LeRobot builds SmolVLA's backbone and expert in the backbone's bfloat16, in which small steps of
            # a gradient are lost.
            policy = policy.float()
    base = weights_folder(folder, origin)
    unread = () if model_class is None else model_class.unread
    load_weights(policy, unread, base / untrusted.WEIGHTS, config.path, read=not dry_run)
    if base != folder:
        with _refusing(config, "its adapter did not load"), untrusted.guarded("policy"):
            policy = merged(policy, folder, origin)
    device = torch.device(lerobot_config.device)
    policy.to(device).eval()
    precision = precision_on(device, config.precision)
    if precision == "fp32" and device.type == "cuda":
        # torch convolves with 10 bits of mantissa there. For batches of different sizes cuDNN chooses other
        # algorithms; what they round differently is divided by the std of the noise in every log-prob.
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    overrides = {"device_processor": {"device": str(device)}}
    check_statistics(lerobot_config, folder, origin, replaced=fine_tuned)
    hint = f"a tokeniser that cannot be had from the Hub goes into {BACKBONE}/ beside {untrusted.CONFIG}"
    with _refusing(config, f"its LeRobot processors did not load; {hint}"):
        overrides |= _tokenizer_overrides(lerobot_config, folder)
        with untrusted.guarded("policy", config.trust_remote_code), loading():
            pre, post = make_pre_post_processors(
                lerobot_config, pretrained_path=str(folder), preprocessor_overrides=overrides
            )
        _keep_names(lerobot_config, pre, folder)
    return policy, Processing(pre, post, device, config.rename_map), precision


def _built(lerobot_config: Any) -> Any:
    """LeRobot's policy, without the backbone's weights, which its own file has, too."""
    if asked := getattr(lerobot_config, "load_vlm_weights", False):
        lerobot_config.load_vlm_weights = False
    policy = get_policy_class(lerobot_config.type)(lerobot_config)
    if asked:
        policy.config.load_vlm_weights = True
    return policy


@contextlib.contextmanager
def _refusing(config: PolicyConfig, what: str) -> Iterator[None]:
    """LeRobot takes files at their word, and may fail over any of it: one line for all that is raised."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if (ours := untrusted.input_error(error)) is not None:
            raise ours from error
        raise InputError("policy.path", config.path, f"{what} ({untrusted.reason(error)})") from error


def _checkpoint_folder(config: PolicyConfig) -> Path:
    if config.path is None:
        hint = "give a LeRobot checkpoint directory or Hub id, or an sft section"
        raise InputError("policy.path", None, hint)
    return untrusted.fetched_checkpoint(config.path, config.revision, "policy.path")


def pinned(config: PolicyConfig) -> PolicyConfig:
    """With the commit that a Hub checkpoint has now, which all processes and a resumed run then load."""
    local = config.path is None or expanded(config.path, "policy.path").exists()
    return config if local else replace(config, revision=_checkpoint_folder(config).name)


def _registered_type(config: PolicyConfig, folder: Path) -> Any:
    """The checkpoint's policy type; packages that may have it are imported."""
    discover(config.discover_packages_path, "policy")
    kind = read_json(folder / untrusted.CONFIG, FileSource("policy.path", config.path)).get("type")
    register_policies(str(kind))
    check_registered(kind, "policy.type", f"{config.path} is of this type: ")
    return kind


def _load_ours(adapter: LeRobotAdapter, folder: Path, origin: FileSource, explores: bool) -> None:
    """Loads critic and family, and says where a run explores with other options than they were made with."""
    there = json.loads((folder / untrusted.OURS).read_text()).get("sampler", {})
    here = draccus.encode(adapter.family.sampler, SamplerConfig)
    differing = [k for k in here if k in there and there[k] != here[k]]
    if explores and differing:
        logger.warning(
            "this run explores unlike the one that made the checkpoint: %s",
            ", ".join(f"policy.sampler.{k}={here[k]}, there {there[k]}" for k in differing),
        )
    file = folder / untrusted.FAMILY
    state = dict(read_tensors(file, origin)) if file.is_file() else {}
    mine = adapter.family.state_dict()
    if {k: v.shape for k, v in state.items()} == {k: v.shape for k, v in mine.items()}:
        adapter.family.load_state_dict(state)
    elif state and mine:
        logger.warning("the checkpoint's weights of the sampler are not loaded: they are of another shape")
    if (folder / untrusted.VALUE_HEAD).is_file():
        state = dict(read_tensors(folder / untrusted.VALUE_HEAD, origin))
        try:
            adapter.value_head.load_state_dict(state)
        except RuntimeError as error:
            hint = f"it is no critic of this policy; remove it to start anew ({brief(error)})"
            raise origin.refuse(untrusted.VALUE_HEAD, hint) from error


def _use_backbone(lerobot_config: Any, folder: Path, path: str | None) -> None:
    """Points a LeRobot policy config at the checkpoint's own files, where it has them."""
    for field, own in CONFIG_FOLDERS.items():
        if not hasattr(lerobot_config, field):
            continue
        if (folder / own).is_dir():
            setattr(lerobot_config, field, str((folder / own).resolve()))
        named = Path(getattr(lerobot_config, field))
        if named.is_absolute() and not named.is_dir():
            what = "backbone was" if field == "vlm_model_name" else "tokeniser was"
            hint = f"its {what} in {named}, which is gone; put a copy into {own}/ beside config.json"
            raise InputError("policy.path", path, hint)


def _tokenizer_overrides(lerobot_config: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Processor step → options, such that tokenisers are the checkpoint's own, where it has them."""
    overrides: dict[str, dict[str, Any]] = {}
    for entry in stored_steps(folder):
        step = entry.get("registry_name", "")
        if step in STEP_FOLDERS and (folder / STEP_FOLDERS[step][1]).is_dir():
            option, own = STEP_FOLDERS[step]
            overrides[step] = {option: str((folder / own).resolve())}
        if step == "action_tokenizer_processor":  # LeRobot does not save these two of its options
            overrides.setdefault(step, {})["paligemma_tokenizer_name"] = lerobot_config.text_tokenizer_name
            overrides[step]["fast_skip_tokens"] = lerobot_config.fast_skip_tokens
    return overrides


def _keep_names(lerobot_config: Any, preprocessor: Any, folder: Path) -> None:
    """Undoes the two functions above in what will be saved, once tokenisers are loaded."""
    stored = json.loads((folder / untrusted.CONFIG).read_text())
    for field in CONFIG_FOLDERS.keys() - {"vlm_model_name"}:
        if hasattr(lerobot_config, field) and field in stored:
            setattr(lerobot_config, field, stored[field])
    for step, entry in zip(preprocessor.steps, stored_steps(folder), strict=True):
        if (option := STEP_FOLDERS.get(entry.get("registry_name", ""))) is not None:
            setattr(step, option[0], entry["config"].get(option[0]))


class _Name(str):
    """The name of a tensor in its place, for LeRobot's functions that rename the keys of a dict."""

    def clone(self) -> _Name:
        return self


@torch.no_grad()
def load_weights(
    policy: Any, unread: Sequence[str], file: Path, path: str | None, *, read: bool = True
) -> None:
    """Fills a policy from a file with the same tensors, or only compares names and shapes if not `read`.

    Those named in `unread` may be missing.
    """
    origin = FileSource("policy.path", path)
    shapes = {name: shape for name, (_, shape) in tensor_shapes(file, origin).items()}
    mine, stored = policy.state_dict(), _names(shapes, policy)
    # Nor is a tensor missing that a policy holds under several names: savers keep one of them.
    held = {mine[k].data_ptr() for k in stored.keys() & mine.keys()}
    absent = mine.keys() - stored.keys() - set(unread)
    missing = sorted(k for k in absent if mine[k].data_ptr() not in held)
    unexpected = sorted(stored.keys() - mine.keys())
    if missing or unexpected:
        counts = f"{len(missing)} tensors missing {missing[:3]}, {len(unexpected)} unexpected "
        hint = f"{counts}{unexpected[:3]}; config.json and {file.name} disagree"
        raise InputError("policy.path", path, f"the weights did not load: {hint}")
    for name, theirs in stored.items():
        if mine[name].shape != shapes[theirs]:
            sizes = f"{shapes[theirs]} in the file, {tuple(mine[name].shape)} in the policy"
            hint = f"the weights did not load: size mismatch for {name}, {sizes}"
            raise InputError("policy.path", path, hint)
    for theirs, tensor in read_tensors(file, origin) if read else ():
        for name in (name for name, place in stored.items() if place == theirs):
            mine[name].copy_(tensor)


def _names(shapes: dict[str, Any], policy: Any) -> dict[str, str]:
    """Name of a policy's tensor → name in the file, as LeRobot's loader of this policy has it.

    π0's reads files of openpi as well: without the leading ``model.``, with other names for some layers, and
    with the input embedding left out where it equals the output layer.
    """
    stored: dict[str, str] = {name: _Name(name) for name in shapes}
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return stored
    renamed = _prefixed(rename(stored, policy.config))
    # What a file has under its own name goes before what is taken for it.
    return renamed | {k: v for k, v in _prefixed(stored).items() if k in renamed}


def _prefixed(names: dict[str, str]) -> dict[str, str]:
    return {k if k.startswith("model.") else f"model.{k}": v for k, v in names.items()}
