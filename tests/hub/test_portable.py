# SPDX-License-Identifier: Apache-2.0
"""No path of this machine is in what leaves it, and what is no such path stays as it is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from accerl_lerobot.hub.push import is_record, scrubbed


def test_paths_in_json_and_yaml(tmp_path: Path):
    tree = {
        "own": str(tmp_path / "backbone" / "fast"),
        "other": str(tmp_path.parent / "with blanks" / "demos"),
        "output_dir": str(tmp_path),
        "nested": [{"argument": f"--root={tmp_path.parent}/data/x.json,y"}],
        "home": "~/runs/one",
        "mac": "/Users/somebody/model",
        "kept": ["lerobot/smolvla_base", "observation.front", 0.5, None, True, "m/s", "1/2/3", "/", "/tmp"],
        "url": "https://example.org/tmp/a/b",
        "pattern": "data/*/*.parquet",
    }
    wanted = tree | {
        "own": "backbone/fast",
        "other": "LOCAL/demos",
        "output_dir": None,
        "nested": [{"argument": "--root=LOCAL/x.json,y"}],
        "home": "LOCAL/one",
        "mac": "LOCAL/model",
    }
    assert json.loads(scrubbed("a.json", json.dumps(tree).encode(), tmp_path)) == wanted
    assert yaml.safe_load(scrubbed("a.yaml", yaml.safe_dump(tree).encode(), tmp_path)) == wanted


def test_paths_in_lines(tmp_path: Path):
    text = f'{{"a": "{tmp_path}/x/y.png"}}\nsaved to {tmp_path.parent}/z/w at 3/4 of https://a.b/tmp/c/d\n'
    new = scrubbed("log.jsonl", text.encode(), tmp_path).decode()
    assert new == '{"a": "x/y.png"}\nsaved to LOCAL/w at 3/4 of https://a.b/tmp/c/d\n'


@pytest.mark.parametrize("indent", [None, 1, 4])
def test_what_has_no_paths_keeps_every_byte(tmp_path: Path, indent: int | None):
    data = json.dumps(
        {"b": 1e-5, "a": "é", "url": "http://a/b/c"}, indent=indent, ensure_ascii=False
    ).encode()
    assert scrubbed("config.json", data, tmp_path) is data
    assert scrubbed("config.json", b"\xff\xfe/tmp/a/b", tmp_path) == b"\xff\xfe/tmp/a/b"
    assert scrubbed("a.json", f"no json: {tmp_path}/b".encode(), tmp_path) == b"no json: b"


def test_vocabularies_and_weights_are_no_records():
    records = ["config.json", "a/config.yaml", "metrics.jsonl", "README.md", "backbone/tokenizer_config.json"]
    assert all(map(is_record, records))
    others = [
        "backbone/tokenizer.json",
        "vocab.json",
        "model.safetensors",
        "a.png",
        "x.parquet",
        "merges.txt",
    ]
    assert not any(map(is_record, others))
