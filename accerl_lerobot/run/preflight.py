# SPDX-License-Identifier: Apache-2.0
"""Checks of a run before any work begins: devices, logins, disk, and that its parts fit each other.

`config` checks what plain numbers can say; this asks LeRobot, the environment and the machine.
"""

from __future__ import annotations

import contextlib
import copy
import difflib
import json
import logging
import math
import os
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import draccus
import numpy as np
import yaml

from accerl_lerobot.algorithms import AWRConfig, ChunkCriticConfig, LossInputs, OffPolicyConfig, RatioConfig
from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.machine import check_disk
from accerl_lerobot.envs import (
    EnvConfig,
    EnvironmentSpec,
    JudgedEnvironment,
    RewardModelConfig,
    environment_error,
    make_environment,
)
from accerl_lerobot.errors import InputError, causes, check_absent, expanded
from accerl_lerobot.experience import Observation
from accerl_lerobot.policies.features import (
    ACTION,
    ENV_STATE,
    STATE,
    Features,
    check_actions,
    check_features,
    check_statistics,
    dataset_features,
    env_features,
    fine_tuned_features,
    policy_features,
    resizes,
)
from accerl_lerobot.rollout.runner import nonfinite
from accerl_lerobot.run.sizes import check_memory
from accerl_lerobot.world_model.config import SimulatorStateConfig

if TYPE_CHECKING:
    from accerl_lerobot.algorithms import AlgorithmConfig
    from accerl_lerobot.demos.sft import SFTConfig
    from accerl_lerobot.engines.config import DatasetConfig, RunConfig
    from accerl_lerobot.metrics import WandBConfig
    from accerl_lerobot.policies.config import PolicyConfig

logger = logging.getLogger(__name__)

MEANINGS = {
    "rename_map": "a mapping from the dataset's names to the policy's",
    "dataset.use_imagenet_stats": "true or false",
    "dataset.episodes": "a list of numbers such as [0, 1]",
}
"""Arguments of ``lerobot-train`` that are looked at here → their values, in words."""

SLOW_S = 30.0  # an environment that takes longer to reset, such as a robot, is reset only once to be checked
VISIBLE = 25  # levels of a pixel that rendering alone does not change


def check_environment(env: EnvConfig, reward_model: RewardModelConfig | None = None) -> EnvironmentSpec:
    """Build and reset an environment, so that what is wrong with it shows before anything long."""
    with contextlib.closing(make_environment(env, reward_model=reward_model)) as environment:
        task, began = environment.spec.tasks[0], time.monotonic()
        try:
            first = environment.reset(0, task)
            slow = time.monotonic() - began > SLOW_S
            other, again = (
                (first, first) if slow else (environment.reset(1, task), environment.reset(0, task))
            )
        except Exception as error:
            raise environment_error(env, error) from error
        if bad := nonfinite(first):
            raise InputError("env", task, f"{bad} of the first observation is not finite")
        if isinstance(environment, JudgedEnvironment):
            environment.succeeded(first)
        if not slow:
            _compare_starts(first, other, again)
        return environment.spec


def _compare_starts(first: Observation, other: Observation, again: Observation) -> None:
    """Warn if starts do not follow from their seeds: `again` has the seed of `first`, `other` another."""
    if not all(_same(first[key], again[key]) for key in first):
        logger.warning(
            "the environment's reset ignores its seed: the same seed gives different first observations. No "
            "episode can be repeated, and success before and after training is measured on different starts"
        )
    elif all(np.array_equal(first[key], other[key]) for key in first):
        logger.warning(
            "all episodes have the same start: the first observations of different seeds are equal. An "
            "evaluation of any number of episodes measures one start (n=1); see if an option of the "
            "environment (env.kwargs) varies it"
        )


def _same(one: np.ndarray | str, two: np.ndarray | str) -> bool:
    """True if two values of an observation are equal but for rounding and noise of rendering."""
    if isinstance(one, str) or isinstance(two, str):
        return one == two
    if one.dtype == np.uint8:
        return one.shape == two.shape and bool((np.abs(one.astype(int) - two) <= VISIBLE).all())
    return one.shape == two.shape and np.allclose(one, two, rtol=1e-4, atol=1e-5)


