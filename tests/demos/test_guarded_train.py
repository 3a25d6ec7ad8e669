# SPDX-License-Identifier: Apache-2.0
"""LeRobot's trainer runs no code that comes with a tokeniser, a policy or a dataset."""

import json
import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import default
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy
from lerobot.scripts import lerobot_train

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos import guarded_train, sft
from accerl_lerobot.demos.sft import ANSWER, TRUST, SFTConfig, run_sft, sft_command
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError, warn_once
from accerl_lerobot.experience import ENVIRONMENT_STATE
from tests.policies.checkpoints import write_act
from tests.policies.test_loading import remote
from tests.policies.tiny_pi import ACTIONS, COMMIT, PALIGEMMA, hub
from tests.tiny_datasets import record_dataset

HUB = DatasetConfig(repo_id="a/b")
ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"


def run(monkeypatch: pytest.MonkeyPatch, work: Callable[[], Any], *arguments: str) -> Any:
    """`work` where LeRobot's trainer would be; gives what it returns."""
    got: list[Any] = []
    monkeypatch.setattr(lerobot_train, "main", lambda: got.append(work()))
    for owner, name in ((lerobot_train, "make_train_eval_datasets"), (DatasetReader, "_query_hf_dataset")):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # put back after the test
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
    guarded_train.main()
    return got[0]


def tokenise() -> Any:
    """As π0-FAST's training does: LeRobot asks for the newest code and runs it."""
    from lerobot.processor.tokenizer_processor import ActionTokenizerProcessorStep

    step = ActionTokenizerProcessorStep(action_tokenizer_name=ACTIONS, paligemma_tokenizer_name=PALIGEMMA)
    return type(step.action_tokenizer).__name__


def test_pi0_fast_s_tokeniser_is_run_at_the_commit_that_is_named(tmp_path: Path, monkeypatch: Any):
    with hub(tmp_path):
        marker = remote(tmp_path, monkeypatch)
        assert run(monkeypatch, tokenise) == "FastTokenizer", "it is read and not run"
        with pytest.raises(SystemExit):  # no such commit here, and the Hub is offline
            run(monkeypatch, tokenise, f"{TRUST}{'f' * 40}")
        assert not marker.exists()
        assert run(monkeypatch, tokenise, f"{TRUST}{COMMIT}") == "UniversalActionProcessor"
    assert marker.exists() and sys.argv == ["lerobot-train"], "the argument is ours and not LeRobot's"


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (KeyError("observation.state.x"), RuntimeError, "see .*sft.log: KeyError: 'observation.state.x'$"),
        (InputError("sft.x", "x.py", "read it"), InputError, "^sft.x='x.py': read it$"),
    ],
)
def test_a_failure_and_warnings_are_handed_over(error, kind, message, tmp_path, monkeypatch, capsys, caplog):
    def fails() -> None:
        logging.getLogger("accerl_lerobot.x").warning("before %s", kind.__name__)  # each is told once
        raise error

    warn_once.cache_clear()
    with pytest.raises(SystemExit):
        run(monkeypatch, fails)
    out, err = capsys.readouterr()
    caplog.clear()
    program = f"print({err + out!r})\nraise SystemExit(1)"
    monkeypatch.setattr(sft, "sft_command", lambda *_: [sys.executable, "-c", program])
    with pytest.raises(kind, match=message):
        run_sft(SFTConfig(steps=1), HUB, tmp_path / "sft", seed=0)
    assert [record.getMessage() for record in caplog.records] == [f"before {kind.__name__}"]


def test_a_policy_of_images_does_not_read_the_simulators_state(tmp_path: Path, monkeypatch: Any):
    env = SimulatedConfig(max_steps=16, environment_state=True)
    dataset = record_dataset(tmp_path / "data", env, episodes=1)

    def inputs() -> Any:
        data = default.DatasetConfig(repo_id="a/b", root=dataset.root, video_backend="pyav")
        policy = ACTConfig(device="cpu", push_to_hub=False, pretrained_backbone_weights=None)
        made, _ = lerobot_train.make_train_eval_datasets(TrainPipelineConfig(dataset=data, policy=policy))
        return make_policy(policy, ds_meta=made.meta).config.input_features

    found = run(monkeypatch, inputs, "--dataset.repo_id=a/b", f"--dataset.root={dataset.root}")
    assert "observation.state" in found and ENVIRONMENT_STATE not in found


def test_a_hostile_dataset_ends_the_training_in_a_line(tmp_path: Path, monkeypatch: Any, capsys: Any):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = Path(shutil.copytree(ROOT, tmp_path / "data"))
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"data_path": "{chunk_index:999999999}"}))
    arguments = ("--dataset.repo_id=a/b", f"--dataset.root={root}")
    with pytest.raises(SystemExit):
        run(monkeypatch, lambda: LeRobotDataset("a/b", root=root), *arguments)
    answer = json.loads(capsys.readouterr().out.rpartition(ANSWER)[2])
    field, _, hint = answer["refused"]
    assert field == "dataset.root" and "is no template of a file" in hint


def test_a_hostile_start_is_refused_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    start, marker = write_act(tmp_path / "start"), tmp_path / "was-run"
    steps = {"steps": [{"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}}]}
    (start / "policy_preprocessor.json").write_text(json.dumps(steps))
    monkeypatch.setattr(sft.subprocess, "Popen", None)
    with pytest.raises(InputError, match="^sft.init_path=.*only steps with a registry_name"):
        run_sft(SFTConfig(steps=1, init_path=str(start)), HUB, tmp_path / "sft", seed=0)
    assert not marker.exists() and not (tmp_path / "sft.log").exists()


def test_trust_is_asked_for_with_a_commit(tmp_path: Path):
    for value in (True, "main", COMMIT[:39], COMMIT.upper(), f"{COMMIT}\n"):
        with pytest.raises(InputError, match="^sft.trust_remote_code=.*: use the 40 hexadecimal digits"):
            SFTConfig(trust_remote_code=value)
    for commit in (COMMIT, None):
        config = SFTConfig(steps=1, policy={"type": "act"}, trust_remote_code=commit)
        command = sft_command(config, HUB, tmp_path / "sft", 0, "cpu")
        assert [a for a in command if a.startswith(TRUST)] == ([f"{TRUST}{COMMIT}"] if commit else [])


def test_the_trainer_does_not_get_ray_s_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE"):
        monkeypatch.setenv(name, "secret-of-ray")
    program = "import os\nprint([k for k in os.environ if k.startswith('RAY_AUTH')])"
    monkeypatch.setattr(sft, "sft_command", lambda *_: [sys.executable, "-c", program])
    run_sft(SFTConfig(steps=1), HUB, tmp_path / "sft", seed=0)
    assert (tmp_path / "sft.log").read_text().strip() == "[]"
