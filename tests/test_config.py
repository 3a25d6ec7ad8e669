# SPDX-License-Identifier: Apache-2.0
"""Recipes and overrides into configs; every mistake is one line with field, value and hint, exit code 2."""

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot import cli
from accerl_lerobot.algorithms import GIPOConfig, PPOConfig
from accerl_lerobot.cli.configs import DemosRun, EvalRun, WorldModelRun
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.envs import GymConfig, LeRobotEnvConfig, MetaWorldConfig, SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.preflight import check_sft_policy, check_start

ROOT = Path(__file__).parents[1]
RECIPE = """
job_name: mine
env: {type: simulated, task: mirror, image_size: 64}
algorithm: {type: gipo, sigma: 0.5, gamma: 9e-1}
trainer:
  lr: 3e-5
"""


def written(folder: Path, text: Any) -> str:
    """A recipe of a text, or of what a config is encoded as."""
    path = folder / "recipe.yaml"
    path.write_text(text if isinstance(text, str) else yaml.safe_dump(text, sort_keys=False))
    return str(path)


@pytest.fixture
def recipe(tmp_path: Path) -> str:
    return written(tmp_path, RECIPE)


class TestOverrides:
    @pytest.mark.parametrize("form", ["--config_path={}", "--config_path {}", "{}"])
    def test_a_field_of_a_choice_needs_no_type(self, recipe: str, form: str) -> None:
        config = parse(RunConfig, [*form.format(recipe).split(), "--env.task=match", "--algorithm.sigma=2"])
        assert config.env == SimulatedConfig(task="match", image_size=64)
        assert config.algorithm == GIPOConfig(sigma=2.0, gamma=0.9)
        assert config.trainer.lr == 3e-5 and config.job_name == "mine"

    def test_another_type_takes_what_it_knows(self, recipe: str) -> None:
        """σ goes with the algorithm it belonged to. YAML 1.1 takes 9e-1 for text."""
        assert parse(RunConfig, [recipe, "--algorithm.type=ppo"]).algorithm == PPOConfig(gamma=0.9)
        assert parse(RunConfig, [recipe, "--algorithm.type=gipo"]).algorithm.sigma == 0.5
        config = parse(RunConfig, [recipe, "--env.type=metaworld", "--env.task=door-open-v3"])
        assert config.env == MetaWorldConfig(task="door-open-v3", image_size=64)
        config = parse(RunConfig, ["few_shot", "--sft.policy={type: vqbet, crop_shape: [64, 64]}"])
        assert config.sft.policy == {"type": "vqbet", "crop_shape": [64, 64]}, "none of SmolVLA's fields"
        assert parse(RunConfig, ["few_shot", "--sft.policy.num_steps=5"]).sft.policy["num_vlm_layers"] == 2

    def test_values_are_yaml(self) -> None:
        arguments = ["--seed", "4", "--resume=true", "--trainer.betas=[0.8, 0.9]"]
        arguments += ["--policy.rename_map={a: b}", "--sft.policy.type=smolvla", "--sft.policy.chunk_size=7"]
        config = parse(RunConfig, [*arguments, "--algorithm.sigma=.inf"])
        assert config.trainer.betas == (0.8, 0.9) and config.policy.rename_map == {"a": "b"}
        assert config.seed == 4 and config.resume is True and math.isinf(config.algorithm.sigma)
        assert config.sft.policy == {"type": "smolvla", "chunk_size": 7}

    @pytest.mark.parametrize("text", ["trainer:\n  # lr: 1\nenv:\n", "# nothing yet\n"])
    def test_an_empty_section_is_all_defaults(self, text: str, tmp_path: Path) -> None:
        assert parse(RunConfig, [written(tmp_path, text)]) == RunConfig()
        assert parse(RunConfig, ["--sft.backbone=null"]) == RunConfig(), "an optional one"

    def test_verbs_take_their_rooms_from_a_run(self, recipe: str) -> None:
        config = parse(EvalRun, [recipe, "--evaluation.episodes=5"], recipe_class=RunConfig)
        assert config.env == SimulatedConfig(task="mirror", image_size=64)
        assert parse(DemosRun, [recipe], recipe_class=RunConfig).env.task == "mirror"
        with pytest.raises(InputError, match="trainer"):  # but nobody types it in vain
            parse(EvalRun, [recipe, "--trainer.lr=1e-5"], recipe_class=RunConfig)

    def test_a_resolved_config_makes_itself_again(self, recipe: str, tmp_path: Path) -> None:
        for arguments in (
            [recipe, "--algorithm.sigma=.inf", "--sft.backbone.hidden=64"],
            ["few_shot", "--world_model.type=latent", "--world_model.latents=32"],
        ):
            config = parse(RunConfig, arguments)
            assert parse(RunConfig, [written(tmp_path, encode(config))]) == config


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "policy.path=None: give a LeRobot checkpoint"),
        (["--help=trainr"], "--help='trainr': use all or one of env, dataset"),
        (["--lr=3"], "lr=3: no such field; did you mean sft.lr or trainer.lr?"),
        (["--wandb.zzz=1"], "wandb.zzz=1: no such field; wandb has enable, project"),
        (["--trainer.lr=many"], "trainer.lr='many': use a number"),
        (["--trainer.updates"], "trainer.updates='': give it a value: --trainer.updates=…"),
        (["--trainer=3"], "trainer=3: a config section; use --trainer.field=value"),
        (["--env.task=[a]"], "env.task=['a']: use text"),
        (["--algorithm.type=ppo", "--algorithm.sigma=1"], "algorithm.sigma=1: no such field"),
        (["--env.type=mujoco"], "env.type='mujoco': use one of gym, lerobot, libero, metaworld, simulated"),
        (["--env.task=drawer-v3"], "env.task='drawer-v3': 'drawer-v3' is no task; did you mean"),
        (["--replay.max_unlearned_decisions=3"], "replay.max_unlearned_decisions=3: use at least one"),
        (["--policy.path=x", "--sft.steps=5"], "policy.path='x': add --sft.steps=0 to improve"),
        (["--sft.policy.chunk_size=5"], "sft.policy={'chunk_size': 5}: name LeRobot's policy type, e.g."),
        (["--steps=3"], "steps=3: the name is LeRobot's; use trainer.updates, or sft.steps"),
        (["--env.discover_packages_path=a/b"], "env.discover_packages_path='a/b': cannot be imported"),
        (["--seed=1", "--seed=2"], "seed=2: it is set to 1 already; give it once"),
        (["here.yaml", "--config_path=there.yaml"], "config_path='here.yaml': it is set to 'there"),
        (["seed=2"], "config_path='seed=2': no such file; this package has act_pusht, "),
        (["--seed=1", "--seed.x=2"], "seed.x=2: seed is set to 1 already"),
    ],
)
def test_mistakes(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith(f"accerl: {message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("env: {type: metaworld\n", "not good YAML: while parsing a flow mapping"),
        ("trainer: {lr: 1}\nseed: 1\ntrainer: {lr: 2}\n", "not good YAML: trainer is given twice in "),
        ("- 1\n- 2\n", "a recipe is a mapping"),
        ("a: !!python/object:os.system {}\n", "not good YAML: could not determine a constructor"),
    ],
)
def test_bad_files(text: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=f"^config_path={path!r}: {re.escape(message)}"):
        parse(RunConfig, [f"--config_path={path}"])


def test_a_recipe_says_how_it_differs_from_its_base(recipe: str, tmp_path: Path) -> None:
    middle, top = tmp_path / "middle.yaml", tmp_path / "top.yaml"
    middle.write_text(f"base: {recipe}\ntrainer: {{updates: 5}}\nalgorithm: {{gamma: 0.8}}\n")
    top.write_text("base: middle.yaml\njob_name: top\nalgorithm: {type: ppo}\n")
    config = parse(RunConfig, [str(top), "--seed=3"])
    assert (config.job_name, config.seed, config.env.type) == ("top", 3, "simulated")
    assert (config.trainer.updates, config.trainer.lr) == (5, 3e-5)
    assert config.algorithm == PPOConfig(gamma=0.8)
    assert parse(DemosRun, [str(top)], recipe_class=RunConfig).env == config.env
    middle.write_text("policy: {trust_remote_code: abc}")
    for base, message in (
        ("nowhere", "^base='nowhere': no such file"),
        (top, "^base=.*top.yaml': this recipe is laid on itself"),
        (f"../{tmp_path.name}/top.yaml", "^base=.*top.yaml': this recipe is laid on itself"),
        (middle, "a file cannot allow this"),
    ):
        top.write_text(f"base: {base}")
        with pytest.raises(InputError, match=message):
            parse(RunConfig, [str(top)])


def test_odd_text_stays_text() -> None:
    for text in ("{[1]: 2}", "[" * 900, "2024-13-45", "*x", "block #2", "012345", "1_000", "a: b: c", ""):
        assert parse(RunConfig, [f"--job_name={text}"]).job_name == text


def test_numbers_of_a_free_mapping_are_numbers() -> None:
    kwargs = "{sigma: 1e-3, b: [2.5E4, a1e2], c: {d: -1e0}}"
    arguments = ["--env.type=gym", "--env.id=a/B", f"--env.kwargs={kwargs}"]
    env: Any = parse(RunConfig, arguments).env
    assert env.kwargs == {"sigma": 1e-3, "b": [25000.0, "a1e2"], "c": {"d": -1.0}}


def test_a_mapping_on_the_command_line_takes_the_place_of_the_file_s(tmp_path: Path) -> None:
    path = written(tmp_path, "policy: {rename_map: {a: b}}\nenv: {type: gym, id: a/B, images: {x: render}}\n")
    assert parse(RunConfig, [path, "--policy.rename_map={}"]).policy.rename_map == {}
    env: Any = parse(RunConfig, [path, "--env.images={y: pixels}"]).env
    assert env.images == {"y": "pixels"}
    env = parse(RunConfig, [path, "--env.images.y=pixels"]).env
    assert env.images == {"x": "render", "y": "pixels"}


def test_another_environment_has_its_own_defaults(recipe: str) -> None:
    config = parse(RunConfig, [recipe, "--env.type=gym", "--env.id=a/B"])
    assert config.env == GymConfig(id="a/B"), "neither the task nor the size of the recipe's"


def test_another_repository_is_not_asked_for_the_former_one_s_commit(tmp_path: Path) -> None:
    path = written(tmp_path, "policy: {path: me/one, revision: abc}\n")
    assert parse(RunConfig, [path, "--policy.path=me/other"]).policy.revision is None
    assert parse(RunConfig, [path, "--policy.path=me/one"]).policy.revision == "abc"
    path = written(tmp_path, "dataset: {repo_id: me/one, root: one, revision: abc}\n")
    assert parse(RunConfig, [path, "--dataset.repo_id=me/other"]).dataset == DatasetConfig(repo_id="me/other")


ARENA = f"them/arena@{'0123456789' * 4}"


class TestConsent:
    """A file cannot let code run, whoever wrote it; the command line can."""

    @pytest.mark.parametrize(
        ("text", "flag"),
        [
            ("policy: {trust_remote_code: abc}", "--policy.trust_remote_code=abc"),
            ("sft: {extra_args: [--a=x]}", "'--sft.extra_args=[\"--a=x\"]'"),
            ("sft: {policy: {discover_packages_path: os}}", "--sft.policy.discover_packages_path=os"),
            ("env: {type: lerobot, trust_remote_code: true}", "--env.trust_remote_code=true"),
            (f"env: {{type: lerobot, kwargs: {{hub_path: {ARENA}}}}}", f"--env.kwargs.hub_path={ARENA}"),
            ("imagination: {discover_packages_path: os}", "--imagination.discover_packages_path=os"),
            ("env: {type: gym, id: a/B, discover_packages_path: os}", "--env.discover_packages_path=os"),
            ("launch: {address: 'them:6379'}", "--launch.address=them:6379"),
        ],
    )
    def test_of_a_file_is_none(self, tmp_path: Path, text: str, flag: str) -> None:
        with pytest.raises(InputError, match="a file cannot allow this, only the command line can") as caught:
            parse(RunConfig, [written(tmp_path, text)])
        assert flag in str(caught.value)

    def test_is_given_again_where_a_file_has_it(self, tmp_path: Path) -> None:
        env = LeRobotEnvConfig(name="isaaclab_arena", trust_remote_code=True, kwargs={"hub_path": ARENA})
        path = written(tmp_path, encode(RunConfig(env=env)))
        flags = [f"--env.kwargs.hub_path={ARENA}", "--env.trust_remote_code=true"]
        with pytest.raises(InputError, match=f"add {' '.join(flags)}$"):
            parse(RunConfig, [path])
        assert parse(RunConfig, [path, *flags]).env == env
        with pytest.raises(InputError, match="^env.kwargs.hub_path="):
            parse(RunConfig, [path, flags[1]])
        other = ["--env.type=simulated", "--env.task=match"]
        assert parse(RunConfig, [path, *other]).env.type == "simulated"

    def test_of_another_verb_does_not_matter(self, tmp_path: Path) -> None:
        path = written(tmp_path, "sft: {trust_remote_code: true}\nenv: {type: simulated}")
        assert parse(EvalRun, [path], recipe_class=RunConfig).env == SimulatedConfig()


class TestPreflight:
    @pytest.mark.parametrize(
        ("policy", "message"),
        [
            ({"type": "smol"}, "sft.policy.type='smol': no such policy type here; install the package"),
            ({"type": "act", "chunks": 3}, "sft.policy.chunks=3: LeRobot's act has no such field"),
            ({"type": "smolvla", "num_steps": "x"}, "sft.policy.num_steps='x': LeRobot says: "),
            ({"type": "smolvla", "num_steps": 0}, r"sft.policy.num_steps=0: use a whole number in \[1, "),
            ({"type": "smolvla", "chunk_size": 9}, "sft.policy={'chunk_size': 9}: LeRobot says: The "),
            ({"type": "smolvla", "n_obs_steps": 2}, "sft.policy.n_obs_steps=2: only diffusion looks back"),
            ({"type": "vqbet"}, "sft.policy.type='vqbet': algorithm.type=gipo needs exact likelihoods"),
        ],
    )
    def test_refuses(self, policy: dict[str, Any], message: str) -> None:
        with pytest.raises(InputError, match=f"^{message}"):
            check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))

    def test_accepts_but_no_backbone_for_another_policy(self, tiny_checkpoint: Path) -> None:
        check_sft_policy(SFTConfig(steps=1, policy={"type": "vqbet"}))  # SFT alone could
        policy = {"type": "smolvla", "chunk_size": 10, "n_action_steps": 10}
        check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))
        check_start(RunConfig(sft=SFTConfig(steps=1, policy={"type": "diffusion"})))
        check_start(parse(RunConfig, ["--env.type=simulated", f"--policy.path={tiny_checkpoint}"]))
        with pytest.raises(InputError, match=r"^sft\.backbone=BackboneConfig\("):
            check_sft_policy(SFTConfig(steps=1, policy={"type": "act"}, backbone=BackboneConfig()))


def test_the_world_model_of_a_run_is_not_that_of_pixels(tmp_path: Path):
    for model, flags in (("{type: latent}", ["--world_model.image_size=32"]), ("{image_size: 32}", [])):
        arguments = [written(tmp_path, f"world_model: {model}"), "--dataset.repo_id=a/b", *flags]
        assert parse(WorldModelRun, arguments, recipe_class=RunConfig).world_model.image_size == 32
    assert parse(RunConfig, ["few_shot"]).state_model.type == "simulator"
    assert parse(RunConfig, ["few_shot", "--env.environment_state=false"]).state_model.type == "latent"


@pytest.mark.parametrize("inside", ["", "checkpoints/000010", "checkpoints/000010/pretrained_model"])
def test_a_run_s_folder_is_its_recipe(inside: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "checkpoints" / "000010"):
        (folder / "pretrained_model").mkdir(parents=True)
        (folder / "config.yaml").write_text(json.dumps({"seed": 7}))
    assert parse(RunConfig, [f"--config_path={tmp_path / inside}"]).seed == 7
    (empty := tmp_path / "empty" / "empty").mkdir(parents=True)
    with pytest.raises(InputError, match="a folder without config.yaml"):
        parse(RunConfig, [f"--config_path={empty}"])
