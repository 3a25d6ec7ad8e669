# SPDX-License-Identifier: Apache-2.0
"""Checks of a run before any work begins: devices, logins, disk, and that its parts fit each other.

`config` checks what plain numbers can say; this asks LeRobot, the environment and the machine.
"""

from __future__ import annotations

import contextlib
import difflib
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import draccus
import numpy as np

from accerl_lerobot.algorithms import AWRConfig, ChunkCriticConfig, OffPolicyConfig, RatioConfig
from accerl_lerobot.envs import (
    EnvConfig,
    EnvironmentSpec,
    JudgedEnvironment,
    RewardModelConfig,
    environment_error,
    make_environment,
)
from accerl_lerobot.errors import InputError, causes
from accerl_lerobot.experience import Observation, nonfinite
from accerl_lerobot.policies.features import (
    ACTION,
    ENV_STATE,
    STATE,
    Features,
    check_actions,
    check_features,
    dataset_features,
    env_features,
    fine_tuned_features,
    policy_features,
    resizes,
)
from accerl_lerobot.world_model.config import SimulatorStateConfig

if TYPE_CHECKING:
    from accerl_lerobot.algorithms import AlgorithmConfig
    from accerl_lerobot.demos.record import DemosConfig
    from accerl_lerobot.demos.sft import SFTConfig
    from accerl_lerobot.engines.config import DatasetConfig, RunConfig
    from accerl_lerobot.evaluation import EvaluationConfig
    from accerl_lerobot.metrics import WandBConfig
    from accerl_lerobot.policies.config import PolicyConfig

logger = logging.getLogger(__name__)

SLOW_S = 30.0  # an environment that takes longer to reset, such as a robot, is reset only once to be checked
VISIBLE = 25  # levels of a pixel that rendering alone does not change


def check_environment(env: EnvConfig, reward_model: RewardModelConfig | None = None) -> EnvironmentSpec:
    """Build and reset an environment, so that its errors show before any long work; returns its spec."""
    with contextlib.closing(make_environment(env, reward_model=reward_model)) as environment:
        task = environment.spec.tasks[0]
        began = time.monotonic()
        try:
            first = environment.reset(0, task)
            slow = time.monotonic() - began > SLOW_S
            if not slow:
                other = environment.reset(1, task)
                again = environment.reset(0, task)
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
    if not _same(first, again):
        logger.warning(
            "the environment's reset ignores its seed: the same seed gives different first observations. No "
            "episode can be repeated, and success before and after training is measured on different starts"
        )
    elif _same(first, other, noise=0):
        logger.warning(
            "all episodes have the same start: the first observations of different seeds are equal. An "
            "evaluation of any number of episodes measures one start (n=1); see if an option of the "
            "environment (env.kwargs) varies it"
        )


def _same(one: Observation, two: Observation, noise: int = VISIBLE) -> bool:
    """True if two observations are equal but for rounding and so many levels of a pixel."""
    for name, array in one.items():
        if isinstance(array, str):
            continue
        slack = noise if array.dtype == np.uint8 else 1e-5
        if not np.allclose(array.astype(float), two[name], rtol=1e-4, atol=slack):
            return False
    return True


def check_policy(config: RunConfig, spec: EnvironmentSpec, *, own: bool = False) -> int:
    """Refuse a checkpoint that does not fit the environment; returns how many env steps it is shown.

    Its files are not tried first if the run has done so, or written them itself (`own`).
    """
    from accerl_lerobot.policies.config import env_steps_seen
    from accerl_lerobot.policies.loading import dry_run_config, load_lerobot_config

    load = load_lerobot_config if own else dry_run_config
    policy = load(config.policy)
    _check_reads(policy, config.policy, spec)
    return env_steps_seen(policy, learns=isinstance(config.algorithm, OffPolicyConfig))


def _check_reads(policy: Any, config: PolicyConfig, spec: EnvironmentSpec) -> None:
    """Refuse a checkpoint that reads what the environment does not offer; `policy` is LeRobot's config."""
    needed = policy_features(policy)
    check_features(needed, env_features(spec), config.rename_map, "policy.path", config.path)


