# SPDX-License-Identifier: Apache-2.0
"""Cards say what was measured, and how the thing is used, and their metadata is what the Hub reads."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import yaml
from huggingface_hub import ModelCard

from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.hub.card import MARK, PushConfig
from accerl_lerobot.hub.transfer import stage
from accerl_lerobot.policies.config import PLUGINS
from tests.hub.folders import write_json, write_policy_folder, write_run_folder

LAST = "checkpoints/last/pretrained_model"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run_folder(tmp_path / "run")


def card_of(folder: Path, kind: str = "policy", **fields: str) -> str:
    files = stage(PushConfig(path=str(folder), repo_id="alice/door", **fields), folder, kind)
    return bytes(files["README.md"]).decode()


def test_metadata(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    data = ModelCard(card_of(run / LAST)).data
    assert data.library_name == "lerobot" and data.pipeline_tag == "robotics"
    assert data.tags == ["accerl-lerobot", "policy", "act", "metaworld", "reinforcement-learning", "gipo"]
    assert data.base_model == "lerobot/smolvla_base"
    assert data.datasets is None, "the dataset was a folder, its name a label"
    monkeypatch.chdir(tmp_path)
    Path("lerobot/smolvla_base").mkdir(parents=True)
    assert ModelCard(card_of(run / LAST)).data.base_model is None, "a folder is no base model"


def test_numbers_films_and_recipe_for_people(run: Path, tmp_path: Path):
    text = card_of(run / LAST)
    assert "\n# door\n" in text
    assert "| before RL | match | 25.0% | 40 | 14.2% to 40.2% |" in text
    assert "| after RL | match | 75.0% | 40 | 59.8% to 85.8% |" in text
    assert "| env steps | 12,345 |" in text and "| updates | 12 |" in text and "| seed | 3 |" in text
    assert 'src="accerl_run/before_after.mp4"' in text and "](accerl_run/success_curve.png)" in text
    assert "task: door-open-v3" in text and str(tmp_path) not in text
    assert "## Measured" not in card_of(run / "checkpoints/000006/pretrained_model")


def test_an_evaluation_is_what_counts_last(run: Path, tmp_path: Path):
    policy = run / LAST
    tasks = {t: {"success": s, "n": 50, "ci95": [0.1, 0.9]} for t, s in (("a", 0.4), ("b", 0.6))}
    found = {"success": 0.5, "n": 100, "ci95": [0.4038, 0.5962], "tasks": tasks, "policy": str(policy)}
    write_json(tmp_path / "eval" / "evaluation.json", found)
    text = card_of(policy, evaluation=str(tmp_path / "eval"))
    assert "| accerl eval | all tasks | 50.0% | 100 | 40.4% to 59.6% |" in text
    assert "| accerl eval | b | 60.0% | 50 |" in text


@pytest.mark.parametrize(("kind", "place"), [("policy", LAST), ("world model", "")])
def test_commands_in_the_card_are_commands(run: Path, kind: str, place: str):
    write_json(run / "config.json", {"spec": {}, "model": {}})
    blocks = [part.split("```")[0] for part in card_of(run / place, kind).split("```bash\n")[1:]]
    commands = [line for block in blocks for line in block.splitlines() if line.startswith("accerl ")]
    assert any(line.startswith("accerl pull --repo_id=alice/door") for line in commands)
    for line in commands:
        _, verb, *arguments = shlex.split(line)
        parse(CONFIGS[verb], [a for a in arguments if "config.yaml" not in a], recipe_class=RunConfig)


def test_stock_lerobot_and_a_plugin_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(PLUGINS, "smolvla_bins", "lerobot_policy_smolvla_bins")
    run = write_run_folder(tmp_path / "run", type="smolvla_bins", vlm_model_name="org/vlm")
    recipe = yaml.safe_load((run / "config.yaml").read_text())
    recipe["policy"]["rename_map"] = {"observation.images.corner2": "observation.images.camera1"}
    (run / "config.yaml").write_text(yaml.safe_dump(recipe))
    text = card_of(run / LAST)
    [line] = [line for line in text.splitlines() if line.startswith("lerobot-eval --policy.path=door")]
    assert "--policy.discover_packages_path=lerobot_policy_smolvla_bins" in line
    assert '"task": "door-open-v3"' in line
    assert '--rename_map={"observation.images.corner2": "observation.images.camera1"}' in shlex.split(line)
    assert "loads it from the Hub as well: `--policy.path=alice/door`" in text


def test_a_validation_is_reported(tmp_path: Path):
    write_json(tmp_path / "world_model" / "config.json", {"spec": {}, "model": {}})
    found = {"skill": 0.25, "sensitivity": 1.5, "auroc": 0.97123, "failed": ["skill"], "episodes": 40}
    write_json(tmp_path / "validation.json", found)
    text = card_of(tmp_path / "world_model", "world model")
    assert "**It failed validation**" in text and "| auroc | 0.9712 | yes |" in text
    assert "| skill | 0.25 | no |" in text


def test_the_users_own_card_is_left_alone(tmp_path: Path):
    folder = write_policy_folder(tmp_path / "policy")
    (folder / "README.md").write_text("# mine\n")
    files = stage(PushConfig(path=str(folder), repo_id="a/b"), folder, "policy")
    assert files["README.md"] == folder / "README.md"
    (folder / "README.md").write_text(f"{MARK}\nold\n")  # ours, of an earlier push
    assert "old" not in card_of(folder)
