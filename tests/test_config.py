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
"""Recipes and overrides into configs; every mistake is one line with field, value and remedy, exit code 2."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import yaml

from accerl_lerobot import cli, parsing
from accerl_lerobot.algorithms import GIPOConfig, PPOConfig
from accerl_lerobot.config import DatasetConfig, RunConfig, check_chunk, encode, parse
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.envs import LeRobotEnvConfig, MetaWorldConfig, SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.field_help import help_text
from accerl_lerobot.policies.backbone import BackboneConfig
from accerl_lerobot.preflight import check_sft_policy, check_start
from accerl_lerobot.verb_configs import DemosRun, EvalRun, SFTRun

ROOT = Path(__file__).parents[1]
RECIPE = """
job_name: mine
env: {type: simulated, task: mirror, image_size: 64}
algorithm: {type: gipo, sigma: 0.5, gamma: 0.9}
trainer:
  lr: 3e-5
"""


@pytest.fixture
def recipe(tmp_path: Path) -> str:
    path = tmp_path / "recipe.yaml"
    path.write_text(RECIPE)
    return str(path)


class TestOverrides:
    """What the command line changes in a recipe."""

    def test_a_field_of_a_choice_needs_no_type(self, recipe: str) -> None:
        config = parse(RunConfig, [f"--config_path={recipe}", "--env.task=match", "--algorithm.sigma=2"])
        assert config.env == SimulatedConfig(task="match", image_size=64)
        assert config.algorithm == GIPOConfig(sigma=2.0, gamma=0.9)
        assert config.trainer.lr == 3e-5 and config.job_name == "mine"

    def test_nor_without_a_recipe(self) -> None:
        config = parse(RunConfig, ["--env.task=door-open-v3", "--algorithm.sigma=0.2"])
        assert config.env == MetaWorldConfig(task="door-open-v3")
        assert config.algorithm == GIPOConfig(sigma=0.2)

    def test_the_other_fields_of_a_room_keep_the_values_that_help_shows(self) -> None:
        """Of a room whose default in this place is not that of its class, too."""
        usual = RunConfig().imagination
        config = parse(RunConfig, ["--imagination.replay.ahead=100", "--imagination.learn.trial.most=7"])
        assert config.imagination.replay == replace(usual.replay, ahead=100)
        assert config.imagination.learn.trial == replace(usual.learn.trial, most=7)
        text = help_text("train", RunConfig, "train")
        assert f"--imagination.replay.capacity={usual.replay.capacity} " in text
        assert f"--imagination.learn.trial.auroc={usual.learn.trial.auroc} " in text

    @pytest.mark.parametrize("form", ["--config_path={}", "--config_path {}", "{}"])
    def test_forms_of_naming_a_recipe(self, recipe: str, form: str) -> None:
        assert parse(RunConfig, [*form.format(recipe).split(), "--seed=3"]).job_name == "mine"

    def test_a_value_may_follow_its_field(self) -> None:
        config = parse(RunConfig, ["--seed", "4", "--trainer.lr", "1e-5"])
        assert (config.seed, config.trainer.lr) == (4, 1e-5)

    def test_another_type_takes_what_it_knows(self, recipe: str) -> None:
        """PPO beside GIPO on the same recipe: σ goes with the algorithm it belonged to."""
        config = parse(RunConfig, [recipe, "--algorithm.type=ppo"])
        assert config.algorithm == PPOConfig(gamma=0.9)
        config = parse(RunConfig, [recipe, "--env.type=metaworld", "--env.task=door-open-v3"])
        assert config.env == MetaWorldConfig(task="door-open-v3", image_size=64)
        config = parse(RunConfig, [recipe, "--env.type=lerobot", "--env.name=pusht", "--env.task="])
        assert config.env == LeRobotEnvConfig(name="pusht", task="")

    def test_the_same_type_again_drops_nothing(self, recipe: str) -> None:
        assert parse(RunConfig, [recipe, "--algorithm.type=gipo"]).algorithm.sigma == 0.5

    def test_but_a_field_of_another_type_is_refused(self, recipe: str) -> None:
        with pytest.raises(InputError, match=r"algorithm.sigma=1: no such field"):
            parse(RunConfig, [recipe, "--algorithm.type=ppo", "--algorithm.sigma=1"])

    def test_values_are_yaml(self) -> None:
        arguments = ["--trainer.betas=[0.8, 0.9]", "--policy.rename_map={a: b}", "--sft.cache=false"]
        config = parse(RunConfig, [*arguments, "--algorithm.sigma=.inf", "--job_name=a: b: c"])
        assert config.trainer.betas == (0.8, 0.9) and config.policy.rename_map == {"a": "b"}
        assert config.sft.cache is False and math.isinf(config.algorithm.sigma)
        assert config.job_name == "a: b: c"

    def test_entries_of_a_mapping(self) -> None:
        config = parse(RunConfig, ["--sft.policy.type=smolvla", "--sft.policy.chunk_size=7"])
        assert config.sft.policy == {"type": "smolvla", "chunk_size": 7}

    def test_optional_rooms(self) -> None:
        assert parse(RunConfig, []).sft.backbone is None
        assert parse(RunConfig, ["--sft.backbone.hidden=64"]).sft.backbone.hidden == 64
        assert parse(RunConfig, ["--sft.backbone=null"]).sft.backbone is None
        assert parse(SFTRun, ["--env.type=simulated"]).env == SimulatedConfig()

    def test_an_empty_room_is_all_defaults(self, tmp_path: Path) -> None:
        (tmp_path / "r.yaml").write_text("trainer:\n  # lr: 1\nenv:\n")
        assert parse(RunConfig, [str(tmp_path / "r.yaml")]) == RunConfig()
        (tmp_path / "empty.yaml").write_text("# nothing yet\n")
        assert parse(RunConfig, [str(tmp_path / "empty.yaml")]) == RunConfig()

    def test_verbs_take_their_rooms_from_a_run(self, recipe: str) -> None:
        config = parse(EvalRun, [recipe, "--evaluation.episodes=5"], recipe_class=RunConfig)
        assert config.env == SimulatedConfig(task="mirror", image_size=64)
        assert parse(DemosRun, [recipe], recipe_class=RunConfig).env.task == "mirror"
        with pytest.raises(InputError, match="trainer"):  # but nobody types it in vain
            parse(EvalRun, [recipe, "--trainer.lr=1e-5"], recipe_class=RunConfig)

    def test_a_resolved_config_makes_itself_again(self, recipe: str, tmp_path: Path) -> None:
        config = parse(RunConfig, [recipe, "--algorithm.sigma=.inf", "--sft.backbone.hidden=64"])
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump(encode(config), sort_keys=False))
        assert parse(RunConfig, [str(path)]) == config


MISTAKES: list[tuple[list[str], str]] = [
    (["--lr=3"], "lr=3: no such field; did you mean sft.lr or trainer.lr or imagination.learn.lr?"),
    (["--trainer.lrr=3"], "trainer.lrr=3: no such field; did you mean trainer.lr?"),
    (["--traner.lr=1"], "traner={'lr': 1}: no such field; did you mean trainer?"),
    (["--wandb.zzz=1"], "wandb.zzz=1: no such field; wandb has enable, project, entity"),
    (["--trainer.lr=many"], "trainer.lr='many': use a number"),
    (["--trainer.lr=2"], "trainer.lr=2.0: use a value in [0, 1), e.g. 1e-4"),
    (["--trainer.lr=-1e-4"], "trainer.lr=-0.0001: use a value in [0, 1), e.g. 1e-4"),
    (["--trainer.lr=.nan"], "trainer.lr=nan: use a value in [0, 1), e.g. 1e-4"),
    (["--rollout.decision_cost=nan"], "rollout.decision_cost=nan: use a number"),
    (["--trainer.updates=1.5"], "trainer.updates=1.5: use a whole number"),
    (["--trainer.updates=true"], "trainer.updates=True: use a whole number"),
    (["--trainer.updates=null"], "trainer.updates=None: use a whole number"),
    (["--trainer.updates"], "trainer.updates='': give it a value: --trainer.updates=…"),
    (["--trainer=3"], "trainer=3: a room, not a value; use --trainer.field=value"),
    (["--trainer.betas=[1]"], "trainer.betas=[1]: use a list of 2, each a number"),
    (["--sft.extra_args={a: 1}"], "sft.extra_args={'a': 1}: use a list such as [a, b], each text"),
    (["--trainer.betas=[true, 0.9]"], "trainer.betas=[True, 0.9]: use a list of 2, each a number"),
    (["--trainer.betas=0.9"], "trainer.betas=[0.9]: use a list of 2, each a number"),
    (["--sft.backbone.hidden=x"], "sft.backbone.hidden='x': use a whole number"),
    (["--sft.backbone.hidden=6"], "sft.backbone.heads=4: use a divisor of the width 6"),
    (["--policy.num_steps=x"], "policy.num_steps='x': use a whole number or null"),
    (["--policy.rename_map=3"], "policy.rename_map=3: use a mapping such as {key: value}"),
    (["--wandb.enable=perhaps"], "wandb.enable='perhaps': use true or false"),
    (["--env.task=[a]"], "env.task=['a']: use text"),
    (["--algorithm.level=row"], "algorithm.level='row': use one of token, action, chunk"),
    (
        ["--algorithm.type=gippo"],
        "algorithm.type='gippo': did you mean gipo? Otherwise use one of awr, decoupled, gipo, is, ppo, sapo",
    ),
    (["--algorithm.type=is", "--algorithm.cap=0.5"], "algorithm.cap=0.5: use a finite number from 1 up"),
    (["--algorithm.type=decoupled", "--algorithm.proximal_every=0"], "algorithm.proximal_every=0: use at"),
    (["--algorithm.sigma=0"], "algorithm.sigma=0.0: use a number above 0"),
    (["--env.type=mujoco"], "env.type='mujoco': use one of lerobot, metaworld, simulated"),
    (["--env.task=drawer-v3"], "env.task='drawer-v3': 'drawer-v3' is not a MetaWorld task; did you mean"),
    (["--env.max_steps=0"], "env.max_steps=0: use 1 to 500 env steps"),
    (["--seed=100"], "seed=100: use 0 to 99"),
    (["--launch.engine=slurm"], "launch.engine='slurm': use ray or local"),
    (["--launch.transport=tcp"], "launch.transport='tcp': use one of auto, ray, shared_memory"),
    (["--launch.weights=mpi"], "launch.weights='mpi': use one of ray, gloo"),
    (["--launch.weights=gloo", "--launch.engine=local"], "launch.weights='gloo': launch.engine=local is one"),
    (
        ["--launch.weights=gloo", "--launch.transport=shared_memory"],
        "launch.weights='gloo': launch.transport=shared_memory leaves nothing to it; use auto",
    ),
    (["--rollout.group_size=1"], "rollout.group_size=1: groups of one have no comparison; use 0"),
    (["--rollout.group_advantage=gae"], "rollout.group_advantage='gae': use one of grpo, rloo, grpo_no_std"),
    (
        ["--trainer.hold_back=50"],
        "replay.max_lag=50: use more than trainer.hold_back, 50, or all is",
    ),
    (["--algorithm.advantage=group"], "algorithm.advantage='group': add --rollout.group_size=8, say"),
    (["--replay.ahead=3"], "replay.ahead=3: use at least one batch, 128, or both sides wait for each other"),
    (["--dataset.root=x"], "dataset.repo_id=None: name the dataset in dataset.root"),
    (
        ["--imagination.learn.online.root=x"],
        "imagination.learn.online.repo_id=None: name the dataset in imagination.learn.online.root",
    ),
    (["--demos.seed=1"], "demos.seed=1: a run's demonstrations take its own seed; use --seed"),
    (["--policy.path=x", "--sft.steps=5"], "policy.path='x': add --sft.steps=0 to improve this checkpoint"),
    (["--sft.policy.chunk_size=5"], "sft.policy={'chunk_size': 5}: name LeRobot's policy type, e.g."),
    (
        ["--sft.steps=5", "--sft.policy.type=smolvla", "--sft.policy.chunk_size=0"],
        "sft.policy.chunk_size=0: use a whole number from 1 up",
    ),
    (["here.yaml", "there.yaml"], "argument='there.yaml': write --room.field=value"),
    (["--config_path=here.yaml", "--config_path=there.yaml"], "config_path='there.yaml': there is here.yaml"),
    (["--seed=1", "seed=2"], "argument='seed=2': write --room.field=value"),
    (["--seed=1", "--seed.x=2"], "seed.x=2: seed is set to 1 already"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[" ".join(a) for a, _ in MISTAKES])
def test_mistakes(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith(f"accerl: {message}")


FILES: list[tuple[str, str]] = [
    ("env: {type: metaworld\n", "not good YAML: line 2: expected ',' or '}'"),
    ("env:\n\ttype: metaworld\n", "not good YAML: line 2: found character '\\t'"),
    ("trainer: {lr: 1}\nseed: 1\ntrainer: {lr: 2}\n", "not good YAML: line 3: trainer is given twice"),
    ("- 1\n- 2\n", "a recipe is a mapping"),
    ("a: !!python/object:os.system {}\n", "not good YAML: line 1: could not determine a constructor"),
]


@pytest.mark.parametrize(("text", "message"), FILES, ids=range(len(FILES)))
def test_bad_files(text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(text)
    assert cli.main(["train", f"--config_path={path}"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"accerl: config_path={str(path)!r}: {message}") and err.count("\n") == 1


def test_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "quickstart.yaml").write_text("seed: 1\n")
    assert cli.main(["train", str(tmp_path / "quickstart.yml")]) == 2
    assert f"no such file; did you mean {tmp_path / 'quickstart.yaml'}?" in capsys.readouterr().err
    assert cli.main(["train", str(tmp_path / "folder" / "x.yaml")]) == 2
    assert "no such file; see recipes/" in capsys.readouterr().err


def test_a_mistake_in_a_recipe_is_named_like_one_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("trainer:\n  updates: lots\n")
    assert cli.main(["train", str(path)]) == 2
    assert capsys.readouterr().err == "accerl: trainer.updates='lots': use a whole number\n"


def test_groups_serve_either_kind_of_advantage() -> None:
    for advantage in ("gae", "group"):
        config = parse(RunConfig, ["--rollout.group_size=2", f"--algorithm.advantage={advantage}"])
        assert (config.algorithm.advantage, config.rollout.group_size) == (advantage, 2)


def test_long_values_are_shortened() -> None:
    text = str(InputError("a", "x" * 1000, "shorten\nit"))
    assert len(text) < 250 and text.endswith("…: shorten it")


@pytest.mark.parametrize("size", [0, -1, 2.0, "2", True, None])
def test_chunk_sizes_are_whole_and_positive(size: Any) -> None:
    with pytest.raises(InputError, match="sft.policy.chunk_size=.*: use a whole number from 1 up"):
        check_chunk({"type": "smolvla", "chunk_size": size})


def test_no_more_is_executed_than_predicted() -> None:
    check_chunk({"chunk_size": 5, "n_action_steps": 5})
    with pytest.raises(InputError, match=r"sft.policy.n_action_steps=6: use 1 to sft.policy.chunk_size, 5"):
        check_chunk({"chunk_size": 5, "n_action_steps": 6})


class TestPreflight:
    """What LeRobot knows about `sft.policy`."""

    @pytest.mark.parametrize(
        ("policy", "message"),
        [
            ({"type": "smol"}, "sft.policy.type='smol': LeRobot has act, "),
            ({"type": "gaussian_actor"}, "sft.policy.type='gaussian_actor': only LeRobot's SAC trains it"),
            (
                {"type": "smolvla", "chunks": 3},
                "sft.policy.chunks=3: LeRobot's smolvla has no such field; did you",
            ),
            ({"type": "smolvla", "num_steps": "x"}, "sft.policy.num_steps='x': LeRobot says: "),
            (
                {"type": "smolvla", "chunk_size": 10},
                "sft.policy={'chunk_size': 10}: LeRobot says: The chunk size",
            ),
        ],
    )
    def test_refuses(self, policy: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError) as caught:
            check_sft_policy(SFTConfig(steps=1, policy=policy))
        assert str(caught.value).startswith(message)

    def test_refuses_a_backbone_where_there_is_none(self) -> None:
        with pytest.raises(InputError, match="^sft.backbone=.*: act has no vision-language backbone"):
            check_sft_policy(SFTConfig(steps=1, policy={"type": "act"}, backbone=BackboneConfig()))

    def test_refuses_to_look_back_where_lerobot_does_not_before_training_it(self) -> None:
        policy: dict[str, Any] = {"type": "smolvla", "n_obs_steps": 2}
        check_sft_policy(SFTConfig(steps=1, policy=policy))  # SFT alone could
        with pytest.raises(InputError, match="^sft.policy.n_obs_steps=2: only diffusion looks back"):
            check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))
        check_start(RunConfig(sft=SFTConfig(steps=1, policy={"type": "diffusion"})))

    def test_refuses_a_policy_without_a_likelihood_before_training_it(self) -> None:
        with pytest.raises(InputError, match="sft.policy.type='vqbet': RL needs a likelihood"):
            check_start(RunConfig(sft=SFTConfig(steps=1, policy={"type": "vqbet"})))

    def test_accepts(self, tiny_checkpoint: Path) -> None:
        policy = {"type": "smolvla", "chunk_size": 10, "n_action_steps": 10}
        check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))
        check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy | {"type": "act"})))
        check_start(parse(RunConfig, [f"--policy.path={tiny_checkpoint}"]))
        dataset = DatasetConfig(
            repo_id="accerl/metaworld_tiny", root=str(ROOT / "datasets" / "metaworld_tiny")
        )
        check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy), dataset=dataset))


def test_every_field_has_a_name_on_the_command_line() -> None:
    names = set(parsing.dotted_fields(RunConfig))
    assert {"seed", "env.task", "env.hold", "algorithm.sigma", "algorithm.clip_low"} <= names
    assert {"policy.sampler.noise_level", "sft.backbone.hidden"} <= names
    assert not any(name in names for name in ("env", "trainer", "sft.backbone"))


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (int, "a whole number"),
        (float | None, "a number or null"),
        (list[str], "a list such as [a, b], each text"),
        (dict[str, int], "a mapping such as {key: value}"),
        (Literal["a", "b"], "one of a, b"),
        (Path, "Path"),
    ],
)
def test_types_in_words(hint: Any, words: str) -> None:
    assert parsing.wanted(hint) == words


def test_changes_are_not_sent_within_one_process():
    with pytest.raises(InputError, match=r"^trainer.publish_changes=True: launch.engine=local"):
        parse(RunConfig, ["--launch.engine=local", "--trainer.publish_changes=true"])
    assert parse(RunConfig, ["--trainer.publish_changes=true"]).trainer.publish_changes
