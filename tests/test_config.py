# SPDX-License-Identifier: Apache-2.0
"""Recipes and overrides into configs; every mistake is one line with field, value and hint, exit code 2."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot import cli
from accerl_lerobot.algorithms import GIPOConfig, PPOConfig
from accerl_lerobot.cli.configs import DemosRun, EvalRun, WorldModelRun
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import RunConfig, decode, encode, parse
from accerl_lerobot.envs import LeRobotEnvConfig, MetaWorldConfig, SimulatedConfig
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


@pytest.fixture
def recipe(tmp_path: Path) -> str:
    path = tmp_path / "recipe.yaml"
    path.write_text(RECIPE)
    return str(path)


class TestOverrides:
    """Overrides of a recipe by the command line."""

    def test_a_field_of_a_choice_needs_no_type(self, recipe: str) -> None:
        config = parse(RunConfig, [f"--config_path={recipe}", "--env.task=match", "--algorithm.sigma=2"])
        assert config.env == SimulatedConfig(task="match", image_size=64)
        assert config.algorithm == GIPOConfig(sigma=2.0, gamma=0.9)
        assert config.trainer.lr == 3e-5 and config.job_name == "mine"

    @pytest.mark.parametrize("form", ["--config_path={}", "--config_path {}", "{}"])
    def test_forms_of_naming_a_recipe(self, recipe: str, form: str) -> None:
        assert parse(RunConfig, [*form.format(recipe).split(), "--seed=3"]).job_name == "mine"

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
        arguments += ["--policy.rename_map={a: b}"]
        config = parse(RunConfig, [*arguments, "--algorithm.sigma=.inf", "--job_name=a: b: c"])
        assert config.trainer.betas == (0.8, 0.9) and config.policy.rename_map == {"a": "b"}
        assert config.seed == 4 and config.resume is True and math.isinf(config.algorithm.sigma)
        assert config.job_name == "a: b: c"
        config = parse(RunConfig, ["--sft.policy.type=smolvla", "--sft.policy.chunk_size=7"])
        assert config.sft.policy == {"type": "smolvla", "chunk_size": 7}

    @pytest.mark.parametrize("text", ["trainer:\n  # lr: 1\nenv:\n", "# nothing yet\n"])
    def test_an_empty_section_is_all_defaults(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "r.yaml").write_text(text)
        assert parse(RunConfig, [str(tmp_path / "r.yaml")]) == RunConfig()
        assert parse(RunConfig, ["--sft.backbone=null"]) == RunConfig(), "an optional one"

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
    ([], "policy.path=None: give a LeRobot checkpoint"),
    (["--help=trainr"], "--help='trainr': use all or one of env, dataset"),
    (["--lr=3"], "lr=3: no such field; did you mean sft.lr or trainer.lr?"),
    (["--trainer.lrr=3"], "trainer.lrr=3: no such field; did you mean trainer.lr?"),
    (["--wandb.zzz=1"], "wandb.zzz=1: no such field; wandb has enable, project"),
    (["--trainer.lr=many"], "trainer.lr='many': use a number"),
    (["--trainer.updates=1.5"], "trainer.updates=1.5: use a whole number"),
    (["--trainer.updates"], "trainer.updates='': give it a value: --trainer.updates=…"),
    (["--trainer=3"], "trainer=3: a config section; use --trainer.field=value"),
    (["--trainer.betas=[1]"], "trainer.betas=(1.0,): use a list of 2, each a number"),
    (["--env.task=[a]"], "env.task=['a']: use text"),
    (["--algorithm.type=ppo", "--algorithm.sigma=1"], "algorithm.sigma=1: no such field"),
    (["--algorithm.type=gippo"], "algorithm.type='gippo': use one of awr, "),
    (["--env.type=mujoco"], "env.type='mujoco': use one of gym, lerobot, libero, metaworld, simulated"),
    (["--env.task=drawer-v3"], "env.task='drawer-v3': 'drawer-v3' is no task; did you mean"),
    (["--replay.max_unlearned_decisions=3"], "replay.max_unlearned_decisions=3: use at least one batch, 128"),
    (["--policy.path=x", "--sft.steps=5"], "policy.path='x': add --sft.steps=0 to improve this checkpoint"),
    (["--sft.policy.chunk_size=5"], "sft.policy={'chunk_size': 5}: name LeRobot's policy type, e.g."),
    (["--steps=3"], "steps=3: the name is LeRobot's; use trainer.updates, or sft.steps"),
    (["--peft.r=3"], "peft={'r': 3}: the name is LeRobot's; use policy.tuning.mode=lora and"),
    (["--env.discover_packages_path=a/b"], "env.discover_packages_path='a/b': cannot be imported"),
    (["--seed=1", "--seed=2"], "seed=2: it is set to 1 already; give it once"),
    (["here.yaml", "--config_path=there.yaml"], "config_path='here.yaml': it is set to 'there.yaml' already"),
    (["seed=2"], "config_path='seed=2': no such file; this package has act_pusht, "),
    (["--seed=1", "--seed.x=2"], "seed.x=2: seed is set to 1 already"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[" ".join(a)[:80] for a, _ in MISTAKES])
def test_mistakes(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith(f"accerl: {message}")


FILES: list[tuple[str, str]] = [
    ("env: {type: metaworld\n", "not good YAML: while parsing a flow mapping"),
    ("trainer: {lr: 1}\nseed: 1\ntrainer: {lr: 2}\n", "not good YAML: trainer is given twice in "),
    ("- 1\n- 2\n", "a recipe is a mapping"),
    ("a: !!python/object:os.system {}\n", "not good YAML: could not determine a constructor"),
]


@pytest.mark.parametrize(("text", "message"), FILES, ids=range(len(FILES)))
def test_bad_files(text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(text)
    assert cli.main(["train", f"--config_path={path}"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"accerl: config_path={str(path)!r}: {message}") and err.count("\n") == 1


def test_a_recipe_says_how_it_differs_from_its_base(recipe: str, tmp_path: Path) -> None:
    middle, top = tmp_path / "middle.yaml", tmp_path / "top.yaml"
    middle.write_text(f"base: {recipe}\ntrainer: {{updates: 5}}\nalgorithm: {{gamma: 0.8}}\n")
    top.write_text(f"base: {middle}\njob_name: top\nalgorithm: {{type: ppo}}\n")
    config = parse(RunConfig, [str(top), "--seed=3"])
    assert (config.job_name, config.seed, config.env.type) == ("top", 3, "simulated")
    assert (config.trainer.updates, config.trainer.lr) == (5, 3e-5)
    assert config.algorithm == PPOConfig(gamma=0.8)
    assert parse(DemosRun, [str(top)], recipe_class=RunConfig).env == config.env
    top.write_text("base: nowhere")
    with pytest.raises(InputError, match="^base='nowhere': no such file"):
        parse(RunConfig, [str(top)])
    top.write_text(f"base: {top}")
    with pytest.raises(InputError, match="^base=.*top.yaml': this recipe is laid on itself"):
        parse(RunConfig, [str(top)])
    middle.write_text("policy: {trust_remote_code: abc}")
    top.write_text(f"base: {middle}")
    with pytest.raises(InputError, match="a file cannot allow this"):
        parse(RunConfig, [str(top)])


def test_odd_text_stays_text() -> None:
    for text in ("{[1]: 2}", "[" * 900, "2024-13-45", "*x", "block #2", "012345", "1_000", ""):
        assert parse(RunConfig, [f"--job_name={text}"]).job_name == text


def test_another_repository_is_not_asked_for_the_former_one_s_commit(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("policy: {path: me/one, revision: abc}\n")
    assert parse(RunConfig, [str(path), "--policy.path=me/other"]).policy.revision is None
    assert parse(RunConfig, [str(path), "--policy.path=me/one"]).policy.revision == "abc"


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
        path = tmp_path / "config.yaml"
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            parse(RunConfig, [str(path)])
        assert "a file cannot allow this, only the command line can" in str(caught.value)
        assert flag in str(caught.value)

    def test_is_given_again_where_a_file_has_it(self, tmp_path: Path) -> None:
        path = tmp_path / "config.yaml"
        env = LeRobotEnvConfig(name="isaaclab_arena", trust_remote_code=True, kwargs={"hub_path": ARENA})
        path.write_text(yaml.safe_dump(encode(RunConfig(env=env))))
        with pytest.raises(
            InputError, match=f"add --env.kwargs.hub_path={ARENA} --env.trust_remote_code=true$"
        ):
            parse(RunConfig, [str(path)])
        flags = [f"--env.kwargs.hub_path={ARENA}", "--env.trust_remote_code=true"]
        assert parse(RunConfig, [str(path), *flags]).env == env
        with pytest.raises(InputError, match="^env.kwargs.hub_path="):
            parse(RunConfig, [str(path), flags[1]])
        assert (
            parse(RunConfig, [str(path), "--env.type=simulated", "--env.task=match"]).env.type == "simulated"
        )

    def test_of_another_verb_does_not_matter(self, tmp_path: Path) -> None:
        path = tmp_path / "config.yaml"
        path.write_text("sft: {trust_remote_code: true}\nenv: {type: simulated}")
        assert parse(EvalRun, [str(path)], recipe_class=RunConfig).env == SimulatedConfig()


class TestPreflight:
    """LeRobot's knowledge about `sft.policy`."""

    @pytest.mark.parametrize(
        ("policy", "backbone", "message"),
        [
            ({"type": "smol"}, None, "sft.policy.type='smol': no such policy type here; install the package"),
            ({"type": "act", "chunks": 3}, None, "sft.policy.chunks=3: LeRobot's act has no such field"),
            ({"type": "smolvla", "num_steps": "x"}, None, "sft.policy.num_steps='x': LeRobot says: "),
            ({"type": "smolvla", "num_steps": 0}, None, "sft.policy.num_steps=0: use a whole number in [1, "),
            ({"type": "smolvla", "chunk_size": 9}, None, "sft.policy={'chunk_size': 9}: LeRobot says: The "),
            ({"type": "act"}, BackboneConfig(), "sft.backbone=BackboneConfig("),
        ],
    )
    def test_refuses(self, policy: dict[str, Any], backbone: BackboneConfig | None, message: str) -> None:
        with pytest.raises(InputError) as caught:
            check_sft_policy(SFTConfig(steps=1, policy=policy, backbone=backbone))
        assert str(caught.value).startswith(message)

    @pytest.mark.parametrize(
        ("policy", "message"),
        [
            ({"type": "smolvla", "n_obs_steps": 2}, "sft.policy.n_obs_steps=2: only diffusion looks back"),
            ({"type": "vqbet"}, "sft.policy.type='vqbet': algorithm.type=gipo needs exact likelihoods"),
        ],
    )
    def test_refuses_before_training_it_what_cannot_be_improved(self, policy: dict, message: str) -> None:
        check_sft_policy(SFTConfig(steps=1, policy=policy))  # SFT alone could
        with pytest.raises(InputError, match=f"^{message}"):
            check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))

    def test_accepts(self, tiny_checkpoint: Path) -> None:
        policy = {"type": "smolvla", "chunk_size": 10, "n_action_steps": 10}
        check_start(RunConfig(sft=SFTConfig(steps=1, policy=policy)))
        check_start(RunConfig(sft=SFTConfig(steps=1, policy={"type": "diffusion"})))
        check_start(parse(RunConfig, ["--env.type=simulated", f"--policy.path={tiny_checkpoint}"]))


def test_the_world_model_of_a_run_is_not_that_of_pixels(tmp_path: Path):
    run = parse(
        RunConfig, ["--config_path=few_shot", "--world_model.type=latent", "--world_model.latents=32"]
    )
    assert decode(RunConfig, encode(run)) == run
    recipe = tmp_path / "config.yaml"
    recipe.write_text(yaml.safe_dump(encode(run)))
    flags = [f"--config_path={recipe}", "--dataset.repo_id=a/b", "--world_model.image_size=32"]
    assert parse(WorldModelRun, flags, recipe_class=RunConfig).world_model.image_size == 32
    recipe.write_text("world_model: {image_size: 32}")
    assert parse(WorldModelRun, flags[:2], recipe_class=RunConfig).world_model.image_size == 32


def test_the_state_is_the_simulators_where_it_is_told():
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
