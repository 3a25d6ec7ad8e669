# SPDX-License-Identifier: Apache-2.0
"""Warm start: LeRobot's own trainer in a process of its own, its items from memory, and a random backbone."""

import json
import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.dataset_tools import delete_episodes, remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from transformers import AutoTokenizer

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos import guarded_train, sft
from accerl_lerobot.demos.backbone import BackboneConfig, write_backbone
from accerl_lerobot.demos.sft import ANSWER, SFTConfig, picked, run_sft, sft_command
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from datasets import Image
from tests.policies.tiny import adapter_at
from tests.tiny_datasets import record_dataset

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
HUB = DatasetConfig(repo_id="a/b")
LOCAL = DatasetConfig(repo_id="accerl/metaworld_tiny", root=str(ROOT))
CAMERA = "observation.images.corner2"
TINY = SFTConfig(
    steps=2, batch_size=4, num_threads=1, backbone=BackboneConfig(hidden=32, patch=8),
    policy={
        "type": "smolvla", "num_vlm_layers": 2, "num_expert_layers": 2, "chunk_size": 4, "n_action_steps": 4,
        "max_state_dim": 4, "max_action_dim": 4, "resize_imgs_with_padding": [32, 32], "num_steps": 2,
        "expert_width_multiplier": 1.0, "train_expert_only": False, "freeze_vision_encoder": False,
    },
)  # fmt: skip


@pytest.mark.parametrize("episodes", [None, [1, 2]])
def test_items_are_the_stock_ones_from_memory_and_decode_no_image_twice(episodes: Any, monkeypatch: Any):
    options = {"delta_timestamps": {"action": [0, 1 / 80, 2 / 80]}, "video_backend": "pyav"}
    dataset = LeRobotDataset("a/b", ROOT, episodes, return_uint8=True, **options)
    indices = (0, 7, 88, len(dataset) - 1)
    stock = [dataset[index] for index in indices]
    assert stock[-1]["action_is_pad"].tolist() == [False, True, True]  # reaches beyond its episode
    decode, decoded = Image.decode_example, []
    monkeypatch.setattr(Image, "decode_example", lambda *args, **kw: decoded.append(1) or decode(*args, **kw))
    monkeypatch.setattr(DatasetReader, "_query_hf_dataset", guarded_train.query_rows)
    cached = guarded_train.CachedDataset(dataset)
    assert cached.meta is dataset.meta and len(cached) == cached.num_frames == len(dataset)
    for index, item in [*zip(indices, stock, strict=True)] * 2:
        assert cached[index].keys() == item.keys()
        assert all(np.array_equal(cached[index][key], item[key]) for key in item)
    assert len(decoded) == len(indices)


def test_episodes_are_picked_by_their_label(tmp_path: Path):
    env = SimulatedConfig(max_steps=16)
    dataset = record_dataset(tmp_path / "dataset", env, episodes=4, failure_share=0.5)
    assert picked(dataset, "all") is None
    assert picked(dataset, "successes") == [0, 2] and picked(dataset, "failures") == [1, 3]
    data = LeRobotDataset("a/b", root=dataset.root)
    delete_episodes(data, [0, 2], output_dir=tmp_path / "lost", repo_id="a/b")
    with pytest.raises(InputError, match=r"^sft\.pick='successes': none of .* 2 episodes; use all"):
        picked(replace(dataset, root=str(tmp_path / "lost")), "successes")
    remove_feature(data, ["next.success", "next.reward"], output_dir=tmp_path / "bare", repo_id="a/b")
    with pytest.raises(InputError, match=r"^sft\.pick='failures': .*not labelled by next\.success or"):
        picked(replace(dataset, root=str(tmp_path / "bare")), "failures")


def test_two_steps_of_lerobot_s_trainer_give_a_checkpoint(tmp_path: Path):
    path = run_sft(TINY, LOCAL, tmp_path / "sft", seed=0, texts=["Open a drawer"])
    assert path == tmp_path / "sft" / "checkpoints" / "last" / "pretrained_model"
    adapter = adapter_at(path)
    shape = adapter.family.shape
    assert (shape.executed, shape.action_dim, shape.padded_dim) == (4, 4, 4)
    assert list(adapter.policy.config.image_features) == [CAMERA]


def command_that(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(sft, "sft_command", lambda *arguments: [sys.executable, "-u", "-c", program])


BAR = r"print('\rTraining:   0%|          | 0/8 [00:00<?, ?step/s]', end='', flush=True)"


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (f"{BAR}\nraise SystemExit('out of disk')", "out of disk"),
        (f"{BAR}\nraise ValueError('no q01,\\nno q99')", "ValueError: no q01, no q99"),
        (f"{BAR}\nimport os; os.kill(os.getpid(), 9)", "was ended by SIGKILL"),
    ],
    ids=["exit", "exception", "killed"],
)
def test_a_failing_trainer_s_last_exception_is_the_reason(program, reason, tmp_path, monkeypatch):
    command_that(monkeypatch, program)
    with pytest.raises(RuntimeError) as caught:
        run_sft(TINY, HUB, tmp_path / "sft", seed=0)
    assert str(caught.value).startswith(f"lerobot-train failed, see {tmp_path / 'sft.log'}: {reason}")
    assert not any(words in str(caught.value) for words in ("%|", "\n", ANSWER))


