# SPDX-License-Identifier: Apache-2.0
"""A policy and an algorithm of somebody else's package: checked, trained, and run by LeRobot.

Each test begins where nobody has heard of them: who forgets to import the package fails.
"""

import importlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig

from accerl_lerobot import load_policy
from accerl_lerobot.algorithms import AlgorithmConfig, chunk_critic
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.update import make_update
from accerl_lerobot.config.parsing import parse
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observation
from accerl_lerobot.policies.config import PLUGINS, POLICIES, PolicyConfig
from accerl_lerobot.policies.flow import FlowFamily
from accerl_lerobot.policies.loading import dry_run_config, load_adapter
from accerl_lerobot.testing import check_policy
from accerl_lerobot.world_model.config import StateModelConfig
from tests.algorithms.test_chunk_critic import episode
from tests.envs.test_gym import GYM
from tests.envs.test_gym import PACKAGE as REACH
from tests.policies.checkpoints import write_policy
from tests.runs import off_policy_run, pip_installed, tiny_run, trained, updates

SOURCE = Path(__file__).parent / "packages" / "lerobot_policy_mlp_flow"
EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
PACKAGE, POLICY, ALGORITHM = SOURCE.name, "mlp_flow", "cispo"
FLAG = f"--policy.discover_packages_path={PACKAGE}"
NAMED = [f"--algorithm.discover_packages_path={PACKAGE}.algorithm", f"--algorithm.type={ALGORITHM}"]


def forget() -> None:
    kinds = [kind.get_known_choices() for kind in (PreTrainedConfig, AlgorithmConfig, StateModelConfig)]
    for registry in (POLICIES, PLUGINS, *kinds):
        for name in (POLICY, ALGORITHM, "rwr", "small_picture"):
            registry.pop(name, None)
    for name in [n for n in sys.modules if n.partition(".")[0] in (PACKAGE, "rwr", "small_picture")]:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def unheard_of(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(SOURCE))
    monkeypatch.syspath_prepend(str(EXAMPLES))
    forget()
    yield
    forget()


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    importlib.import_module(PACKAGE)
    path = write_policy(tmp_path / "pretrained_model", POLICY, image=32)
    forget()
    return path


@pytest.fixture(scope="module")
def observations() -> list[Observation]:
    environment = make_environment(SimulatedConfig())
    return [environment.reset(seed, "match") for seed in range(3)]


def named(checkpoint: Path) -> PolicyConfig:
    return PolicyConfig(path=str(checkpoint), device="cpu", discover_packages_path=PACKAGE)


@pytest.mark.parametrize(
    ("name", "changed", "message"),
    [
        (  # a sampler that is not LeRobot's
            "predict_action_chunk", lambda chunk: 1.01 * chunk,
            "policy.type='mlp_flow': .*lerobot_policy_mlp_flow.*correct .*encode or stock",
        ),
        (  # one decision depends on the others in its batch
            "features", lambda features: features + 0.1 * features.mean(0),
            "of two decisions on one request, .* is off by",
        ),
        (  # the encoder's gradient is lost
            "features", lambda features: features.detach(),
            r"the log-prob does not depend on \['policy.encoder.0.weight', 'policy.encoder.0.bias'",
        ),
        (  # the density leaves out executed actions
            "_rows", lambda rows: torch.cat([rows[:, :1], 0 * rows[:, 1:]], 1),
            "standard errors apart: the log-prob is not that of the actions",
        ),
    ],
)  # fmt: skip
def test_mistakes_are_found(name, changed, message, checkpoint, observations, monkeypatch):
    policy = importlib.import_module(f"{PACKAGE}.modeling_mlp_flow").MLPFlowPolicy
    owner = FlowFamily if name == "_rows" else policy
    right = getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *given, **more: changed(right(*given, **more)))
    with pytest.raises((AssertionError, InputError), match=message):
        check_policy(named(checkpoint), observations)


def test_it_acts_with_a_right_likelihood(checkpoint: Path, observations: list[Observation]):
    with pytest.raises(InputError, match=rf"^policy\.type='{POLICY}': .*or name it: policy\.discover"):
        load_adapter(PolicyConfig(path=str(checkpoint)))
    policy = load_policy(checkpoint, device="cpu", discover_packages_path=PACKAGE)
    assert policy.act(observations[0]).shape == (4, 2)
    assert load_policy(checkpoint, device="cpu").history == 1, "once imported, it is known"
    check_policy(named(checkpoint), observations)


