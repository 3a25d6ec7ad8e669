# SPDX-License-Identifier: Apache-2.0
"""The policy section of a recipe, and the policy types that have a likelihood here. Free of torch."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import draccus

from accerl_lerobot.config.parsing import import_plugins, imported
from accerl_lerobot.config.ranges import Commit, Device, Range, Section, check, registered_name
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE
from accerl_lerobot.policies.deferred import import_policies

Precision = Literal["fp32", "bf16", "auto"]


@dataclass(frozen=True, kw_only=True)
class SamplerConfig(Section, draccus.ChoiceRegistry, section="policy.sampler"):
    """Base of every sampler config; one for each family of likelihood."""

    family: ClassVar[str]
    """``module:class`` of the `family.Family`, made from the model and this config."""

    type = registered_name


@SamplerConfig.register_subclass("flow")
@dataclass(frozen=True, kw_only=True)
class FlowSamplerConfig(SamplerConfig):
    """Flow policies: Gaussian noise on the denoised chunk; see `flow.py`."""

    family = "accerl_lerobot.policies.flow:FlowFamily"

    noise_level: Annotated[float, Range("(0, 2]")] = 0.2
    """Std of the noise on every action, in normalised units."""


@SamplerConfig.register_subclass("tokens")
@dataclass(frozen=True, kw_only=True)
class TokenSamplerConfig(SamplerConfig):
    """Token policies: every token is drawn from the softmax of its logits; see `tokens.py`."""

    family = "accerl_lerobot.policies.tokens:TokenFamily"

    temperature: Annotated[float, Range("(0, 10]")] = 1.0
    """Logits are divided by it, when acting and when re-scoring: below 1 the most likely tokens are
    drawn more often, above 1 less often."""


@SamplerConfig.register_subclass("gaussian")
@dataclass(frozen=True, kw_only=True)
class GaussianSamplerConfig(SamplerConfig):
    """Policies that predict one chunk, with a Gaussian around it; see `gaussian.py`."""

    family = "accerl_lerobot.policies.gaussian:GaussianFamily"

    std: Annotated[float, Range("(0, 2]")] = 0.2
    """Std of every action at the start, normalised. It is learned, from a quarter to 2.5 times as much."""

    @property
    def bounds(self) -> tuple[float, float]:
        return self.std / 4, 2.5 * self.std


@SamplerConfig.register_subclass("diffusion")
@dataclass(frozen=True, kw_only=True)
class DiffusionSamplerConfig(SamplerConfig):
    """Diffusion policies, each denoising step a Gaussian (DPPO); see `diffusion.py`.

    How many steps there are is ``policy.num_steps``.
    """

    family = "accerl_lerobot.policies.diffusion:DiffusionFamily"

    std_min: Annotated[float, Range("(0, 1]")] = 0.1
    """Lower bound of a step's std while exploring, in normalised units. The last step has no noise
    of its own, so this is the executed action's std around what the chain arrives at."""


@SamplerConfig.register_subclass("chunk_noise")
@dataclass(frozen=True, kw_only=True)
class ChunkNoiseConfig(SamplerConfig):
    """Policies of any type: Gaussian noise on the chunk that LeRobot's sampler gives; see `stock.py`.

    It has no likelihood, so it is for the algorithms that learn from a memory.
    """

    family = "accerl_lerobot.policies.stock:StockAdapter"

    noise_level: Annotated[float, Range("[0, 2]")] = 0.25
    """Std of the noise on every action, in normalised units."""


@dataclass(frozen=True, kw_only=True)
class TuningConfig(Section, section="policy.tuning"):
    """Which of the policy's weights are trained and published; the critic always is."""

    mode: Literal["checkpoint", "full", "expert", "lora"] = "checkpoint"
    """checkpoint: what its LeRobot config leaves trainable. full: everything. expert: the action expert
    without the vision-language backbone. lora: low-rank adapters; saved merged, for stock LeRobot."""
    rank: Annotated[int, Range("[1, 65536]")] = 16
    """lora: rank of the adapters, whose output is not scaled."""
    targets: str | None = None
    """lora: regular expression that must match the whole name of a linear layer inside the policy; those
    inside PyTorch's own attention are passed over, as it reads their weights without calling them. None: what
    LeRobot's own PEFT training adapts in this policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            re.compile(self.targets or "")
        except re.error as error:
            hint = f"not a regular expression: {error}"
            raise InputError("policy.tuning.targets", self.targets, hint) from error


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Section, section="policy"):
    """Which policy is improved, and how it explores."""

    path: str | None = None
    """Local checkpoint directory or Hub id (``lerobot/smolvla_base``). None: the run's own SFT makes it."""
    revision: str | None = None
    """Hub revision."""
    discover_packages_path: str | None = None
    """Package to import that registers the checkpoint's policy type, where that is not one of ours and the
    package is not an installed ``lerobot_policy_*``."""
    trust_remote_code: Commit | None = None
    """Commit of the Hub repository that the checkpoint names, such as a vision encoder's:
    its Python code, which you have read, runs with your rights, and no other does."""
    device: Device = "auto"
    """cpu, cuda, or auto."""
    precision: Precision = "fp32"
    """fp32, or bf16: networks run in bfloat16 under autocast, weights and log-probs stay in fp32; auto: bf16
    where the processor computes in it. Where a policy learns, a ``dtype`` in the checkpoint's LeRobot config
    is taken, and saved, as float32: updates of RL are smaller than bfloat16 resolves."""
    sampler: SamplerConfig | None = None
    """How it explores. None: the first family of its policy type, with that family's defaults."""
    tuning: TuningConfig = field(default_factory=TuningConfig)
    rename_map: dict[str, str] = field(default_factory=dict)
    """Environment feature name → policy feature name, as in LeRobot's ``--rename_map``."""
    num_steps: Annotated[int, Range("[1, 10000]")] | None = None
    """Denoising steps; None keeps the checkpoint's. Written into what is saved."""
    n_action_steps: Annotated[int, Range("[1, 100000]")] | None = None
    """Rows of a chunk that are executed before the next decision; None keeps the checkpoint's."""


