# SPDX-License-Identifier: Apache-2.0
"""The Python interface does what the command line does, and gives objects."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

from accerl_lerobot import RunConfig, evaluate, load_config, load_policy, resume, train
from accerl_lerobot.envs import make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.run import train as run
from tests.test_run import local_run

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


def test_the_package_loads_nothing_until_it_is_used():
    code = (
        "import sys, accerl_lerobot; assert 'torch' not in sys.modules and 'numpy' not in sys.modules;"
        "from accerl_lerobot import RunConfig, train; assert 'lerobot.policies' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_settings_are_those_of_the_command_line():
    changes = {"env.task": "drawer-open-v3", "policy.revision": None, "trainer.betas": [0.9, 0.99]}
    config: Any = load_config("recipes/quickstart.yaml", changes)
    assert config.env.tasks == ("drawer-open-v3",) and config.trainer.betas == (0.9, 0.99)
    assert config.policy.revision is None


def test_a_revision_counts_with_any_policy(monkeypatch: pytest.MonkeyPatch):
    played = MagicMock(return_value=[])
    monkeypatch.setattr(run, "play_evaluation", played)
    config = RunConfig(policy=PolicyConfig(path="me/policy", revision="v1"))
    evaluate(config)
    evaluate(config, revision="v2")
    evaluate(config, policy="me/other", revision="v3")
    evaluate(config, policy="me/other")
    assert [call.args[0].policy.revision for call in played.mock_calls] == ["v1", "v2", "v3", None]


def test_train_evaluate_resume_act(tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = local_run(tiny_checkpoint, tmp_path / "run")
    result = train(config)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result.summary == summary and result.directory == tmp_path / "run"
    assert result.before is not None and result.before.n == result.after.n == 8
    assert result.after.value == summary["success_after"]

    found = evaluate(config, policy=result.policy, episodes=8)
    assert found.success == result.after, "the same policy on the same starts"
    assert list(found.tasks) == ["match"] and len(found.episodes) == 8

    monkeypatch.setenv("HOME", str(tmp_path))
    further = resume("~/run", {"trainer.updates": 14})
    assert further.summary["updates"] == 14 and further.directory == result.directory

    policy, observation = load_policy(further.policy), make_environment(config.env).reset(3, "match")
    chunk = policy.act(observation)
    assert chunk.shape[1] == 2 and np.isfinite(chunk).all()
    assert not np.array_equal(chunk, policy.act(observation)), "a flow policy samples"
    assert np.array_equal(chunk, load_policy(further.policy).act(observation))
    with pytest.raises(InputError, match="resume=True: use accerl_lerobot.resume"):
        train(RunConfig(resume=True))


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(tmp_path: Path):
    cells = json.loads((EXAMPLES / "improve_a_policy.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    script = tmp_path / "notebook.py"
    # The recorder's workers import the main module again.
    script.write_text("if __name__ == '__main__':\n" + "".join(f"    {line}\n" for line in code.splitlines()))
    recipe = yaml.safe_load((EXAMPLES / "simulated.yaml").read_text())
    short = {"demos": {"episodes": 4}, "sft": {"steps": 5}, "trainer": {"updates": 3}}  # the critic's warm-up
    for section, fields in (short | {"evaluation": {"episodes": 8}}).items():
        recipe[section] |= fields
    (tmp_path / "simulated.yaml").write_text(yaml.safe_dump(recipe))
    command = [sys.executable, str(script)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "before" in done.stdout and "one more episode" in done.stdout
