# SPDX-License-Identifier: Apache-2.0
"""Loading refuses what is not the checkpoint; what is saved is LeRobot's, wherever it is moved."""

from __future__ import annotations

import json
import logging
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import draccus
import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.checkpoint.layout import BACKBONE, PRETRAINED, save_checkpoint
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig, ValueHeadConfig
from accerl_lerobot.policies.loading import (
    example_observations,
    load_adapter,
    load_lerobot_config,
    no_tf32,
    resolve_device,
    save_pretrained,
)
from accerl_lerobot.policies.samplers import FlowSamplerConfig, SamplerConfig
from tests.conftest import write_smolvla
from tests.policies.tiny import adapter_at, perturb, requests


@pytest.fixture
def copied(tiny_checkpoint: Path, tmp_path: Path) -> Path:
    """A checkpoint to damage."""
    return Path(shutil.copytree(tiny_checkpoint, tmp_path / "copied"))


def edit_config(path: Path, **changes: object) -> None:
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | changes))


def saved(path: Path, directory: Path, **options: object) -> Path:
    config = PolicyConfig(path=str(path), device="cpu", **options)
    adapter = load_adapter(config)
    perturb(adapter, 0.1)
    save_pretrained(adapter, directory, config)
    return directory


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        (None, "policy.path=None: give a LeRobot checkpoint directory or Hub id"),
        ("./nowhere", "policy.path='./nowhere': no config.json there"),
        ("~/nowhere", "policy.path='~/nowhere': no config.json there"),
        ("a/b/c", "policy.path='a/b/c': not a directory here and not loadable from the Hub"),
        ("no/thing", "policy.path='no/thing': not a directory here and not loadable from the Hub"),
    ],
)
def test_a_path_to_nothing(path: str | None, sentence: str):
    with pytest.raises(InputError) as caught:
        load_lerobot_config(PolicyConfig(path=path))
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_the_folder_above_the_checkpoint(copied: Path):
    (copied / "config.json").unlink()
    for path in (copied, copied / "model.safetensors"):
        with pytest.raises(InputError, match="no config.json there; give the folder named pretrained_model"):
            load_adapter(PolicyConfig(path=str(path)))


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("multi_task_dit", "no likelihood for it here; use one of smolvla, "),
        ("tdmpc", "it plans by sampling and has no action density"),
        ("vqbet", "LeRobot does not return its code log-probs"),
        ("my_policy", "no likelihood for it here; use one of smolvla, "),
    ],
)
def test_a_policy_without_a_likelihood(copied: Path, kind: str, why: str):
    edit_config(copied, type=kind)
    with pytest.raises(InputError) as caught:
        load_adapter(PolicyConfig(path=str(copied)))
    assert str(caught.value).startswith(f"policy.type='{kind}': {copied} is of this type: {why}")


def test_a_config_of_something_else(copied: Path):
    for text, why in (
        ('{"type": "smolvla", "no_such_field": 1}', "its config.json is not one of this LeRobot's policies"),
        ("[1, 2]", "config.json: a mapping is wanted, not list"),
        ("not json", "config.json: not good JSON"),
    ):
        (copied / "config.json").write_text(text)
        with pytest.raises(InputError, match=why):
            load_lerobot_config(PolicyConfig(path=str(copied)))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"rtc_config": {"enabled": True}}, "policy.rtc_config.enabled=True"),
        ({"adapt_to_pi_aloha": True}, "policy.adapt_to_pi_aloha=True"),
    ],
)
def test_samplers_that_have_another_density(copied: Path, changes: dict, field: str):
    edit_config(copied, **changes)
    with pytest.raises(InputError, match=f"^{field}: "):
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))


def test_a_compiled_sampler_is_refused(copied: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    precision = torch.get_float32_matmul_precision()
    edit_config(copied, compile_model=True)
    with pytest.raises(InputError, match="^policy.compile_model=True: "):
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))
    torch.set_float32_matmul_precision(precision)


def without_one(tensors: dict[str, torch.Tensor], key: str) -> None:
    del tensors[key]