Load = Callable[[PolicyConfig], Any]
"""Makes a worker's `adapter.PolicyAdapter`."""


def loader(load: Load | None) -> Load:
    """Function that makes a worker's adapter; None: the one that loads LeRobot checkpoints."""
    return load or imported("accerl_lerobot.policies.loading:load_adapter")


POLICIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "smolvla": ("accerl_lerobot.policies.vla:SmolVLA", ("flow",)),
    "act": ("accerl_lerobot.policies.gaussian:ACT", ("gaussian",)),
    "diffusion": ("accerl_lerobot.policies.diffusion:Diffusion", ("diffusion",)),
    "pi0": ("accerl_lerobot.policies.vla:Pi0", ("flow",)),
    "pi05": ("accerl_lerobot.policies.vla:Pi05", ("flow",)),
    "pi0_fast": ("accerl_lerobot.policies.vla:Pi0Fast", ("tokens",)),
}
"""LeRobot policy type → its model, and the families that suit it, the default one first."""
ANY = "chunk_noise"  # the family of a type that has no other
NOT_IMPORTED: dict[str, str] = {}  # installed ``lerobot_policy_*`` → words on why it cannot be imported
PLUGINS: dict[str, str] = {}  # policy type that is not LeRobot's own → package that registers it with LeRobot
SIZES = (
    "chunk_size", "n_action_steps", "n_obs_steps", "horizon", "num_steps", "num_inference_steps",
    "max_state_dim", "max_action_dim", "num_train_timesteps", "max_decoding_steps", "tokenizer_max_length",
)  # fmt: skip
"""Numbers of LeRobot's policy configs by which is divided or which are shapes: at least 1."""
STEPS = (
    "num_steps", "num_inference_steps", "num_integration_steps", "num_denoising_steps", "num_denoise_steps",
    "num_inference_timesteps", "action_num_inference_steps",
)  # fmt: skip
"""Names of LeRobot's policy configs for the number of denoising steps."""
DTYPES = ("dtype", "model_dtype", "torch_dtype", "vlm_dtype")
"""Names of LeRobot's policy configs for the type of the weights."""
COARSE = ("auto", "bfloat16", "float16")  # types of weights in which small steps of RL are lost
USES_HISTORY = ("diffusion",)  # types that read observations of ``n_obs_steps`` env steps; others read one


def register_policy(policy_type: str, model: str, *families: str) -> None:
    """Gives a policy type of another package, which is registered with LeRobot, a likelihood.

    `model` is ``module:class``, of that package, of its `FlowModel` or another `family.Model`; `families` are
    the names of the samplers that suit it, the default one first.
    """
    module = model.partition(":")[0]
    POLICIES[policy_type] = (model, families)
    PLUGINS[policy_type] = module.rpartition(".")[0] or module


def register_policies(wanted: str | None = None) -> None:
    """Fills LeRobot's registry of policy types; those of installed plugins too, if `wanted` is missing.

    Of LeRobot's own types, the code of `wanted` alone is imported; of all if it is None or another's."""
    ours = wanted in POLICIES and wanted not in PLUGINS
    import_policies(wanted if ours else None)
    from lerobot.configs.policies import PreTrainedConfig

    if wanted is None or wanted in PreTrainedConfig.get_known_choices():
        return
    NOT_IMPORTED.update(import_plugins("lerobot_policy_"))


def check_registered(policy_type: Any, field: str, prefix: str = "") -> None:
    """Refuses a policy type that neither LeRobot nor an installed package has, after `register_policies`.

    A package that fails may have registered its type before, and is refused as well.
    """
    from lerobot.configs.policies import PreTrainedConfig

    known = PreTrainedConfig.get_known_choices()
    if policy_type not in known:
        install = "install the package that has it, or name it: policy.discover_packages_path"
        broken = "; ".join(NOT_IMPORTED.values())
        why = f"no such policy type here; {broken or install}; there are {', '.join(sorted(known))}"
        raise InputError(field, policy_type, prefix + why)
    package = known[policy_type].__module__.partition(".")[0]
    if package in NOT_IMPORTED:
        raise InputError(field, policy_type, prefix + NOT_IMPORTED[package])


