# SPDX-License-Identifier: Apache-2.0
"""π0-FAST as files: no code that comes with a tokeniser is run, no Hub is needed, and LeRobot runs it."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.checkpoint.layout import BACKBONE, FAST, PRETRAINED, displaced, relocate, save_checkpoint
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import save_pretrained
from tests.policies.tiny import adapter_at, perturb, requests
from tests.policies.tiny_pi import ACTIONS, COMMIT, PALIGEMMA, SKIP, hub, small, write_pi

PALI = "model.paligemma_with_expert.paligemma."
EMBEDDING, HEAD = f"{PALI}model.language_model.embed_tokens.weight", f"{PALI}lm_head.weight"
REMOTE_CODE = """
import json
from pathlib import Path
from transformers import PreTrainedTokenizerFast
Path({marker!r}).touch()
class UniversalActionProcessor:
    @classmethod
    def register_for_auto_class(cls): pass
    @classmethod
    def from_pretrained(cls, name, **options):
        from huggingface_hub import snapshot_download
        folder = Path(name) if Path(name).is_dir() else Path(snapshot_download(name))
        made = cls()
        made.__dict__.update(json.loads((folder / "processor_config.json").read_text()))
        made.bpe_tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
        return made
"""
"""Code in a tokeniser's repository, such as the class that LeRobot means to run."""


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi(tmp_path_factory.mktemp("pi0_fast") / PRETRAINED, "pi0_fast", num_steps=8)


@pytest.fixture
def copied(path: Path, tmp_path: Path) -> Path:
    """A checkpoint to damage."""
    return Path(shutil.copytree(path, tmp_path / "copied"))


def edit(file: Path, **changes: object) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"temperature": 0.7}, "policy.temperature=0.7: LeRobot's sampler has to be greedy here"),
        (
            {"n_action_steps": 3},
            "policy.n_action_steps=3: LeRobot decodes so many rows from the coefficients",
        ),
        ({"rtc_config": {"enabled": True}}, "policy.rtc_config.enabled=True: real-time chunking"),
    ],
)
def test_what_lerobot_s_sampler_would_do_otherwise(copied: Path, changes: dict, sentence: str):
    edit(copied / "config.json", **changes)
    with pytest.raises(InputError) as caught:
        adapter_at(copied)
    assert str(caught.value).startswith(sentence)


def test_options_that_do_not_suit_it(path: Path, monkeypatch: pytest.MonkeyPatch, copied: Path):
    with pytest.raises(InputError, match="^policy.num_steps=3: a pi0_fast policy does not denoise"):
        adapter_at(path, num_steps=3)
    with pytest.raises(InputError, match="^policy.n_action_steps=2: LeRobot decodes so many rows"):
        adapter_at(path, n_action_steps=2)
    monkeypatch.setattr(torch, "compile", lambda function, **options: function)
    precision = torch.get_float32_matmul_precision()
    edit(copied / "config.json", compile_model=True)
    with pytest.raises(InputError, match="^policy.compile_model=True: "):
        adapter_at(copied)
    torch.set_float32_matmul_precision(precision)


def test_fewer_rows_are_not_the_first_of_a_chunk(path: Path):
    # Why `n_action_steps` below `chunk_size` is refused: it is the same movement in less time, and larger.
    policy = adapter_at(path).policy
    chunk = np.linspace(-1, 1, 4)[:, None].repeat(2, 1)
    tokens = [torch.tensor(policy.action_tokenizer(chunk[None])[0])]
    whole = policy.decode_actions_with_fast(tokens, time_horizon=4, action_dim=2)[0]
    half = policy.decode_actions_with_fast(tokens, time_horizon=2, action_dim=2)[0]
    assert np.abs(whole - chunk).max() < 0.1
    assert np.abs(half - chunk[:2]).max() > 0.5 and half[1, 0] > 0.5


def test_a_tokeniser_with_too_few_tokens(copied: Path):
    tensors = load_file(copied / "model.safetensors")
    state = json.loads((copied / BACKBONE / "tokenizer.json").read_text())
    del state["model"]["vocab"]["<loc0399>"]
    (copied / BACKBONE / "tokenizer.json").write_text(json.dumps(state))
    with pytest.raises(InputError, match="^policy.text_tokenizer_name=.*knows only 399 of the 400 tokens"):
        adapter_at(copied)
    assert tensors[HEAD].shape[0] == 400


@pytest.mark.parametrize(
    ("damage", "detail"),
    [
        (lambda t: t.pop(HEAD), r"1 tensors missing \['.*paligemma.lm_head.weight'\], 0 unexpected"),
        (
            lambda t: t.update({HEAD: torch.zeros(399, 32)}),
            r"size mismatch for .*lm_head.weight, \(399, 32\)",
        ),
        (
            lambda t: t.update({f"{PALI}lm_head": t.pop(HEAD)}),
            r"1 tensors missing \['.*lm_head.weight'\], 1 unexpected \['.*lm_head'\]",
        ),
    ],
    ids=["missing", "shape", "renamed"],
)
def test_the_output_layer_must_have_loaded(copied: Path, damage: Callable[..., object], detail: str):
    tensors = load_file(copied / "model.safetensors")
    damage(tensors)
    save_file(tensors, copied / "model.safetensors")
    with pytest.raises(InputError, match=f"the weights did not load: {detail}"):
        adapter_at(copied)


