# SPDX-License-Identifier: Apache-2.0
"""Which policy is improved, how it explores, what of it is trained; free of torch."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal

from accerl_lerobot.checkpoint.safety import check_remote_code
from accerl_lerobot.config.ranges import Device, Range, Section
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.samplers import SamplerConfig

if TYPE_CHECKING:
    from accerl_lerobot.policies.base import PolicyAdapter


@dataclass(frozen=True, kw_only=True)
class ValueHeadConfig(Section, section="policy.value_head"):
    """The critic that sits on the policy's own features."""

    pooling: Literal["attention", "mean"] = "attention"
    """attention (a learned query over the tokens, as in AcceRL) or mean."""
    hidden: Annotated[int, Range("[1, 65536]")] = 128
    """Width of the hidden layer."""
    detach: bool = True
    """True: the critic reads the backbone without shaping it (AcceRL). False lets its gradient in; measured
    on a policy of 0.4 M parameters (MetaWorld door-open, 200 updates) that took success from 0.65 to 0.00,
    against 0.98 when detached."""
    bins: Annotated[int, Range("[0, 100000]")] = 0
    """0: V is one number, regressed with squared error. From 2 up: a distribution over so many returns evenly
    spaced in `value_range`, learnt by cross-entropy with two-hot targets."""
    value_range: tuple[float, float] = (-1.0, 1.0)
    """With `bins`: smallest and largest return; what lies outside is taken as the nearest of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bins == 1:
            raise InputError("policy.value_head.bins", self.bins, "use 0 for a scalar, or at least 2")
        if not self.value_range[0] < self.value_range[1]:
            raise InputError("policy.value_head.value_range", self.value_range, "use [smallest, largest]")


@dataclass(frozen=True, kw_only=True)
class TuningConfig(Section, section="policy.tuning"):
    """Which of the policy's weights are trained and published; the critic always is."""

    mode: Literal["checkpoint", "full", "expert", "lora"] = "checkpoint"
    """checkpoint: what its LeRobot config leaves trainable. full: everything. expert: the action expert
    without the vision-language backbone. lora: low-rank adapters; saved merged, so that stock LeRobot loads
    the result."""
    rank: Annotated[int, Range("[1, 65536]")] = 16
    """lora: rank of the adapters."""
    alpha: Annotated[int, Range("[1, 65536]")] = 16
    """lora: the adapters' output is scaled by alpha / rank."""
    targets: str | None = None
    """lora: regular expression that must match the whole name of a linear layer inside the policy; those
    inside PyTorch's own attention are passed over, as it reads their weights without calling them. None: what
    LeRobot's own PEFT training adapts in this policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            re.compile(self.targets or "")
        except re.error as error:
            remedy = f"not a regular expression: {error}"
            raise InputError("policy.tuning.targets", self.targets, remedy) from error


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Section, section="policy"):
    """Which policy is improved, and how it explores."""

    path: str | None = None
    """Local checkpoint directory or Hub id (``lerobot/smolvla_base``). None: the run's own SFT makes it."""
    revision: str | None = None
    """Hub revision."""
    trust_remote_code: bool = False
    """True if Python code from a Hub repository that the checkpoint names, such as a vision encoder's, is run
    with your rights. It needs `code_revision`."""
    code_revision: str | None = None
    """Commit of that repository, 40 hexadecimal digits: the one whose code you have read. No other is run."""
    device: Device = "auto"
    """cpu, cuda, or auto."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32, or bf16: the network runs in bfloat16 under autocast, weights and log-probs stay in fp32. A
    ``dtype`` in the checkpoint's LeRobot config is taken as float32, and saved so: updates of RL are smaller
    than bfloat16 resolves."""
    sampler: SamplerConfig | None = None
    """How it explores. None: the first family of its policy type, with that family's defaults."""
    value_head: ValueHeadConfig = field(default_factory=ValueHeadConfig)
    tuning: TuningConfig = field(default_factory=TuningConfig)
    rename_map: dict[str, str] = field(default_factory=dict)
    """World feature name → policy feature name, as in LeRobot's ``--rename_map``."""
    num_steps: Annotated[int, Range("[1, 10000]")] | None = None
    """Denoising steps; None keeps the checkpoint's. Written into what is saved."""
    n_action_steps: Annotated[int, Range("[1, 100000]")] | None = None
    """Rows of a chunk that are executed before the next decision; None keeps the checkpoint's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_remote_code(self.trust_remote_code, self.code_revision, "policy")


Load = Callable[[PolicyConfig], "PolicyAdapter"]


def loader(load: Load | None) -> Load:
    """Function that makes a worker's adapter: `load`, or the one that loads LeRobot's checkpoints."""
    if load is not None:
        return load
    from accerl_lerobot.policies.loading import load_adapter

    return load_adapter