def check_device(config: RunConfig) -> None:
    """Refuse a device that is not there, or that is not there for Ray's workers."""
    from accerl_lerobot.policies.loading import resolve_device

    if resolve_device(config.policy.device).index and config.launch.engine == "ray":
        hint = "Ray shows each worker its own GPU only; use cuda, and CUDA_VISIBLE_DEVICES to choose"
        raise InputError("policy.device", config.policy.device, hint)


def check_start(config: RunConfig, say: Callable[[str], object] = str) -> EnvironmentSpec:
    """Refuse a run that cannot begin, or whose policy could not be used, as far as this is known before it.

    Returns:
        The spec of the environment.
    """
    from accerl_lerobot.policies.config import check_likelihood, sampler_config

    algorithm = config.algorithm
    if config.policy.path is None and not config.sft.steps:
        hint = "give a LeRobot checkpoint, or sft.steps > 0 to make one; the recipe quickstart does"
        raise InputError("policy.path", None, hint)
    check_device(config)
    if 0 < config.trainer.updates <= config.trainer.value_warmup_updates:
        logger.warning(
            "the policy will not change: the first trainer.value_warmup_updates=%d are the critic's alone, "
            "and trainer.updates=%d; use more updates, or a shorter warm-up",
            config.trainer.value_warmup_updates, config.trainer.updates,
        )  # fmt: skip
    check_wandb(config.wandb)
    say("looking at policy, environment and data …")
    policy = policy_to_be(config)
    if isinstance(algorithm, RatioConfig):
        new = config.policy.path is None and config.sft.init_path is None
        field = "sft.policy.type" if new else "policy.type"
        check_likelihood(algorithm.type, sampler_config(config.policy, policy.type), policy.type, field)
    spec = check_environment(config.env, config.rollout.reward_model)
    check_evaluation(config.evaluation, config.env, spec)
    if config.policy.path is None:
        if config.dataset.repo_id is None:
            check_demonstrations(config.demos, spec)
        check_training_data(config.sft, config.dataset, policy, spec, config.policy.rename_map)
    else:
        _check_reads(policy, config.policy, spec)
    if isinstance(algorithm, OffPolicyConfig):
        check_off_policy(config, policy, spec)
        if config.dataset.repo_id is not None:
            _check_remembered(config, spec, int(policy.n_obs_steps))
    return spec


def check_demonstrations(config: DemosConfig, spec: EnvironmentSpec) -> None:
    """Refuse a dataset in which tasks have no episode."""
    tasks = len(spec.tasks)
    if config.episodes < tasks:
        raise InputError("demos.episodes", config.episodes, f"env has {tasks} tasks; use {tasks} or more")


def check_evaluation(config: EvaluationConfig, env: EnvConfig, spec: EnvironmentSpec) -> None:
    """Warn of an evaluation that leaves tasks out, or repeats episodes."""
    tasks = len(spec.tasks)
    counts = {"episodes": config.episodes}
    if config.every_updates:
        counts["episodes_during"] = config.episodes_during
    for name, count in counts.items():
        if count < tasks:
            logger.warning(
                "evaluation.%s=%d: the last %d of %d tasks are left out", name, count, tasks - count, tasks
            )
        if env.starts and count > env.starts * tasks:
            logger.warning(
                "evaluation.%s=%d: each task has %d starts, so that episodes are repeated, and the intervals "
                "are too narrow", name, count, env.starts,
            )  # fmt: skip


def check_off_policy(config: RunConfig, policy: Any, spec: EnvironmentSpec) -> None:
    """Refuse a policy, segments or states that an off-policy algorithm cannot learn from."""
    from accerl_lerobot.policies.config import executed_rows

    algorithm = config.algorithm
    check_imitates(algorithm, config.policy, policy)
    decisions = math.ceil(spec.max_steps / executed_rows(policy))
    if config.rollout.segment_length < decisions:
        why = f"algorithm.type={algorithm.type} looks at whole episodes; use at least {decisions}"
        raise InputError("rollout.segment_length", config.rollout.segment_length, why)
    if isinstance(algorithm, ChunkCriticConfig):
        check_state_model(config, policy, spec, decisions)