def with_one_more(tensors: dict[str, torch.Tensor], key: str) -> None:
    tensors["model.of_another_version"] = torch.zeros(2)


def reshaped(tensors: dict[str, torch.Tensor], key: str) -> None:
    tensors[key] = torch.zeros(3, 3)


def with_nan(tensors: dict[str, torch.Tensor], key: str) -> None:
    tensors[key].view(-1)[0] = float("nan")


@pytest.mark.parametrize(
    ("damage", "detail"),
    [
        (without_one, r"1 tensors missing \['model.action_out_proj.weight'\], 0 unexpected"),
        (with_one_more, r"0 tensors missing \[\], 1 unexpected \['model.of_another_version'\]"),
        (reshaped, "size mismatch for model.action_out_proj.weight"),
        (with_nan, "model.safetensors: model.action_out_proj.weight holds NaN or infinity"),
    ],
)
def test_weights_that_are_not_the_policy_s(copied: Path, damage: Callable[..., None], detail: str):
    tensors = load_file(copied / "model.safetensors")
    damage(tensors, "model.action_out_proj.weight")
    save_file(tensors, copied / "model.safetensors")
    with pytest.raises(InputError, match=f"^policy.path=.*{detail}"):
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))


def with_infinity(tensors: dict[str, torch.Tensor], key: str) -> None:
    tensors[key].view(-1)[-1] = float("-inf")


@pytest.mark.parametrize("damage", [with_nan, with_infinity])
def test_statistics_are_numbers(copied: Path, damage: Callable[..., None]):
    (file,) = copied.glob("policy_preprocessor*.safetensors")
    tensors = load_file(file)
    damage(tensors, "observation.state.mean")
    save_file(tensors, file)
    with pytest.raises(InputError) as caught:
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))
    said = f"{file.name}: observation.state.mean holds NaN or infinity; train it again"
    assert str(caught.value) == f"policy.path='{copied}': {said}"


@pytest.mark.parametrize(
    ("content", "why"),
    [(None, "is missing; give a folder with the weights"), (b"not tensors", "not safetensors")],
)
def test_a_weights_file_that_is_none(copied: Path, content: bytes | None, why: str):
    (copied / "model.safetensors").unlink()
    if content is not None:
        (copied / "model.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=f"^policy.path=.*model.safetensors: {why}"):
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))


def test_missing_processors(copied: Path):
    (copied / "policy_preprocessor.json").unlink()
    with pytest.raises(InputError, match="its LeRobot processors did not load"):
        load_adapter(PolicyConfig(path=str(copied), device="cpu"))


@pytest.mark.parametrize("values", [{"num_steps": 0}, {"n_action_steps": 0}, {"n_action_steps": -1}])
def test_sizes_below_one_are_refused_when_parsed(values: dict):
    with pytest.raises(InputError, match=f"^policy.{next(iter(values))}=.*use a whole number from 1"):
        PolicyConfig(**values)


def test_more_executed_than_predicted(tiny_checkpoint: Path):
    with pytest.raises(
        InputError, match="^policy.n_action_steps=5: use 1 to 4, the chunk the policy predicts"
    ):
        load_lerobot_config(PolicyConfig(path=str(tiny_checkpoint), n_action_steps=5))


