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
"""What can be refused before any long work although it takes LeRobot to know it.

`config` checks what plain numbers can say; this asks LeRobot, which costs its import.
"""

from __future__ import annotations

import difflib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import draccus

from accerl_lerobot import ray_environment
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.config import RunConfig
    from accerl_lerobot.demos.sft import SFTConfig


def check_start(config: RunConfig) -> int:
    """Refuses a run that could not begin: no policy, no dataset, or an SFT whose outcome RL could not use.

    Returns:
        The policy's ``n_obs_steps``.

    Raises:
        InputError: see above; more ranks than GPUs, or no GPU to offload from; also what `check_sft_policy`
            raises.
    """
    if config.policy.path is None and not config.sft.steps:
        remedy = "give a LeRobot checkpoint, or sft.steps > 0 to make one; recipes/quickstart.yaml does"
        raise InputError("policy.path", None, remedy)
    if config.trainer.ranks > 1 and config.policy.device != "cpu" and config.launch.address is None:
        import torch

        config.trainer.gpu_shares(torch.cuda.device_count(), others=1)
    if config.trainer.cpu_offload:
        from accerl_lerobot.policies.loading import resolve_device

        if resolve_device(config.policy.device).type == "cpu":
            remedy = "there is no GPU here, and the CPU's memory has everything already; leave the field out"
            raise InputError("trainer.cpu_offload", True, remedy)
    if config.policy.path is None and config.dataset.repo_id is not None:
        from accerl_lerobot.demos.windows import open_metadata

        open_metadata(config.dataset)
    return int(policy_to_be(config).n_obs_steps)


def policy_to_be(config: RunConfig) -> Any:
    """LeRobot's config of the policy that a run will act with, as far as it is known before an SFT.

    Raises:
        InputError: there is no such checkpoint; RL has no likelihood for it; what `check_sft_policy` raises.
    """
    from accerl_lerobot.policies.loading import (
        check_observations,
        check_type,
        load_lerobot_config,
        override,
        sampler_config,
    )

    if config.policy.path is not None:
        return load_lerobot_config(config.policy)
    if config.sft.init_path is not None:  # fine-tuning changes its weights alone
        start = replace(config.policy, path=config.sft.init_path, revision=None)
        try:
            return load_lerobot_config(start)
        except InputError as error:
            if error.field not in ("policy.path", "policy.type", "policy.n_obs_steps"):
                raise
            said = (
                ""
                if error.field == "policy.path"
                else f"{error.field.removeprefix('policy.')}={error.value}: "
            )
            raise InputError("sft.init_path", start.path, said + error.remedy) from error
    policy_config = check_sft_policy(config.sft)
    kind = check_type(config.sft.policy["type"], "sft.policy.type", "RL needs a likelihood: ")
    sampler = sampler_config(config.policy, kind)
    override(policy_config, config.policy)
    sampler.override(policy_config)
    check_observations(policy_config, "sft.policy.n_obs_steps")
    return policy_config


def check_sft_policy(config: SFTConfig) -> Any:
    """Lets LeRobot build the policy config that the SFT would ask for, and returns it.

    Raises:
        InputError: LeRobot has no such policy, no such field, or refuses a value; or cannot fine-tune it.
    """
    from lerobot.configs.policies import PreTrainedConfig

    from accerl_lerobot.demos.sft import policy_fields

    fields: dict[str, Any] = {k: v for k, v in config.policy.items() if k != "type"}
    kind = config.policy["type"]
    names = policy_fields(kind, "sft.policy.type")
    if config.backbone is not None and "vlm_model_name" not in names:
        remedy = f"{kind} has no vision-language backbone; leave the section out"
        raise InputError("sft.backbone", config.backbone, remedy)
    for key, value in fields.items():
        if key not in names:
            near = " or ".join(difflib.get_close_matches(key, names, n=3))
            remedy = f"LeRobot's {kind} has no such field{f'; did you mean {near}?' if near else ''}"
            raise InputError(f"sft.policy.{key}", value, remedy)
    try:
        # Without a device LeRobot looks for one.
        return draccus.decode(PreTrainedConfig.get_choice_class(kind), {"device": "cpu"} | fields)
    except draccus.utils.DraccusException as error:
        raise _as_input_error(error, fields) from error


def _as_input_error(error: BaseException, fields: dict[str, Any]) -> InputError:
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(cause)
    located = next((e for e in chain if getattr(e, "key_path", ())), None)
    text = " ".join(str(chain[-1]).split())
    if located is None:
        return InputError("sft.policy", fields, f"LeRobot says: {text}")
    key = located.key_path[0]  # type: ignore[attr-defined]
    return InputError(f"sft.policy.{key}", fields.get(key), f"LeRobot says: {text}")


def check_placement(config: RunConfig) -> list[str]:
    """Plans where the workers will be, so that what does not fit is refused before anything long; as lines.

    Raises:
        InputError: they do not fit, or the cluster that is to be joined is not as it has to be.
    """
    if config.launch.engine == "local":
        return []
    if config.launch.address is None:
        from accerl_lerobot.placement import planned, this_machine

        return list(planned([this_machine()], config).rows())
    ray_environment.prepare(joins=True)
    from accerl_lerobot.cluster import rehearse

    return rehearse(config)