def discovery(policy_type: str | None) -> list[str]:
    """Arguments by which stock LeRobot commands find this type; none for LeRobot's own."""
    if policy_type not in PLUGINS:
        return []
    return [f"--policy.discover_packages_path={PLUGINS[policy_type]}"]


def check_observations(policy_config: Any, field: str) -> None:
    """Refuses the simulator's state, and a history that LeRobot's policy of this type does not read."""
    if ENVIRONMENT_STATE in (policy_config.input_features or {}):
        hint = "no policy is given the simulator's state; train it without, as accerl sft does"
        raise InputError("policy.input_features", ENVIRONMENT_STATE, hint)
    if env_steps_seen(policy_config) != 1 and policy_config.type not in USES_HISTORY:
        hint = f"only {', '.join(USES_HISTORY)} looks back; a {policy_config.type} policy takes 1"
        raise InputError(field, policy_config.n_obs_steps, hint)


def sampler_config(config: PolicyConfig, policy_type: str) -> SamplerConfig:
    """How a policy of this type explores in this run; refuses a sampler that does not suit it."""
    _, suitable = POLICIES.get(policy_type, ("", ()))
    families = [*suitable, ANY]
    if config.sampler is None:
        return SamplerConfig.get_choice_class(families[0])()
    if config.sampler.type not in families:
        hint = f"use {' or '.join(families)}: the policy is of type {policy_type}"
        raise InputError("policy.sampler.type", config.sampler.type, hint)
    return config.sampler


def check_likelihood(algorithm: str, sampler: SamplerConfig, policy_type: str, field: str) -> None:
    """Refuses a policy without an exact likelihood for an `algorithm` that needs one."""
    if sampler.type == ANY:
        why = f"algorithm.type={algorithm} needs exact likelihoods, which {', '.join(POLICIES)} have here"
        hint = f"{why}; use chunk_critic or self_imitation, or add a likelihood (docs/extending.md)"
        raise InputError(field, policy_type, hint)


def env_steps_seen(policy_config: Any, *, learns: bool = False) -> int:
    """Env steps that an observation holds.

    A policy of another type than `POLICIES` keeps former ones itself, unless it `learns`.
    """
    if learns or policy_config.type in POLICIES:
        return int(policy_config.n_obs_steps)
    return 1


def executed_rows(policy_config: Any) -> int:
    """Actions that a policy executes for each of its decisions, in LeRobot's loop and here."""
    for name in ("n_action_steps", "action_chunk_size"):
        rows = getattr(policy_config, name, None)
        if rows:
            return int(rows)
    return 1


def check_size(name: str, value: Any, field: str) -> None:
    """Refuses a whole number of a LeRobot policy config that no policy can be built or can act with."""
    if isinstance(value, int):
        span = Range("[1, 10000]" if name in SIZES else "[-1, 1000000]")
        check(Annotated[int, span], int(value), field)


def predicted_rows(policy_config: Any) -> int:
    """Rows of a predicted chunk that can be executed: those that do not stand for the past."""
    return sum(row >= 0 for row in policy_config.action_delta_indices or ())


def override(policy_config: Any, config: PolicyConfig, *, learns: bool = False) -> None:
    """Puts a run's choices of denoising steps, executed rows and precision into LeRobot's policy config.

    The weights of a policy that `learns`, or that has a likelihood, are float32 where its config has a field
    for that; see `PolicyConfig.precision`.
    """
    fixed: dict[str, Any] = {
        # The checkpoint has them; LeRobot would download torchvision's first, even when told to stay offline.
        "pretrained_backbone_weights": None,
        "use_peft": False,  # an adapter is merged into the weights
        "compile_model": False,  # a compiled sampler rounds unlike the re-scoring pass
    }
    if learns or policy_config.type in POLICIES:
        coarse = [name for name in DTYPES if getattr(policy_config, name, None) in COARSE]
        fixed |= dict.fromkeys(coarse, "float32")
    if config.num_steps is not None:
        names = [name for name in STEPS if hasattr(policy_config, name)]
        if not names:
            hint = f"LeRobot's config of a {policy_config.type} policy has no {' or '.join(STEPS)}"
            raise InputError("policy.num_steps", config.num_steps, f"{hint}; leave the field out")
        fixed |= dict.fromkeys(names, config.num_steps)
    if config.n_action_steps is not None:
        rows = predicted_rows(policy_config) if hasattr(policy_config, "n_action_steps") else 0
        if config.n_action_steps > rows:
            hint = f"{policy_config.type}: at most {rows} rows of a predicted chunk can be chosen"
            raise InputError("policy.n_action_steps", config.n_action_steps, f"{hint}; leave the field out")
        fixed["n_action_steps"] = config.n_action_steps
    for name, value in fixed.items():
        if hasattr(policy_config, name):
            setattr(policy_config, name, value)