def check_policy(config: RunConfig, spec: EnvironmentSpec, *, own: bool = False) -> int:
    """Refuse a checkpoint that does not fit the environment; returns how many env steps it is shown.

    Its files are not tried first if the run has done so, or written them itself (`own`).
    """
    from accerl_lerobot.policies.config import env_steps_seen
    from accerl_lerobot.policies.loading import dry_run_config, load_lerobot_config

    policy = (load_lerobot_config if own else dry_run_config)(config.policy)
    needed, offered, renames = policy_features(policy), env_features(spec), config.policy.rename_map
    check_features(needed, offered, renames, "policy.path", config.policy.path)
    return env_steps_seen(policy, learns=isinstance(config.algorithm, OffPolicyConfig))


def check_device(config: RunConfig) -> None:
    """Refuse a device that is not there, or that is not there for Ray's workers."""
    from accerl_lerobot.policies.loading import resolve_device

    if resolve_device(config.policy.device).index and config.launch.engine == "ray":
        hint = "Ray shows each worker its own GPU only; use cuda, and CUDA_VISIBLE_DEVICES to choose"
        raise InputError("policy.device", config.policy.device, hint)


def check_loss(algorithm: RatioConfig) -> None:
    """Refuse an objective, which may be somebody's own, that gives no gradient on a small batch."""
    import torch

    new, old, ones = torch.zeros(3, 2, requires_grad=True), torch.zeros(3, 2), torch.ones(3)
    rest = {"advantage": ones, "value": ones.clone().requires_grad_(), "returns": ones, "entropy": ones}
    try:
        output = algorithm.loss(LossInputs(log_prob_new=new, log_prob_old=old, **rest))
        output.loss.backward()
        sorted(output.metrics)
        if new.grad is None or not new.grad.isfinite().all():
            raise ValueError("no finite gradient reaches log_prob_new")
    except Exception as error:
        why = f"its loss fails on a small batch ({type(error).__name__}: {brief(error)})"
        raise InputError("algorithm.type", algorithm.type, why) from error


def check_start(config: RunConfig, say: Callable[[str], object] = str) -> tuple[EnvironmentSpec, int]:
    """Refuse a run that could not begin, or whose outcome could not be used, as far as can be told; returns
    what the environment offers, and the policy's ``n_obs_steps``."""
    from accerl_lerobot.demos.dataset_files import open_metadata
    from accerl_lerobot.policies.config import check_likelihood, executed_rows, sampler_config

    if config.output_dir is not None and not config.resume:
        check_absent(expanded(config.output_dir, "output_dir"))
    if config.policy.path is None and not config.sft.steps:
        hint = "give a LeRobot checkpoint, or sft.steps > 0 to make one; the recipe quickstart does"
        raise InputError("policy.path", None, hint)
    check_device(config)
    if isinstance(config.algorithm, RatioConfig):
        check_loss(config.algorithm)
    if 0 < config.trainer.updates <= config.trainer.value_warmup_updates:
        logger.warning(
            "the policy will not change: the first trainer.value_warmup_updates=%d are the critic's alone, "
            "and trainer.updates=%d; use more updates, or a shorter warm-up",
            config.trainer.value_warmup_updates, config.trainer.updates,
        )  # fmt: skip
    check_wandb(config.wandb)
    say("looking at policy, environment and data …")
    policy = policy_to_be(config)
    if isinstance(config.algorithm, RatioConfig):
        new = config.policy.path is None and config.sft.init_path is None
        field, sampler = (
            "sft.policy.type" if new else "policy.type",
            sampler_config(config.policy, policy.type),
        )
        check_likelihood(config.algorithm.type, sampler, policy.type, field)
    check_memory(config)
    spec = check_environment(config.env, config.rollout.reward_model)
    off_policy = isinstance(config.algorithm, OffPolicyConfig)
    if off_policy:
        check_imitates(config.algorithm, config.policy, policy)
        decisions = math.ceil(spec.max_steps / executed_rows(policy))
        if config.rollout.segment_length < decisions:
            why = f"algorithm.type={config.algorithm.type} looks at whole episodes; use at least {decisions}"
            raise InputError("rollout.segment_length", config.rollout.segment_length, why)
        if isinstance(config.algorithm, ChunkCriticConfig):
            check_state_model(config, policy, decisions, say)
    renames, offered = config.policy.rename_map, env_features(spec)
    if config.policy.path is not None:
        check_features(policy_features(policy), offered, renames, "policy.path", config.policy.path)
        # Off-policy learning remembers its episodes; others have no use for a dataset then.
        remembered = off_policy and config.dataset.repo_id is not None
        meta = open_metadata(config.dataset) if remembered else None
    else:
        trained = policy if config.sft.init_path is None else sft_policy(config.sft)
        meta = check_training_data(config.sft, config.dataset, trained, spec, renames)
    history = int(policy.n_obs_steps)
    if off_policy and meta is not None and not _say_if_unlike(config, spec, meta, history):
        _check_remembered(config.dataset, spec, meta)
    check_disk(config.output_dir)
    return spec, history