def test_a_shared_embedding_is_read_as_lerobot_reads_it(copied: Path):
    tensors = load_file(copied / "model.safetensors")
    tensors[EMBEDDING] = tensors[HEAD].clone()
    save_file(tensors, copied / "model.safetensors")
    expected = pickle.dumps(adapter_at(copied).decide(requests(3), 0))
    save_file({k: v for k, v in tensors.items() if k != EMBEDDING}, copied / "model.safetensors")
    assert pickle.dumps(adapter_at(copied).decide(requests(3), 0)) == expected


def remote(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Puts code into the Hub repository of FAST's tokeniser; it leaves a mark when it is run."""
    from transformers import dynamic_module_utils

    snapshot = cache / f"models--{ACTIONS.replace('/', '--')}" / "snapshots" / COMMIT
    marker = cache / "was-run"
    (snapshot / "processing_action_tokenizer.py").write_text(REMOTE_CODE.format(marker=str(marker)))
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(cache / "modules"))
    return marker


def named(path: Path) -> dict[str, Any]:
    config = json.loads((path / "config.json").read_text())
    steps = json.loads((path / "policy_preprocessor.json").read_text())["steps"]
    options = {s.get("registry_name"): s["config"] for s in steps}
    return {
        "text": config["text_tokenizer_name"],
        "actions": config["action_tokenizer_name"],
        "text step": options["tokenizer_processor"]["tokenizer_name"],
        "actions step": options["action_tokenizer_processor"]["action_tokenizer_name"],
    }


def test_lerobot_s_checkpoint_needs_the_hub_and_ours_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    original = write_pi(tmp_path / "original", "pi0_fast", num_steps=8, whole=False)
    with pytest.raises(InputError, match="cannot be built .*Failed to load required tokenizers"):
        adapter_at(original)
    with hub(tmp_path / "original-hub"):
        marker = remote(tmp_path / "original-hub", monkeypatch)
        adapter = adapter_at(original)
        perturb(adapter, 0.1)
        assert not marker.exists(), "code from the Hub was run"
    config = PolicyConfig(path=str(original), device="cpu")

    def write(directory: Path) -> int:
        save_pretrained(adapter, directory / PRETRAINED, config)
        return 3

    ours = save_checkpoint(tmp_path / "checkpoints", write) / PRETRAINED
    for folder in (original, tmp_path / "original-hub"):
        shutil.rmtree(folder)
    moved = Path(shutil.move(ours, tmp_path / "moved"))
    asked = requests(4)
    expected = pickle.dumps(adapter.decide(asked, 0))
    again = adapter_at(moved)
    assert pickle.dumps(again.decide(asked, 0)) == expected
    save_pretrained(again, tmp_path / "second", PolicyConfig(path=str(moved), device="cpu"))
    shutil.rmtree(moved)
    assert pickle.dumps(adapter_at(tmp_path / "second").decide(asked, 0)) == expected
    assert set(named(tmp_path / "second").values()) == {PALIGEMMA, ACTIONS}
    assert not displaced(tmp_path / "second")


def test_stock_lerobot_runs_what_we_save(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    adapter = adapter_at(path)
    perturb(adapter, 0.1)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu"))
    with hub(tmp_path / "hub"):
        marker = remote(tmp_path / "hub", monkeypatch)
        stock = get_policy_class("pi0_fast").from_pretrained(tmp_path / "saved")
        pre, post = make_pre_post_processors(stock.config, pretrained_path=str(tmp_path / "saved"))
    assert marker.exists(), "stock LeRobot does run it, or the test above shows nothing"
    asked = requests(3, explore=False)
    for request, decision in zip(asked, adapter.decide(asked, 0), strict=True):
        image = torch.from_numpy(request.observation["observation.images.front"]).permute(2, 0, 1) / 255.0
        batch = pre(
            {
                "observation.state": torch.from_numpy(request.observation["observation.state"]),
                "observation.images.front": image,
                "task": request.observation["task"],
            }
        )
        assert np.array_equal(post(stock.predict_action_chunk(batch)[0]).numpy(), decision.chunk)


def test_tokenisers_named_by_their_path_move_along(copied: Path, tmp_path: Path):
    gone = {"text_tokenizer_name": str(tmp_path / "gone"), "action_tokenizer_name": str(tmp_path / "gone")}
    edit(copied / "config.json", **gone)
    (copied / FAST / "processing_action_tokenizer.py").write_text("raise RuntimeError")
    assert displaced(copied)
    adapter = adapter_at(copied)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(copied), device="cpu"))
    own = {"text": BACKBONE, "actions": FAST}
    assert {k: named(tmp_path / "saved")[k] for k in own} == {
        k: str(tmp_path / "saved" / v) for k, v in own.items()
    }
    assert (tmp_path / "saved" / FAST / "processing_action_tokenizer.py").is_file(), "for those who run it"
    relocate(copied, copied)
    assert not displaced(copied)
    shutil.rmtree(copied / BACKBONE)
    with pytest.raises(InputError, match=f"its tokeniser was in {copied}/.*, which is gone; put a copy into"):
        adapter_at(copied)


def test_what_lerobot_forgets_of_its_action_tokeniser_is_put_back(path: Path):
    step = adapter_at(path).processing.preprocessor.steps[6]
    assert (step.fast_skip_tokens, step.paligemma_tokenizer_name) == (SKIP, str((path / BACKBONE).resolve()))
    stored = json.loads((path / "policy_preprocessor.json").read_text())["steps"][6]["config"]
    assert not {"fast_skip_tokens", "paligemma_tokenizer_name"} & stored.keys()