def test_a_file_alone_imports_no_package(checkpoint: Path, tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(f"policy: {{path: {checkpoint}, discover_packages_path: {PACKAGE}}}\n")
    with pytest.raises(InputError, match=rf"^policy\.discover_packages_path='{PACKAGE}': a file cannot"):
        parse(RunConfig, [f"--config_path={recipe}"])
    assert PACKAGE not in sys.modules
    config = parse(RunConfig, [f"--config_path={recipe}", FLAG]).policy
    assert dry_run_config(config).type == POLICY


def example(name: str, section: str, *flags: str) -> RunConfig:
    """A run with the module that a page of the documents shows."""
    flags = (f"--{section}.discover_packages_path={name}", f"--{section}.type={name}", *flags)
    return parse(RunConfig, ["--config_path=few_shot", *flags])


def test_the_off_policy_algorithm_of_the_page(tiny_checkpoint: Path):
    algorithm: Any = example("rwr", "algorithm").algorithm
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu"))
    update: Any = make_update(adapter, algorithm, TrainerConfig(warmup_updates=0, value_warmup_updates=0))
    metrics = update.step([episode([0.0, 1.0]), episode([0.0])])
    assert len(update.imitable()) == 3 and metrics["imitation_loss"] > 0
    (loss,) = update.losses(np.arange(3), None, torch.tensor([1.0, 2.0, 3.0])).values()
    weights = np.exp(np.array([algorithm.gamma, 1.0, 0.0]) / 0.25)
    assert float(loss) == pytest.approx(weights @ [1, 2, 3] / weights.sum())


def test_the_world_model_of_the_page(monkeypatch: Any, tiny_checkpoint: Path):
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 5)
    model = example("small_picture", "world_model", "--env.environment_state=false").world_model
    trainer = TrainerConfig(updates=4, batch_decisions=16, value_warmup_updates=2)
    _, engine = trained(off_policy_run(tiny_checkpoint, world_model=model, trainer=trainer))
    memory: Any = engine._update.memory
    images = memory["observation.images.front"].reshape(-1, 4, 8, 4, 8, 3).mean((2, 4)) / 255
    expected = np.concatenate([images.transpose(0, 3, 1, 2).reshape(-1, 48), memory["observation.state"]], 1)
    np.testing.assert_allclose(memory["state"][:, : expected.shape[1]], expected, rtol=1e-5, atol=1e-6)


def test_it_trains_with_its_own_algorithm(checkpoint: Path):
    algorithm = parse(RunConfig, [*NAMED, "--algorithm.cap=1.5"]).algorithm
    config = tiny_run(checkpoint, policy=named(checkpoint), algorithm=algorithm)
    made = updates(trained(config)[0])
    assert len(made) == 12 and made[-1]["skipped"] == 0
    assert any(update["policy_loss"] != 0 for update in made)


STOCK = """
import sys
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
config = PreTrainedConfig.from_pretrained(sys.argv[1])
policy = get_policy_class(config.type).from_pretrained(sys.argv[1])
before, after = make_pre_post_processors(config, pretrained_path=sys.argv[1])
images = {name: torch.zeros(1, *feature.shape) for name, feature in config.image_features.items()}
action = after(policy.select_action(before({"observation.state": torch.zeros(1, 4), **images})))
print(config.type, tuple(action.shape))
"""
USE_REACH = """
from accerl_lerobot.envs import LeRobotEnvConfig, make_environment

environment = make_environment(LeRobotEnvConfig(name="reach", task="Reach the goal"))
print(environment.reset(0, "reach")["observation.state"].shape)
"""


@pytest.mark.slow
def test_installed_packages_are_found_by_every_process(checkpoint: Path, tmp_path: Path):
    """By their names in a run on Ray; policy and environment as LeRobot's plugins, too."""
    copies = tmp_path / "sources"  # pip builds there
    sources = [shutil.copytree(path, copies / path.name) for path in (SOURCE, REACH)]
    environment = pip_installed(tmp_path / "site", *sources)
    accerl = [sys.executable, "-m", "accerl_lerobot.cli"]
    common = [*GYM, "--policy.device=cpu", "--rollout.environments=4", "--evaluation.episodes=4"]
    run = [
        "train", *common, *NAMED, FLAG, f"--policy.path={checkpoint}", "--rollout.segment_length=3",
        "--replay.capacity=64", "--replay.min_decisions=16", "--replay.max_unlearned_decisions=32",
        "--trainer.updates=4", "--trainer.batch_decisions=16", f"--output_dir={tmp_path / 'run'}",
    ]  # fmt: skip
    subprocess.run([*accerl, *run], check=True, env=environment, cwd=tmp_path)
    trained = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    for code, last in ((STOCK, f"{POLICY} (1, 2)"), (USE_REACH, "(2,)")):
        command = [sys.executable, "-c", code, str(trained)]
        shown = subprocess.run(command, check=True, env=environment, cwd=tmp_path, capture_output=True)
        assert shown.stdout.decode().splitlines()[-1] == last
    evaluation = ["eval", *common, f"--policy.path={trained}", "--launch.engine=local"]
    subprocess.run([*accerl, *evaluation], check=True, env=environment, cwd=tmp_path)