def check_state_model(config: RunConfig, policy: Any, decisions: int, say: Callable[[str], object]) -> None:
    """Refuse a world model that no policy of this kind has, or that such short episodes do not teach."""
    from accerl_lerobot.policies.teacher import state_spec
    from accerl_lerobot.world_model.states import new_state_model

    model, state_size = config.state_model, config.env.state_size * policy.n_obs_steps
    if config.world_model is None and not config.env.tells_state:
        offers = hasattr(config.env, "environment_state")
        hint = "; env.environment_state gives them the simulator's" if offers else ""
        say(f"critic and teacher see a latent state that is learned{hint}")
    if policy.input_features and policy.output_features:
        learns = new_state_model(state_spec(policy, config.policy.rename_map, state_size), model).learns
    else:  # a new policy reads what is offered
        learns = not isinstance(model, SimulatorStateConfig)
    if learns and decisions < 2:
        hint = "an episode is one decision, after which nothing follows; lower policy.n_action_steps"
        raise InputError("world_model.type", model.type, hint)


def _check_remembered(dataset: DatasetConfig, spec: EnvironmentSpec, meta: Any) -> None:
    """Compare a dataset that joins the memory with the environment, and read its labels."""
    from accerl_lerobot.demos.dataset_files import opened
    from accerl_lerobot.demos.episodes import numbers, read_labels

    about = "dataset.repo_id", dataset.repo_id
    check_features(replace(dataset_features(meta), shapes={}), env_features(spec), {}, *about)
    with opened(dataset, meta) as data:
        read_labels(data, dataset)
        check_actions(numbers(data, ACTION, dataset), spec, *about)


def _say_if_unlike(config: RunConfig, spec: EnvironmentSpec, meta: Any, history: int) -> bool:
    """Warn of a dataset that cannot be remembered, which is left out."""
    from accerl_lerobot.algorithms.demonstrations import unlike

    wanted: dict[str, tuple[int, ...]] = {STATE: (spec.state_dim,), **spec.images}
    if config.env.state_size:
        wanted[ENV_STATE] = (config.env.state_size,)
    if history > 1:
        wanted = {name: (history, *shape) for name, shape in wanted.items()}
    if (why := unlike(meta, wanted | {ACTION: (spec.action_dim,)})) is not None:
        logger.warning("%s does not join the memory: %s", config.dataset.repo_id, why)
    return why is not None


