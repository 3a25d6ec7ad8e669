# SPDX-License-Identifier: Apache-2.0
"""Names, sizes and headers from outside; no line of the package runs what it should not; no secrets."""

import ast
import os
import random
import re
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath

import numpy as np
import pytest
from safetensors.numpy import save_file

from accerl_lerobot import cli
from accerl_lerobot.checkpoint.safety import FileSource, read_json, read_tensors, safe_join, tensor_shapes
from accerl_lerobot.errors import InputError
from tests.hub_cache import cached_repo
from tests.test_repository import parsed, sources, tracked

ORIGIN = FileSource("policy.path", "runs/theirs")
NAMES = (
    "..", ".", "", "/", "//", "\\", "a", "data", "C:", "C:\\", "~", "~root", "\x00", "\n", "\x7f", "\ud800",
    "%2e%2e", "..;", "...", " ", "x" * 256, "é" * 128, "file.parquet", "CON", "{chunk_index}", "$HOME", "-rf",
)  # fmt: skip


def test_twenty_thousand_hostile_names_stay_inside(tmp_path: Path):
    """Either refused, or a path below the folder, here and on Windows; nothing is made on the way."""
    root = tmp_path / "root"
    (root / "data").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (root / "a").symlink_to(tmp_path / "secret")
    (root / "chunk-000").symlink_to("..")
    before = sorted(tmp_path.rglob("*"))
    joined = refused = 0
    rng = random.Random(0)
    for _ in range(20_000):
        parts = [rng.choice(NAMES) for _ in range(rng.choice((1, 2, 2, 3, 5, 400)))]
        first = rng.choice(("", "/", "./", "../", "\\\\host\\", "file://"))
        name = first + rng.choice(("/", "/", "\\")).join(parts)
        try:
            path = safe_join(root, name, ORIGIN)
        except InputError as error:
            assert error.field == "policy.path" and "\n" not in str(error)
            refused += 1
            continue
        joined += 1
        assert path.resolve().is_relative_to(root.resolve()) and path != root
        assert os.path.realpath(os.path.join(root, name)).startswith(f"{root.resolve()}/")
        assert not PureWindowsPath(name).is_absolute() and ".." not in PureWindowsPath(name).parts
    assert joined > 500 and refused > 5_000
    assert sorted(tmp_path.rglob("*")) == before


def test_links_lead_about_inside_and_in_the_hub_s_cache_only(tmp_path: Path):
    root = tmp_path / "root"
    (root / "data").mkdir(parents=True)
    (root / "data" / "x").write_text("x")
    (tmp_path / "secret").write_text("secret")
    (root / "inside").symlink_to("data/x")
    (root / "folder").symlink_to(tmp_path)
    assert safe_join(root, "inside", ORIGIN).read_text() == "x"
    for name in ("folder/secret", "folder"):
        with pytest.raises(InputError, match="a link that leads out"):
            safe_join(root, name, ORIGIN)
    snapshot = cached_repo(tmp_path / "hub", "a/b", "abc")
    blobs = snapshot.parents[1] / "blobs"
    blobs.mkdir()
    (blobs / "f00").write_text("{}")
    (snapshot / "config.json").symlink_to("../../blobs/f00")
    (snapshot / "other").symlink_to("../../../../secret")
    assert safe_join(snapshot, "config.json", ORIGIN).read_text() == "{}"
    with pytest.raises(InputError, match="leads out"):
        safe_join(snapshot, "other", ORIGIN)


@pytest.mark.parametrize("verb", ["report {}", "timeline {}", "export --path={} --root=new"])
def test_a_run_from_elsewhere_is_read_without_leaving_its_folder(verb, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.chdir(tmp_path)
    (run / "config.yaml").write_text("trainer: {}\n")
    (tmp_path / "secret").write_text("secret")
    (run / "metrics.jsonl").symlink_to("../secret")
    assert cli.main(verb.format(run).split()) == 2
    error = capsys.readouterr().err
    assert "metrics.jsonl: a link that leads out" in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "secret"]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{", "not good JSON"),
        (b"\xff\xfe", "not good JSON"),
        (b"[1]", "a mapping is wanted, not list"),
        (b"[" * 200_000, "not good JSON"),
    ],
)
def test_json_that_is_refused(tmp_path: Path, content: bytes, why: str):
    path = tmp_path / "config.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"^policy.path='runs/theirs': config.json: .*{why}"):
        read_json(path, ORIGIN)


def test_a_header_is_what_safetensors_wrote(tmp_path: Path):
    save_file({"a": np.zeros((2, 3), np.float32), "b": np.ones(5, np.int64)}, tmp_path / "x.safetensors")
    shapes = tensor_shapes(tmp_path / "x.safetensors", ORIGIN)
    assert shapes == {"a": ("F32", (2, 3)), "b": ("I64", (5,))}
    (tmp_path / "x.safetensors").write_bytes(b"\xff" * 64)
    with pytest.raises(
        InputError, match="^policy.path='runs/theirs': x.safetensors: not safetensors .*; get"
    ):
        tensor_shapes(tmp_path / "x.safetensors", ORIGIN)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_tensors_hold_numbers(tmp_path: Path, value: float):
    arrays = {"a": np.arange(3), "b": np.zeros((0, 2), np.float32), "c": np.array([0, value], np.float16)}
    save_file(arrays, tmp_path / "x.safetensors")
    with pytest.raises(InputError, match="x.safetensors: c holds NaN or infinity; train it again$"):
        list(read_tensors(tmp_path / "x.safetensors", ORIGIN))


BANNED_NAMES = {"__import__", "compile", "input"}
HARMLESS = {"allow_pickle": False, "weights_only": True, "trust_remote_code": False}
"""Option → its only constant that runs nothing."""


def findings(path: Path) -> Iterator[str]:
    """Calls that could run or unpickle what they read, and that no rule of ruff knows."""
    for node in parsed(path)[1]:
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in BANNED_NAMES:
            yield f"{path.name}: {node.func.id}"
        for option in node.keywords:
            value = option.value
            passed_on = option.arg == "trust_remote_code" and not isinstance(value, ast.Constant)
            harmless = isinstance(value, ast.Constant) and value.value is HARMLESS.get(str(option.arg))
            if option.arg in HARMLESS and not (harmless or passed_on):
                yield f"{path.name}: {option.arg}"


def test_nothing_from_outside_is_run_or_unpickled():
    assert [found for path in sources() for found in findings(path)] == []


SECRETS = {
    "Hugging Face token": r"\bhf_[A-Za-z0-9]{30,}\b",
    "GitHub token": r"\b(gh[pousr]_[A-Za-z0-9]{36,}|github_pat_[A-Za-z0-9_]{60,})\b",
    "private key": r"-----BEGIN ([A-Z]+ )*PRIVATE KEY-----",
    "W&B key": r"(?i)wandb.{0,20}\b[0-9a-f]{40}\b",
}


@pytest.mark.parametrize("kind", SECRETS)
def test_no_secret_is_under_version_control(kind: str):
    pattern = re.compile(SECRETS[kind].encode())
    assert [path.name for path in tracked() if pattern.search(path.read_bytes())] == []