def check_state_model(config: RunConfig, policy: Any, spec: EnvironmentSpec, decisions: int) -> None:
    """Refuse a world model that no policy of this kind has, or that such short episodes do not teach."""
    from accerl_lerobot.policies.teacher import state_spec
    from accerl_lerobot.world_model.states import new_state_model

    model = config.state_model
    learns = not isinstance(model, SimulatorStateConfig)
    if policy.input_features and policy.output_features:  # a new policy reads the features that are offered
        numbers = spec.environment_state_dim * policy.n_obs_steps
        learns = new_state_model(state_spec(policy, config.policy.rename_map, numbers), model).learns
    if learns and decisions < 2:
        hint = "an episode is one decision, after which nothing follows; lower policy.n_action_steps"
        raise InputError("world_model.type", model.type, hint)


def _check_remembered(config: RunConfig, spec: EnvironmentSpec, history: int) -> None:
    """Compare a dataset that joins the memory with the environment, or warn that it does not join."""
    from accerl_lerobot.demos.dataset_files import numbers, open_metadata, opened, read_labels
    from accerl_lerobot.run.adapter import unlike

    dataset = config.dataset
    meta = open_metadata(dataset)
    about = ("dataset.repo_id", dataset.repo_id)
    shapes: dict[str, tuple[int, ...]] = {STATE: (spec.state_dim,), **spec.images}
    if spec.environment_state_dim:
        shapes[ENV_STATE] = (spec.environment_state_dim,)
    if history > 1:
        shapes = {name: (history, *shape) for name, shape in shapes.items()}
    why = unlike(meta, shapes | {ACTION: (spec.action_dim,)})
    if why is not None:
        logger.warning("%s does not join the memory: %s", dataset.repo_id, why)
        return
    check_features(replace(dataset_features(meta), shapes={}), env_features(spec), {}, *about)
    with opened(dataset, meta) as data:
        read_labels(data, dataset)
        check_actions(numbers(data, ACTION, dataset), spec, *about)


def check_training_data(
    sft: SFTConfig,
    dataset: DatasetConfig,
    policy: Any,
    spec: EnvironmentSpec | None,
    rename_map: dict[str, str],
) -> None:
    """Compare policy and environment of an SFT with the dataset, or with what the environment records."""
    from accerl_lerobot.demos.dataset_files import numbers, open_metadata, opened
    from accerl_lerobot.demos.sft import picked

    if any("rename_map" in argument for argument in sft.extra_args):
        return  # with names of its own, LeRobot compares dataset and policy
    offered = None if spec is None else env_features(spec)
    source = offered
    about: tuple[str, Any] = "dataset.repo_id", dataset.repo_id
    if dataset.repo_id is not None:
        meta = open_metadata(dataset)
        source = replace(dataset_features(meta), any_size=resizes(policy))
    assert source is not None  # a run has an environment, and SFT alone a dataset
    if sft.init_path is None:
        needs = _new_policy_features(policy, source, about)
        start = about
        hint = "; or name fewer in sft.policy.input_features"
    else:
        needs = fine_tuned_features(policy, source)
        start = ("sft.init_path", sft.init_path)
        hint = ""
        if source is not offered:
            check_features(replace(needs, tasks=()), source, {}, *start, "dataset")
            if offered is not None:
                # Its cameras may have names of their own.
                vectors = {name: shape for name, shape in source.shapes.items() if name in (STATE, ACTION)}
                check_features(replace(source, shapes=vectors), offered, {}, *about)
    if offered is not None:
        check_features(needs, offered, rename_map, *start, hint=hint)
    _check_padding(policy, needs, sft)
    if spec is not None and source is not offered:
        with opened(dataset, meta, picked(dataset, sft.pick)) as read:
            check_actions(numbers(read, ACTION, dataset), spec, *about)


def _new_policy_features(policy: Any, source: Features, about: tuple[str, Any]) -> Features:
    """Features of the source that a new policy reads: those that it names, or all of them."""
    named = policy_features(policy).shapes
    for name, why in source.unusable.items():
        if name == ACTION or not named or name in named:
            raise InputError(*about, f"no {name} for a policy: {why}")
    if ACTION not in source.shapes:
        raise InputError(*about, f"no {ACTION}, so that there is nothing to imitate; name another dataset")
    return replace(source, shapes=(named or source.shapes) | {ACTION: source.shapes[ACTION]})