def check_training_data(
    sft: SFTConfig,
    dataset: DatasetConfig,
    policy: Any,
    spec: EnvironmentSpec | None,
    rename_map: dict[str, str],
) -> Any:
    """Compare dataset, policy and environment of an SFT; returns the dataset's metadata, if there is one."""
    from accerl_lerobot.demos.dataset_files import open_metadata

    meta = None if dataset.repo_id is None else open_metadata(dataset)
    offered = None if spec is None else env_features(spec)
    about: tuple[str, Any] = "dataset.repo_id", dataset.repo_id
    data = None if meta is None else replace(dataset_features(meta), any_size=resizes(policy))
    source = data or offered  # without a dataset, demonstrations of the environment
    if source is None:
        return None
    renames = _dataset_renames(sft)
    if sft.init_path is not None:
        reader: tuple[str, Any] = "sft.init_path", sft.init_path
        needs = fine_tuned_features(policy, source, renames)
    else:
        reader, renames = ("sft.policy.input_features", list(policy.input_features or ())), {}
        needs = _new_policy_features(policy, source, about)
    if offered is not None and (sft.init_path is not None or data is not None or policy.input_features):
        at = about if sft.init_path is None else reader
        hint = _inputs_hint(data, offered.shapes) if data is not None and sft.init_path is None else ""
        check_features(needs, offered, rename_map, *at, hint=hint)
    if data is not None:
        known = {name: new for name, new in renames.items() if name in data.shapes}
        check_features(replace(needs, tasks=()), data, known, *reader, "dataset")
    if offered is not None and data is not None and sft.init_path is not None:
        # Its cameras may have names of their own.
        vectors = {k: shape for k, shape in data.shapes.items() if k in (STATE, ACTION)}
        check_features(replace(data, shapes=vectors), offered, {}, *about)
    for name, most in ((STATE, "max_state_dim"), (ACTION, "max_action_dim")):
        limit, size = getattr(policy, most, None), needs.shapes.get(name, (0,))[0]
        if limit is not None and limit < size:
            raise InputError(f"sft.policy.{most}", limit, f"{name} has {size} numbers; use at least that")
    if sft.init_path is None:
        _check_new_policy(policy, needs, sft)
    if meta is not None:
        _check_values(sft, dataset, policy, meta, needs, renames, spec)
    return meta


def _new_policy_features(policy: Any, source: Features, about: tuple[str, Any]) -> Features:
    """Features of the source that a new policy reads: those that it names, or all of them."""
    named = policy_features(policy).shapes.keys()
    if ACTION in source.unusable or (STATE in source.unusable and (not named or STATE in named)):
        name = ACTION if ACTION in source.unusable else STATE
        raise InputError(*about, f"no {name} for a policy: {source.unusable[name]}")
    if ACTION not in source.shapes:
        raise InputError(*about, f"no {ACTION}, so that there is nothing to imitate; name another dataset")
    shapes = policy_features(policy).shapes if named else source.shapes
    gray = [name for name, shape in shapes.items() if len(shape) == 3 and shape[0] != 3]
    if gray and not named:
        why = f"{gray[0]} has {shapes[gray[0]][0]} channels, and policies read pictures of 3 channels"
        raise InputError(*about, why + _inputs_hint(source, shapes.keys() - set(gray)))
    return replace(source, shapes=shapes | {ACTION: source.shapes[ACTION]})


def _inputs_hint(data: Features, names: Collection[str]) -> str:
    """How a new policy reads only those of a dataset's features that have these names."""
    kinds = {STATE: "STATE", ENV_STATE: "ENV"}
    inputs = {
        name: {"type": kinds.get(name, "VISUAL"), "shape": list(shape)}
        for name, shape in data.shapes.items()
        if name in names and name != ACTION
    }
    text = f"; or have the policy read less: --sft.policy.input_features='{json.dumps(inputs)}'"
    return text if inputs else ""