def test_progress_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    lines = [
        "INFO 2026-01-01 12:00:00 train.py:1 step:25 smpl:2K ep:4 epch:0.41 loss:1.250 grdn:2.0 lr:1.0e-03",
        "a line: with colons",
        "step:2K loss:0.5",
        "Training:  15%|█▍ | 2975/20000 [18:59<3:52:57,  1.22step/s]INFO step:3K smpl:190K loss:0.259",
        "step:1M loss:nan",
        "step:? loss:0.5",
    ]
    command_that(monkeypatch, f"print({chr(10).join(lines)!r})")
    seen: list[tuple[int, float]] = []
    run_sft(TINY, HUB, tmp_path / "sft", seed=0, on_step=lambda step, loss: seen.append((step, loss)))
    np.testing.assert_array_equal(seen, [(25, 1.25), (2000, 0.5), (2975, 0.259), (1_000_000, np.nan)])


def test_an_interrupted_caller_takes_the_trainer_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program = "import os, time; print(f'step:{os.getpid()} loss:1', flush=True); time.sleep(600)"
    command_that(monkeypatch, program)
    seen: list[int] = []

    def interrupt(step: int, loss: float) -> None:
        seen.append(step)
        raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_sft(TINY, HUB, tmp_path / "sft", seed=0, on_step=interrupt)
    assert time.monotonic() - started < 300, "it was not waited for"
    with pytest.raises(ProcessLookupError):
        os.kill(seen[0], 0)


def test_the_command_line(tmp_path: Path):
    dataset = DatasetConfig(repo_id="a/b", root="/data", revision="v1")
    command = sft_command(TINY, dataset, tmp_path / "sft", 3, "cpu", [0, 2])
    assert command[:3] == [sys.executable, "-m", "accerl_lerobot.demos.guarded_train"]
    assert {
        "--policy.type=smolvla", "--policy.resize_imgs_with_padding=[32, 32]", "--policy.device=cpu",
        "--policy.train_expert_only=false", f"--policy.vlm_model_name={tmp_path / 'backbone'}",
        "--policy.push_to_hub=false", "--policy.optimizer_lr=0.001", "--policy.scheduler_decay_steps=2",
        "--dataset.repo_id=a/b", "--dataset.root=/data", "--dataset.revision=v1",
        "--dataset.episodes=[0, 2]", "--steps=2", "--seed=3",
    } <= set(command)  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "schedule"), [("act", set()), ("diffusion", {"--policy.scheduler_warmup_steps=3"})]
)
def test_a_preset_gets_only_what_it_has(tmp_path: Path, kind: str, schedule: set[str]):
    command = sft_command(SFTConfig(steps=9, policy={"type": kind}), HUB, tmp_path / "sft", 0, "cpu")
    assert {a for a in command if "scheduler" in a} == schedule
    assert not [a for a in command if "pretrained_backbone_weights" in a], "a new policy's own choice"
    chosen = SFTConfig(steps=9, policy={"type": "vqbet", "scheduler_warmup_steps": 300})
    assert "--policy.scheduler_warmup_steps=300" in sft_command(chosen, HUB, tmp_path / "sft", 0, "cpu")
    (tmp_path / "config.json").write_text(json.dumps({"type": kind}))
    start = SFTConfig(steps=9, init_path=str(tmp_path), extra_args=["--log_freq=1"])
    command = sft_command(start, HUB, tmp_path / "sft", 0, "cpu")
    assert f"--policy.path={tmp_path}" in command and command[-1] == "--log_freq=1"
    assert "--policy.pretrained_backbone_weights=null" in command, "the checkpoint replaces them"


def test_a_moved_checkpoint_is_started_from_a_copy(tiny_checkpoint, tmp_path, monkeypatch):
    start, moved = tmp_path / "start", tmp_path / "moved"
    adapter_at(tiny_checkpoint).save(start)
    seen: list[str | None] = []
    nothing = [sys.executable, "-c", ""]
    monkeypatch.setattr(sft, "sft_command", lambda config, *_: seen.append(config.init_path) or nothing)
    run_sft(SFTConfig(steps=1, init_path=str(start)), HUB, tmp_path / "one" / "sft", seed=0)
    shutil.move(start, moved)
    before = (moved / "config.json").read_text()
    copy = tmp_path / "two" / "init"
    for _ in range(2):  # the second time after one that was stopped
        run_sft(SFTConfig(steps=1, init_path=str(moved)), HUB, tmp_path / "two" / "sft", seed=0)
    assert seen == [str(start), str(copy), str(copy)]
    assert (moved / "config.json").read_text() == before
    assert json.loads((copy / "config.json").read_text())["vlm_model_name"].startswith(str(copy))


TEXTS = ["Open the door", "Close the drawer"]


def test_instructions_are_few_tokens_and_others_still_encode(tmp_path: Path):
    learned = AutoTokenizer.from_pretrained(write_backbone(tmp_path / "learned", TEXTS))
    plain = AutoTokenizer.from_pretrained(write_backbone(tmp_path / "plain"))
    assert [len(plain(text).input_ids) for text in TEXTS] == [13, 16], "a byte each"
    assert all(len(learned(text).input_ids) <= 5 for text in TEXTS)
    for text in (*TEXTS, "Öffne die Tür 🚪", "pick\tup\n"):
        for tokenizer in (learned, plain):
            assert tokenizer.decode(tokenizer(text).input_ids) == text