def _check_padding(policy: Any, needs: Features, sft: SFTConfig) -> None:
    """Refuse a policy that pads to fewer numbers than there are: LeRobot would fail in the first step."""
    for field, name in (("max_state_dim", STATE), ("max_action_dim", ACTION)):
        most = getattr(policy, field, None)
        size = math.prod(needs.shapes.get(name, (0,)))
        if most is None or size <= most:
            continue
        hint = f"{name} has {size} numbers"
        if sft.init_path is not None:
            raise InputError("sft.init_path", sft.init_path, f"its {field} is {most}, but {hint}")
        raise InputError(f"sft.policy.{field}", most, f"{hint}; use {size}")


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
    from accerl_lerobot.policies.loading import dry_run_config

    if config.policy.path is not None:
        return dry_run_config(config.policy, learns=True)
    if config.sft.init_path is not None:  # fine-tuning changes its weights alone
        start = replace(config.policy, path=config.sft.init_path, revision=None)
        try:
            return dry_run_config(start, fine_tuned=True, learns=True)
        except InputError as error:
            if error.field not in ("policy.path", "policy.type", "policy.n_obs_steps"):
                raise
            hint = error.hint
            if error.field != "policy.path":
                hint = f"{error.field.removeprefix('policy.')}={error.value}: {hint}"
            raise InputError("sft.init_path", start.path, hint) from error
    policy_config = check_sft_policy(config.sft)
    sampler_config(config.policy, config.sft.policy["type"])
    override(policy_config, config.policy)
    check_observations(policy_config, "sft.policy.n_obs_steps")
    return policy_config


def check_sft_policy(config: SFTConfig) -> Any:
    """Let LeRobot build the policy config that the SFT would ask for, and returns it."""
    from lerobot.configs.policies import PreTrainedConfig

    from accerl_lerobot.demos.sft import policy_fields
    from accerl_lerobot.policies.config import check_size

    kind = config.policy["type"]
    fields = {name: value for name, value in config.policy.items() if name != "type"}
    names = policy_fields(kind, "sft.policy.type")
    if config.backbone is not None and "vlm_model_name" not in names:
        hint = f"{kind} has no vision-language backbone; leave the section out"
        raise InputError("sft.backbone", config.backbone, hint)
    for name, value in fields.items():
        if name not in names:
            near = " or ".join(difflib.get_close_matches(name, names)) or "one of its own"
            raise InputError(f"sft.policy.{name}", value, f"LeRobot's {kind} has no such field; use {near}")
        check_size(name, value, f"sft.policy.{name}")
    try:
        # Without a device LeRobot looks for one.
        return draccus.decode(PreTrainedConfig.get_choice_class(kind), {"device": "cpu"} | fields)
    except draccus.utils.DraccusException as error:
        chain: list[Any] = list(causes(error))
        hint = f"LeRobot says: {chain[-1]}"
        for link in chain:
            if getattr(link, "key_path", ()):
                name = link.key_path[0]
                raise InputError(f"sft.policy.{name}", fields.get(name), hint) from error
        raise InputError("sft.policy", fields, hint) from error


def sft_policy(config: SFTConfig) -> Any:
    """LeRobot's config of the policy that an SFT trains, of any of LeRobot's types."""
    if config.init_path is None:
        return check_sft_policy(config)
    from lerobot.configs.policies import PreTrainedConfig

    from accerl_lerobot.checkpoint.safety import FileSource, read_json
    from accerl_lerobot.policies.config import register_policies
    from accerl_lerobot.policies.loading import weights_folder
    from accerl_lerobot.policies.untrusted import CONFIG, fetched_checkpoint, refusing

    folder = fetched_checkpoint(config.init_path, None, "sft.init_path")
    origin = FileSource("sft.init_path", config.init_path)
    weights_folder(folder, origin)  # what an adapter is for
    register_policies(str(read_json(folder / CONFIG, origin).get("type")))
    with refusing(origin, "its config.json is not one of this LeRobot's policies"):
        return PreTrainedConfig.from_pretrained(folder)