def _check_values(
    sft: SFTConfig,
    dataset: DatasetConfig,
    policy: Any,
    meta: Any,
    needs: Features,
    renames: dict[str, str],
    spec: EnvironmentSpec | None,
) -> None:
    """Check statistics and numbers that a policy is trained on."""
    from lerobot.datasets.factory import IMAGENET_STATS

    from accerl_lerobot.demos.dataset_files import opened
    from accerl_lerobot.demos.episodes import numbers
    from accerl_lerobot.demos.sft import picked

    about = "dataset.repo_id", dataset.repo_id
    originals = {new: name for name, new in renames.items()}
    episodes = _extra_argument(sft, "dataset.episodes", [])
    if episodes and sft.pick != "all":
        hint = "--dataset.episodes in sft.extra_args names the episodes already; use sft.pick=all"
        raise InputError("sft.pick", sft.pick, hint)
    if missing := [index for index in episodes if index not in range(meta.total_episodes)]:
        hint = f"--dataset.episodes: no episode {missing[0]}; the dataset has {meta.total_episodes} from 0"
        raise InputError("sft.extra_args", sft.extra_args, hint)
    episodes = episodes or picked(dataset, sft.pick)
    read = {originals.get(name, name) for name in needs.shapes}
    shapes = {name: shape for name, shape in dataset_features(meta).shapes.items() if name in read}
    with opened(dataset, meta, episodes) as data:
        for name in [name for name, shape in shapes.items() if len(shape) < 3]:
            values = numbers(data, name, dataset)
            if name == ACTION and spec is not None:
                check_actions(values, spec, *about)
    stats = {renames.get(name, name): dict(own) for name, own in meta.stats.items()}
    if _extra_argument(sft, "dataset.use_imagenet_stats", True):
        for camera in set(meta.camera_keys) - set(meta.depth_keys):
            stats[renames.get(camera, camera)] |= IMAGENET_STATS
    root = "" if dataset.root is None else f" --root={dataset.root}"
    tool = f"lerobot-edit-dataset --repo_id={dataset.repo_id}{root} --new_root=NEW --new_repo_id=NEW/NEW"
    recompute = f"compute them: {tool} --operation.type=recompute_stats"
    check_statistics(policy, needs, stats, *about, recompute)


def _extra_argument(sft: SFTConfig, name: str, default: Any) -> Any:
    """The value of an argument of ``lerobot-train`` in ``sft.extra_args``; it has the type of `default`."""
    flags = " ".join(sft.extra_args).split(f"--{name}")[1:]
    given = [flag[1:].partition(" --")[0] for flag in flags]
    try:
        found = yaml.safe_load(given[-1]) if given else default
    except yaml.YAMLError:
        found = None
    if not isinstance(found, type(default)):
        hint = f"--{name} is {MEANINGS[name]}"
        raise InputError("sft.extra_args", given[-1], hint)
    return found


def _dataset_renames(sft: SFTConfig) -> dict[str, str]:
    """``lerobot-train``'s ``--rename_map``: the dataset's names → the policy's."""
    return dict(_extra_argument(sft, "rename_map", {}))


def _check_new_policy(policy: Any, source: Features, sft: SFTConfig) -> None:
    """Have LeRobot check the features that it will give a new policy."""
    from lerobot.configs.types import FeatureType, PolicyFeature

    kinds = {STATE: FeatureType.STATE, ENV_STATE: FeatureType.ENV, ACTION: FeatureType.ACTION}
    features = {
        name: PolicyFeature(type=kinds.get(name, FeatureType.VISUAL), shape=shape)
        for name, shape in source.shapes.items()
    }
    policy = copy.deepcopy(policy)
    policy.output_features = {ACTION: features.pop(ACTION)} if ACTION in features else {}
    policy.input_features = policy.input_features or features
    try:
        policy.validate_features()
    except ValueError as error:
        raise InputError("sft.policy", sft.policy, f"LeRobot says: {error}") from error


def check_wandb(config: WandBConfig) -> None:
    """Refuse logging to Weights & Biases where nobody is logged in."""
    if not config.enable or os.environ.get("WANDB_MODE") in ("offline", "disabled", "dryrun"):
        return
    import wandb

    if not wandb.api.api_key:
        hint = "this machine is not logged in: run wandb login, or set WANDB_API_KEY or WANDB_MODE=offline"
        raise InputError("wandb.enable", True, hint)


def check_imitates(algorithm: AlgorithmConfig, config: PolicyConfig, policy: Any) -> None:
    """Refuse policies that cannot imitate a chunk; `policy` is LeRobot's config."""
    from accerl_lerobot.policies.config import ANY, sampler_config

    sampler = sampler_config(config, policy.type)
    if sampler.type not in ("flow", "gaussian", ANY):
        hint = f"use {ANY}, flow or gaussian, or another algorithm.type"
        raise InputError("policy.sampler.type", sampler.type, f"algorithm.type={algorithm.type}: {hint}")
    if sampler.type == ANY and isinstance(algorithm, AWRConfig):
        hint = "awr's critic reads the policy's features, which are not known; use chunk_critic"
        raise InputError("policy.type", policy.type, hint)
    if getattr(policy, "use_relative_actions", False):
        hint = f"algorithm.type={algorithm.type} keeps actions without the state they refer to"
        raise InputError("policy.use_relative_actions", True, f"{hint}; use another algorithm.type")


