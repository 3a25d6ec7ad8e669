# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5 as files: what did not load is named; what is saved needs no Hub, and LeRobot runs it."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.checkpoint.layout import BACKBONE, PRETRAINED, displaced, relocate, save_checkpoint
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter, load_lerobot_config, save_pretrained
from tests.policies.tiny import adapter_at, perturb, requests
from tests.policies.tiny_pi import KINDS, PALIGEMMA, hub, small, write_pi

Tensors = dict[str, torch.Tensor]
EXPERT = "model.paligemma_with_expert.gemma_expert."
PALI = "model.paligemma_with_expert.paligemma."
EMBEDDING, HEAD = f"{PALI}model.language_model.embed_tokens.weight", f"{PALI}lm_head.weight"


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module", params=KINDS)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi(tmp_path_factory.mktemp(request.param) / PRETRAINED, request.param)


@pytest.fixture
def copied(path: Path, tmp_path: Path) -> Path:
    """A checkpoint to damage."""
    return Path(shutil.copytree(path, tmp_path / "copied"))


def kind_of(path: Path) -> str:
    return str(json.loads((path / "config.json").read_text())["type"])


def change_weights(path: Path, damage: Callable[[Tensors], object]) -> None:
    tensors = load_file(path / "model.safetensors")
    changed = damage(tensors)
    save_file(changed if isinstance(changed, dict) else tensors, path / "model.safetensors")


def renamed(tensors: Tensors) -> None:
    tensors[f"{EXPERT}model.layers.0.mlp.up.weight"] = tensors.pop(
        f"{EXPERT}model.layers.0.mlp.up_proj.weight"
    )


def with_nan(tensors: Tensors) -> None:
    tensors["model.action_out_proj.weight"].view(-1)[3] = float("nan")


@pytest.mark.parametrize(
    ("damage", "detail"),
    [
        (
            lambda t: t.pop("model.action_out_proj.weight"),
            r"1 tensors missing \['model.action_out_proj.weight'\], 0 unexpected \[\]",
        ),
        (
            lambda t: t.pop(f"{PALI}model.vision_tower.vision_model.post_layernorm.bias"),
            r"1 tensors missing \['.*vision_model.post_layernorm.bias'\], 0 unexpected",
        ),
        (renamed, r"1 tensors missing \['.*mlp.up_proj.weight'\], 1 unexpected \['.*mlp.up.weight'\]"),
        (
            lambda t: t.update({"model.action_out_proj.bias": torch.zeros(5)}),
            r"size mismatch for model.action_out_proj.bias, \(5,\) in the file, \(2,\) in the policy",
        ),
        (with_nan, "model.safetensors: model.action_out_proj.weight holds NaN or infinity"),
        (lambda t: {"another": torch.zeros(1)}, r"\d\d tensors missing \['.*', '.*', '.*'\], 1 unexpected"),
    ],
    ids=["missing", "missing-deep", "renamed", "shape", "nan", "another"],
)  # fmt: skip
def test_weights_that_did_not_load_are_named(copied: Path, damage: Callable[..., object], detail: str):
    change_weights(copied, damage)
    with pytest.raises(InputError, match=f"^policy.path=.*: {detail}"):
        adapter_at(copied)


@pytest.mark.parametrize("content", [None, b"not tensors"])
def test_a_weights_file_that_is_none(copied: Path, content: bytes | None):
    # LeRobot prints that it could not be read, and returns random weights.
    (copied / "model.safetensors").unlink()
    if content is not None:
        (copied / "model.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=r"^policy\.path="):
        adapter_at(copied)


def test_weights_of_the_other_kind_are_refused(tmp_path: Path):
    paths = {kind: write_pi(tmp_path / kind, kind) for kind in KINDS}
    for one, other in (KINDS, KINDS[::-1]):
        mixed = Path(shutil.copytree(paths[one], tmp_path / f"{one}-of-{other}"))
        shutil.copy(paths[other] / "model.safetensors", mixed)
        with pytest.raises(InputError, match="the weights did not load: .* tensors missing"):
            adapter_at(mixed)


def test_output_layers_may_be_left_out(copied: Path):
    # No action is computed with them, and a saver that finds one tied to the embedding drops it.
    expected = pickle.dumps(adapter_at(copied).decide(requests(3), 0))
    change_weights(copied, lambda t: [t.pop(k) for k in (HEAD, f"{EXPERT}lm_head.weight")])
    assert pickle.dumps(adapter_at(copied).decide(requests(3), 0)) == expected


def test_openpi_s_names_are_read_as_lerobot_reads_them(copied: Path):
    # Without the leading ``model.``, the input embedding under the name of the output layer.
    def as_openpi(tensors: Tensors) -> Tensors:
        tensors[HEAD] = tensors.pop(EMBEDDING)
        return {k.removeprefix("model."): v for k, v in tensors.items()}

    expected = pickle.dumps(adapter_at(copied).decide(requests(3), 0))
    change_weights(copied, as_openpi)
    assert pickle.dumps(adapter_at(copied).decide(requests(3), 0)) == expected
    change_weights(copied, lambda t: t.pop("action_in_proj.bias"))
    with pytest.raises(InputError, match=r"1 tensors missing \['model.action_in_proj.bias'\]"):
        adapter_at(copied)


def edit_config(path: Path, **changes: object) -> None:
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | changes))


