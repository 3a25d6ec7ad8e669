# SPDX-License-Identifier: Apache-2.0
"""Packages of other people: how a command is put together, and what counts as right."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from benchmarks import third_party
from benchmarks.third_party import words

TABLE = yaml.safe_load(Path(third_party.__file__).with_suffix(".yaml").read_text())


def test_every_situation_is_a_command_of_ours(tmp_path: Path):
    for situation in TABLE["situations"]:
        arguments = words(situation["command"], TABLE["texts"], tmp_path)
        names = [argument.partition("=")[0] for argument in arguments]
        assert arguments[0] in ("eval", "train", "demos") and len(set(names)) == len(names), arguments
        assert situation.get("policy") in (None, *TABLE["policies"])
        for pattern in ("prints", "not_prints"):
            re.compile(situation.get(pattern, ""))
    assert words("demos --root={folder}/x '--env.task=a b'", {}, Path("/r")) == [
        "demos", "--root=/r/x", "--env.task=a b",
    ]  # fmt: skip
