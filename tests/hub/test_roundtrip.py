# SPDX-License-Identifier: Apache-2.0
"""A pushed folder comes back as it was and loads, through the real client and a Hub on this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter, pinned
from accerl_lerobot.testing import perturb
from tests.hub_server import HubServer, environment
from tests.world_model.test_pixels import dots, model, windows

ROOT = Path(__file__).parents[2]
TINY = ROOT / "datasets" / "metaworld_tiny"

LOAD = """
import hashlib, json, sys
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
def digest(state):
    parts = (k.encode() + v.numpy().tobytes() for k, v in sorted(state.items()))
    return hashlib.sha256(b"".join(parts)).hexdigest()
found = {}
for path, revision in json.loads(sys.argv[1]):
    adapter = load_adapter(PolicyConfig(path=path, revision=revision, device="cpu"))
    found[path] = [digest(adapter.policy.state_dict()), digest(adapter.value_head.state_dict())]
stock = get_policy_class("smolvla").from_pretrained(sys.argv[2])
make_pre_post_processors(stock.config, pretrained_path=sys.argv[2])
found["stock"] = digest(stock.state_dict())
from lerobot.datasets.lerobot_dataset import LeRobotDataset
found["data"] = [len(LeRobotDataset(sys.argv[3])), LeRobotDataset("any/name", root=sys.argv[4])[0]["task"]]
print(json.dumps(found))
"""


def accerl(*arguments: str) -> None:
    assert cli.main(list(arguments)) == 0


def fresh(server: HubServer, home: Path, *arguments: str) -> Any:
    """What is found by a new process with an empty cache."""
    command = [sys.executable, "-c", LOAD, *arguments]
    variables = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | environment(server, home)
    done = subprocess.run(command, env=variables, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


@pytest.mark.slow
def test_policies_and_datasets_load_wherever_they_are(hub: HubServer, tiny_checkpoint: Path, tmp_path: Path):
    adapter = load_adapter(PolicyConfig(path=str(tiny_checkpoint), device="cpu"))
    perturb(adapter, 0.1)
    adapter.save(tmp_path / "first")  # it has a critic and a backbone of its own
    accerl("push", f"--path={tmp_path / 'first'}", "--repo_id=alice/policy")
    commit = hub.repo("alice/policy").branches["main"]
    original = (tmp_path / "first").rename(tmp_path / "moved")  # what names the old place is found out
    accerl("pull", "--repo_id=alice/policy", f"--output_dir={tmp_path / 'policy'}")
    at_first = PolicyConfig(path="alice/policy", device="cpu")
    assert pinned(at_first) == replace(at_first, revision=commit)
    hub.plant("alice/policy", {"model.safetensors": b"what came later"})
    pulled = str(tmp_path / "policy")
    places = [(str(original), None), (pulled, None), ("alice/policy", commit)]
    accerl("push", f"--path={TINY}", "--repo_id=alice/tiny")
    accerl("pull", "--repo_id=alice/tiny", f"--output_dir={tmp_path / 'tiny'}")
    found = fresh(hub, tmp_path / "home", json.dumps(places), pulled, "alice/tiny", str(tmp_path / "tiny"))
    assert all(found[path] == found[pulled] for path, _ in places)
    assert found["stock"] == found[pulled][0]
    assert found["data"] == [365, "Open a drawer"]
    files = {p.relative_to(tmp_path / "tiny"): p.read_bytes() for p in (tmp_path / "tiny").rglob("*.*")}
    assert {p.relative_to(TINY): p.read_bytes() for p in TINY.rglob("*.*")}.items() <= files.items()
    before = hub.files("alice/policy", revision=commit)
    accerl("push", f"--path={pulled}", "--repo_id=alice/policy")
    assert hub.files("alice/policy") == before, "there and back changes nothing"


def test_a_world_model_brings_its_success_model(hub: HubServer, tmp_path: Path):
    from accerl_lerobot.world_model.imagined import World, load_world, save_world

    world = World(model(), ["go"], ["a"], ["auroc"])
    world.model.fit_statistics(windows(dots(2)))
    save_world(tmp_path / "world_model", world)
    accerl("push", f"--path={tmp_path / 'world_model'}", "--repo_id=alice/environment")
    accerl("pull", "--repo_id=alice/environment", f"--output_dir={tmp_path / 'pulled'}")
    came = load_world(tmp_path / "pulled")
    assert (came.tasks, came.learnt, came.failed_checks) == (["go"], ["a"], ["auroc"])
    assert (came.model.spec, came.model.config) == (world.model.spec, world.model.config)
    assert all(torch.equal(value, came.state_dict()[name]) for name, value in world.state_dict().items())
