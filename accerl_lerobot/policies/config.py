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
"""Which policy is improved, how it explores, what of it is trained; free of torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.samplers import SamplerConfig
from accerl_lerobot.safety import check_remote_code

if TYPE_CHECKING:
    from accerl_lerobot.policies.base import PolicyAdapter


@dataclass(frozen=True, kw_only=True)
class ValueHeadConfig:
    """The critic that sits on the policy's own features."""

    pooling: str = "attention"
    """attention (a learned query over the tokens, as in AcceRL) or mean."""
    hidden: int = 128
    """Width of the hidden layer."""
    detach: bool = True
    """True: the critic reads the backbone without shaping it (AcceRL). False lets its gradient in; measured
    on a policy of 0.4 M parameters (MetaWorld door-open, 200 updates) that took success from 0.65 to 0.00,
    against 0.98 when detached."""
    bins: int = 0
    """0: V is one number, regressed with squared error. From 2 up: a distribution over so many returns evenly
    spaced in `value_range`, learnt by cross-entropy with two-hot targets."""
    value_range: tuple[float, float] = (-1.0, 1.0)
    """With `bins`: smallest and largest return; what lies outside is taken as the nearest of them."""

    def __post_init__(self) -> None:
        if self.pooling not in ("attention", "mean"):
            raise InputError("policy.value_head.pooling", self.pooling, "use attention or mean")
        if self.hidden < 1:
            raise InputError("policy.value_head.hidden", self.hidden, "use a positive width")
        if self.bins < 0 or self.bins == 1:
            raise InputError("policy.value_head.bins", self.bins, "use 0 for a scalar, or at least 2")
        if not self.value_range[0] < self.value_range[1]:
            raise InputError("policy.value_head.value_range", self.value_range, "use [smallest, largest]")


@dataclass(frozen=True, kw_only=True)
class TuningConfig:
    """Which of the policy's weights are trained and published; the critic always is."""

    mode: str = "checkpoint"
    """checkpoint: what its LeRobot config leaves trainable. full: everything. expert: the action expert
    without the vision-language backbone. lora: low-rank adapters; saved merged, so that stock LeRobot loads
    the result."""
    rank: int = 16
    """lora: rank of the adapters, ≥ 1."""
    alpha: int = 16
    """lora: the adapters' output is scaled by alpha / rank; ≥ 1."""
    targets: str | None = None
    """lora: regular expression that must match the whole name of a linear layer inside the policy; those
    inside PyTorch's own attention are passed over, as it reads their weights without calling them. None: what
    LeRobot's own PEFT training adapts in this policy."""

    def __post_init__(self) -> None:
        if self.mode not in ("checkpoint", "full", "expert", "lora"):
            raise InputError("policy.tuning.mode", self.mode, "use checkpoint, full, expert or lora")
        for name in ("rank", "alpha"):
            if getattr(self, name) < 1:
                raise InputError(f"policy.tuning.{name}", getattr(self, name), "use at least 1")


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Which policy is improved, and how it explores."""

    path: str | None = None
    """Local checkpoint directory or Hub id (``lerobot/smolvla_base``). None: the run's own SFT makes it."""
    revision: str | None = None
    """Hub revision."""
    trust_remote_code: bool = False
    """Whether Python code from a Hub repository that the checkpoint names, such as a vision encoder's, is run
    with your rights. It needs `code_revision`."""
    code_revision: str | None = None
    """Commit of that repository, 40 hexadecimal digits: the one whose code you have read. No other is run."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    precision: str = "fp32"
    """fp32, or bf16: the network runs in bfloat16 under autocast, weights and log-probs stay in fp32. A
    ``dtype`` in the checkpoint's LeRobot config is taken as float32, and saved so: updates of RL are smaller
    than bfloat16 resolves."""
    sampler: SamplerConfig | None = None
    """How it explores. None: the first family of its policy type, with that family's defaults."""
    value_head: ValueHeadConfig = field(default_factory=ValueHeadConfig)
    tuning: TuningConfig = field(default_factory=TuningConfig)
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
        check_remote_code(self.trust_remote_code, self.code_revision, "policy")
        if self.precision not in ("fp32", "bf16"):
            raise InputError("policy.precision", self.precision, "use fp32 or bf16")


Load = Callable[[PolicyConfig], "PolicyAdapter"]


def loader(load: Load | None) -> Load:
    """What makes a worker's adapter: `load`, or what loads LeRobot's checkpoints."""
    if load is not None:
        return load
    from accerl_lerobot.policies.loading import load_adapter

    return load_adapter