def policy_to_be(config: RunConfig) -> Any:
    """LeRobot's config of the policy that a run will act with, as far as it is known before an SFT."""
    from accerl_lerobot.policies.config import check_observations, override, sampler_config
    from accerl_lerobot.policies.loading import learning_config

    imitates = isinstance(config.algorithm, OffPolicyConfig)
    if config.policy.path is not None:
        return learning_config(config.policy, imitates=imitates)
    if config.sft.init_path is not None:  # fine-tuning changes its weights alone
        start = replace(config.policy, path=config.sft.init_path, revision=None)
        try:
            return learning_config(start, fine_tuned=True, imitates=imitates)
        except InputError as error:
            if error.field not in ("policy.path", "policy.type", "policy.n_obs_steps"):
                raise
            what = "" if error.field == "policy.path" else f"{error.field.partition('.')[2]}={error.value}: "
            raise InputError("sft.init_path", start.path, what + error.hint) from error
    policy_config = check_sft_policy(config.sft)
    sampler_config(config.policy, config.sft.policy["type"], "sft.policy.type")
    override(policy_config, config.policy)
    check_observations(policy_config, "sft.policy.n_obs_steps")
    return policy_config


def check_sft_policy(config: SFTConfig) -> Any:
    """Let LeRobot build the policy config that the SFT would ask for, and returns it."""
    from lerobot.configs.policies import PreTrainedConfig

    from accerl_lerobot.demos.sft import policy_fields
    from accerl_lerobot.policies.config import check_size

    fields: dict[str, Any] = {k: v for k, v in config.policy.items() if k != "type"}
    kind = config.policy["type"]
    names = policy_fields(kind, "sft.policy.type")
    if config.backbone is not None and "vlm_model_name" not in names:
        hint = f"{kind} has no vision-language backbone; leave the section out"
        raise InputError("sft.backbone", config.backbone, hint)
    for key, value in fields.items():
        if key not in names:
            near = " or ".join(difflib.get_close_matches(key, names, n=3))
            hint = f"LeRobot's {kind} has no such field{f'; did you mean {near}?' if near else ''}"
            raise InputError(f"sft.policy.{key}", value, hint)
        check_size(key, value, f"sft.policy.{key}")
    try:
        # Without a device LeRobot looks for one.
        return draccus.decode(PreTrainedConfig.get_choice_class(kind), {"device": "cpu"} | fields)
    except draccus.utils.DraccusException as error:
        chain: list[Any] = list(causes(error))
        where = next((e.key_path[0] for e in chain if getattr(e, "key_path", ())), None)
        name, given = ("sft.policy", fields) if where is None else (f"sft.policy.{where}", fields.get(where))
        raise InputError(name, given, f"LeRobot says: {' '.join(str(chain[-1]).split())}") from error


def sft_policy(config: SFTConfig) -> Any:
    """LeRobot's config of the policy that an SFT trains, of any of LeRobot's types."""
    if config.init_path is None:
        return check_sft_policy(config)
    from lerobot.configs.policies import PreTrainedConfig

    from accerl_lerobot.checkpoint.safety import FileSource, read_json
    from accerl_lerobot.policies.config import check_sizes, register_policies
    from accerl_lerobot.policies.peft_adapters import weights_folder
    from accerl_lerobot.policies.untrusted import CONFIG, fetched_checkpoint, reason

    folder = fetched_checkpoint(config.init_path, None, "sft.init_path")
    origin = FileSource("sft.init_path", config.init_path)
    weights_folder(folder, origin)  # what an adapter is for
    register_policies(str(read_json(folder / CONFIG, origin).get("type")))
    try:
        policy = PreTrainedConfig.from_pretrained(folder)
    except Exception as error:  # LeRobot takes the file at its word, and may fail over any of it
        hint = f"its config.json is not one of this LeRobot's policies ({reason(error)})"
        raise InputError("sft.init_path", config.init_path, hint) from error
    check_sizes(policy, origin)
    return policy
