# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine with a trainer of two ranks, all of it real: SmolVLA, Ray, gloo, FSDP2."""

import os
import signal
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.engines.ray_engine import RayEngine
from accerl_lerobot.engines.stopping import WorkerError
from tests.runs import drive, polls, tiny_run
from tests.test_ray_session import LOOPBACK, listening


@pytest.mark.slow
def test_a_run_with_two_ranks_is_saved_and_loses_a_rank_that_hangs(tiny_checkpoint: Path, tmp_path: Path):
    two = {"updates": 1000, "warmup_updates": 0, "value_warmup_updates": 1, "ranks": 2, "sharding": "zero3"}
    config = tiny_run(tiny_checkpoint, trainer=two | {"probe_every": 3}, launch={"stall_s": 25.0})
    with closing(RayEngine(config, ("match",))) as engine:
        pids = engine.pids()
        engine.train()
        updates: list[dict[str, float]] = []
        for progress in polls(engine):
            updates += progress.updates
            served = int(progress.inference.get("version", 0.0))
            probes = [u["logprob/mismatch_max"] for u in updates if "logprob/mismatch_max" in u]
            if progress.version >= 6 and served > 0 and len(probes) >= 2:
                break
        saved, addresses = engine.save(tmp_path), set(listening())
        os.kill(pids["trainer rank 1"], signal.SIGSTOP)
        with pytest.raises(WorkerError, match=r"^trainer worker failed for good:"):
            drive(engine)
    assert addresses and addresses <= LOOPBACK
    updates += saved.updates
    assert [u["update"] for u in updates[: saved.version]] == [i + 1.0 for i in range(saved.version)]
    assert 0 < served <= saved.version
    assert all(np.isfinite(u["loss"]) and u["value_grad_norm"] > 0 and not u["skipped"] for u in updates)
    assert [u["grad_norm"] > 0 for u in updates] == [False] + [True] * (len(updates) - 1)
    assert max(probes) <= 1e-4, "decisions were made by whole weights that had been in parts"

    before, after = (load_file(p / "model.safetensors") for p in (tiny_checkpoint, tmp_path / PRETRAINED))
    assert {k: t.shape for k, t in after.items()} == {k: t.shape for k, t in before.items()}
    assert any(not torch.equal(after[k], before[k]) for k in before)
    trained = snapshot.load(tmp_path / TRAINING_STATE / WEIGHTS)
    named = {k.removeprefix("policy."): v for k, v in trained.items() if k.startswith("policy.")}
    assert all(np.array_equal(after[k].numpy(), named[k]) for k in after if k in named) and len(named) > 20