def test_devices(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == resolve_device("cpu") == torch.device("cpu")
    for name in ("cuda", "cuda:1"):
        with pytest.raises(
            InputError, match=f"^policy.device='{name}': no CUDA device here; use cpu or auto"
        ):
            resolve_device(name)
    with pytest.raises(InputError, match="^policy.device='gpu': use cpu, cuda or auto"):
        resolve_device("gpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert resolve_device("auto") == torch.device("cuda")


def test_overridden_steps_are_used_and_saved(tiny_checkpoint: Path, tmp_path: Path):
    path = saved(tiny_checkpoint, tmp_path / "saved", num_steps=2, n_action_steps=3)
    adapter = adapter_at(path)
    shape = adapter.family.shape
    assert (shape.num_steps, shape.executed, shape.chunk_size) == (2, 3, 4)
    assert adapter.decide(requests(1), 0)[0].chunk.shape == (3, 2)


def test_a_moved_checkpoint_needs_nothing_from_where_it_was_made(tmp_path: Path):
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    origin = write_smolvla(tmp_path / "origin" / PRETRAINED)
    config = PolicyConfig(path=str(origin), device="cpu")
    adapter = load_adapter(config)
    perturb(adapter, 0.1)

    def write(directory: Path) -> int:
        save_pretrained(adapter, directory / PRETRAINED, config)
        return 12

    path = save_checkpoint(tmp_path / "run" / "checkpoints", write) / PRETRAINED
    shutil.rmtree(tmp_path / "origin")

    stock = SmolVLAPolicy.from_pretrained(path)
    pre, post = make_pre_post_processors(stock.config, pretrained_path=str(path))
    asked = requests(1, explore=False)
    observation = asked[0].observation
    noise, _, _ = adapter.family._noise(asked, adapter.device)
    batch = pre(
        {
            "observation.state": torch.from_numpy(observation["observation.state"]),
            "observation.images.front": torch.from_numpy(observation["observation.images.front"]).permute(
                2, 0, 1
            )
            / 255.0,
            "task": observation["task"],
        }
    )
    expected = adapter.decide(asked, 0)[0].chunk
    assert (post(stock.predict_action_chunk(batch, noise=noise)[0]).numpy() == expected).all()

    moved = shutil.move(tmp_path / "run" / "checkpoints" / "000012", tmp_path / "elsewhere")
    shutil.rmtree(tmp_path / "run")
    again = adapter_at(Path(moved) / PRETRAINED)
    assert pickle.dumps(again.decide(asked, 0)) == pickle.dumps(adapter.decide(asked, 0))
    second = saved(Path(moved) / PRETRAINED, tmp_path / "second")
    shutil.rmtree(moved)
    assert len(adapter_at(second).decide(asked, 0)) == 1, "and so does a checkpoint of the moved one"


def test_a_backbone_that_is_gone_is_named(tmp_path: Path):
    origin = write_smolvla(tmp_path / "origin" / PRETRAINED)
    shutil.rmtree(tmp_path / "origin" / f"{PRETRAINED}-backbone")
    with pytest.raises(
        InputError, match=rf"{PRETRAINED}-backbone, which is gone; put a copy into {BACKBONE}/"
    ):
        load_lerobot_config(PolicyConfig(path=str(origin)))


def test_the_backbone_s_own_weights_are_not_copied(tiny_checkpoint: Path, tmp_path: Path):
    config = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
    adapter = load_adapter(config)
    backbone = Path(shutil.copytree(adapter.policy.config.vlm_model_name, tmp_path / "backbone"))
    (backbone / "model.safetensors").write_bytes(b"large")
    adapter.policy.config.vlm_model_name = str(backbone)
    save_pretrained(adapter, tmp_path / "saved", config)
    assert (tmp_path / "saved" / BACKBONE / "tokenizer.json").is_file()
    assert not (tmp_path / "saved" / BACKBONE / "model.safetensors").exists()
    config_file = json.loads((tmp_path / "saved" / "config.json").read_text())
    assert config_file["vlm_model_name"] == str(tmp_path / "saved" / BACKBONE)


def test_a_checkpoint_on_the_hub_is_loaded_whole(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # The layout of the Hub's cache, as after a download: critic and backbone must come along.
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    repository = tmp_path / "hub" / "models--me--policy"
    path = saved(tiny_checkpoint, repository / "snapshots" / "abc")
    edit_config(path, vlm_model_name="/on/another/machine")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("abc")
    here, there = adapter_at(path), load_adapter(PolicyConfig(path="me/policy", device="cpu"))
    asked = requests(2)
    assert pickle.dumps(there.decide(asked, 0)) == pickle.dumps(here.decide(asked, 0))
    assert there.decide(asked, 0)[0].value != 0
    with pytest.raises(InputError, match="not loadable from the Hub"):
        load_adapter(PolicyConfig(path="me/policy", revision="v9", device="cpu"))


def test_tilde_is_the_home_folder(copied: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(copied.parent))
    assert adapter_at(Path("~/copied")).decide(requests(1), 0)[0].value == 0


def test_the_critic_is_saved_and_loaded(
    tiny_checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    path = saved(tiny_checkpoint, tmp_path / "saved")
    one, other = adapter_at(path), adapter_at(path, value_head=ValueHeadConfig(detach=False))
    values = [a.decide(requests(3), 0)[i].value for a in (one, other) for i in range(3)]
    assert values[:3] == values[3:] and 0 not in values
    assert caplog.text == "", "detach is a choice of training; the weights fit"


@pytest.mark.parametrize("changed", [{"hidden": 16}, {"pooling": "mean"}])
def test_another_critic_starts_anew_with_a_warning(
    tiny_checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, changed: dict
):
    path = saved(tiny_checkpoint, tmp_path / "saved")
    with caplog.at_level(logging.WARNING):
        adapter = adapter_at(path, value_head=ValueHeadConfig(**changed))
    assert adapter.decide(requests(1), 0)[0].value == 0
    ((name, value),) = changed.items()
    assert (
        f"critic is not loaded, a new one starts at V = 0: policy.value_head.{name}={value}, there"
        in caplog.text
    )


def test_another_sampler_is_pointed_out(
    tiny_checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    path = saved(tiny_checkpoint, tmp_path / "saved", sampler=FlowSamplerConfig(noise_level=0.4))
    stored = json.loads((path / "accerl.json").read_text())["sampler"]
    assert stored == draccus.encode(FlowSamplerConfig(noise_level=0.4), SamplerConfig)
    assert stored["type"] == "flow" and stored["noise_level"] == 0.4
    with caplog.at_level(logging.WARNING):
        adapter_at(path, FlowSamplerConfig(noise_level=0.4))
        assert caplog.text == ""
        adapter_at(path, FlowSamplerConfig(noise_level=0.2, stochastic="all"))
    assert (
        "policy.sampler.stochastic=all, there last, policy.sampler.noise_level=0.2, there 0.4" in caplog.text
    )


def test_fp32_is_fp32_on_a_gpu_too():
    backends = (torch.backends.cudnn, torch.backends.cuda.matmul)
    before = [backend.allow_tf32 for backend in backends]
    try:
        for backend in backends:
            backend.allow_tf32 = True
        no_tf32(torch.device("cpu"))
        assert all(backend.allow_tf32 for backend in backends)
        no_tf32(torch.device("cuda"))
        assert not any(backend.allow_tf32 for backend in backends)
    finally:
        for backend, allowed in zip(backends, before, strict=True):
            backend.allow_tf32 = allowed


def test_a_checkpoint_of_lerobot_s_own_trainer_has_neither(
    tiny_checkpoint: Path, caplog: pytest.LogCaptureFixture
):
    assert adapter_at(tiny_checkpoint).decide(requests(1), 0)[0].value == 0
    assert caplog.text == ""


def test_example_observations_carry_the_world_s_names(tiny_checkpoint: Path):
    config = load_lerobot_config(PolicyConfig(path=str(tiny_checkpoint)))
    renames = {"observation.images.top": "observation.images.front"}
    observations, tasks = example_observations(config, renames)
    assert {k: (v.shape, str(v.dtype)) for k, v in observations.items()} == {
        "observation.images.top": ((2, 32, 32, 3), "uint8"),
        "observation.state": ((2, 4), "float32"),
    }
    assert len(tasks) == 2 and len(tasks[0]) != len(tasks[1])
    request = requests(1)[0]
    renamed = {k.replace("front", "top"): v for k, v in request.observation.items()}
    adapter = adapter_at(tiny_checkpoint, rename_map=renames)
    decision = adapter.decide([type(request)(observation=renamed, noise_seed=request.noise_seed)], 0)
    assert pickle.dumps(decision) == pickle.dumps(adapter_at(tiny_checkpoint).decide([request], 0))