def test_samplers_that_have_another_density(copied: Path, monkeypatch: pytest.MonkeyPatch):
    edit_config(copied, rtc_config={"enabled": True})
    with pytest.raises(InputError, match="^policy.rtc_config.enabled=True: "):
        adapter_at(copied)
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    precision = torch.get_float32_matmul_precision()
    edit_config(copied, rtc_config=None, compile_model=True)
    with pytest.raises(InputError, match="^policy.compile_model=True: "):
        adapter_at(copied)
    torch.set_float32_matmul_precision(precision)


def test_overridden_steps_are_used_and_saved(path: Path, tmp_path: Path):
    config = PolicyConfig(path=str(path), device="cpu", num_steps=2, n_action_steps=3)
    save_pretrained(load_adapter(config), tmp_path / "saved", config)
    shape = adapter_at(tmp_path / "saved").family.shape
    assert (shape.num_steps, shape.executed, shape.chunk_size) == (2, 3, 4)


def tokenizer_names(path: Path) -> list[str]:
    steps = json.loads((path / "policy_preprocessor.json").read_text())["steps"]
    return [s["config"]["tokenizer_name"] for s in steps if s.get("registry_name") == "tokenizer_processor"]


def test_lerobot_s_checkpoint_needs_the_hub_and_ours_does_not(path: Path, tmp_path: Path):
    original = write_pi(tmp_path / "original", kind_of(path), whole=False)
    assert not (original / BACKBONE).exists()
    with pytest.raises(
        InputError, match=f"its LeRobot processors did not load.*into {BACKBONE}/ beside config"
    ):
        adapter_at(original)
    with hub(tmp_path / "original-hub"):
        adapter = adapter_at(original)
        perturb(adapter, 0.1)
    config = PolicyConfig(path=str(original), device="cpu")

    def write(directory: Path) -> int:
        save_pretrained(adapter, directory / PRETRAINED, config)
        return 3

    ours = save_checkpoint(tmp_path / "checkpoints", write) / PRETRAINED
    shutil.rmtree(original)
    moved = Path(shutil.move(ours, tmp_path / "moved"))
    again = adapter_at(moved)
    asked = requests(4)
    expected = pickle.dumps(adapter.decide(asked, 0))
    assert pickle.dumps(again.decide(asked, 0)) == expected
    save_pretrained(again, tmp_path / "second", PolicyConfig(path=str(moved), device="cpu"))
    shutil.rmtree(moved)
    assert pickle.dumps(adapter_at(tmp_path / "second").decide(asked, 0)) == pickle.dumps(
        again.decide(asked, 0)
    )
    assert tokenizer_names(tmp_path / "second") == [PALIGEMMA], "others find it where the original's was"
    assert not displaced(tmp_path / "second")


def test_stock_lerobot_runs_what_we_save(path: Path, tmp_path: Path):
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    adapter = adapter_at(path)
    perturb(adapter, 0.1)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu"))
    stock = get_policy_class(kind_of(path)).from_pretrained(tmp_path / "saved")
    with hub(tmp_path / "hub"):
        pre, post = make_pre_post_processors(stock.config, pretrained_path=str(tmp_path / "saved"))
    asked = requests(1, explore=False)
    observation = asked[0].observation
    image = torch.from_numpy(observation["observation.images.front"]).permute(2, 0, 1) / 255.0
    batch = pre(
        {
            "observation.state": torch.from_numpy(observation["observation.state"]),
            "observation.images.front": image,
            "task": observation["task"],
        }
    )
    noise, _, _ = adapter.family._noise(asked, adapter.device)
    chunk = post(stock.predict_action_chunk(batch, noise=noise)[0]).numpy()
    assert (chunk == adapter.decide(asked, 0)[0].chunk).all()


def test_a_tokeniser_named_by_its_path_moves_along(copied: Path, tmp_path: Path):
    processor = json.loads((copied / "policy_preprocessor.json").read_text())
    for step in processor["steps"]:
        if step.get("registry_name") == "tokenizer_processor":
            step["config"]["tokenizer_name"] = str(tmp_path / "gone")
    (copied / "policy_preprocessor.json").write_text(json.dumps(processor))
    assert displaced(copied)
    save_pretrained(adapter_at(copied), tmp_path / "saved", PolicyConfig(path=str(copied), device="cpu"))
    assert tokenizer_names(tmp_path / "saved") == [str(tmp_path / "saved" / BACKBONE)]
    relocate(copied, copied)
    assert tokenizer_names(copied) == [str(copied / BACKBONE)] and not displaced(copied)
    config = load_lerobot_config(PolicyConfig(path=str(copied), device="cpu"))
    assert not hasattr(config, "vlm_model_name")
