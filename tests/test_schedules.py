# SPDX-License-Identifier: Apache-2.0
"""Schedules: who waits for whom, on paper and in a run."""

import functools
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.replay.buffer import OVERLAP, SYNCHRONOUS, ReplayConfig
from benchmarks.simulated_environment import LatencyConfig
from benchmarks.simulated_policy import SimulatedPolicyConfig, load_simulated
from tests.replay.segments import make_segment
from tests.replay.test_worker import BATCH, play, start, waits
from tests.runs import changed, drive, tiny_run, updates

TWO = {"workers": 2}
SIZES = ReplayConfig(capacity=64, min_decisions=8, max_unlearned_decisions=16, samples_per_insert=1.0)


def test_in_turn_who_brings_the_last_segment_waits_until_it_is_learned_from():
    async def scene(worker: Any) -> None:
        await worker.set_schedule(SYNCHRONOUS)
        asked = start(worker.sample(BATCH, 0))
        assert await waits(asked)
        assert await worker.insert([make_segment("a", 4)])  # half a batch: go on
        last = start(worker.insert([make_segment("b", 4)]))
        assert await waits(last) and len(await asked) == 2
        following = start(worker.sample(BATCH, 1))  # asked for while it learns
        assert await waits(last) and await waits(following)
        await worker.learnt()
        assert await last
        assert await waits(following)  # nothing new yet

    play(scene, SIZES)


def test_with_overlap_one_batch_is_collected_meanwhile():
    async def scene(worker: Any) -> None:
        await worker.set_schedule(OVERLAP)
        asked = start(worker.sample(BATCH, 0))
        await waits(asked)
        assert await worker.insert([make_segment("a", 8)])
        assert len(await asked) == 1
        following = start(worker.sample(BATCH, 1))
        assert await worker.insert([make_segment("b", 4)])
        last = start(worker.insert([make_segment("c", 4)]))
        assert await waits(last) and await waits(following)
        await worker.learnt()
        assert len(await following) == 2 and await last

    play(scene, SIZES)


@pytest.mark.slow
@pytest.mark.parametrize("schedule", [SYNCHRONOUS, OVERLAP])
def test_a_run_in_turn(light_ray: None, schedule: Any):
    """Episodes of one segment each, of all four environments: a batch is what they do in one round."""
    from accerl_lerobot.engines.ray_engine import RayEngine

    config = tiny_run(
        Path("nowhere"),
        env=LatencyConfig(max_steps=16, reward="dense", frame_ms=3.0, latency_cv=0.5),
        rollout={"workers": 2, "environments": 2, "segment_length": 4, "decision_cost": 0.0},
        replay={"capacity": 256, "max_unlearned_decisions": 16, "samples_per_insert": 1.0},
        trainer={"updates": 6, "probe_every": 0},
        launch={"schedule": schedule},
    )
    load = functools.partial(load_simulated, SimulatedPolicyConfig(decide_ms=1.0, update_ms=30.0))
    with closing(RayEngine(config, ("match",), load=load)) as engine:
        engine.train()
        history = drive(engine)
    made = updates(history)
    assert [u["update"] for u in made] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    lags = [u["lag_max"] for u in made]
    if schedule == SYNCHRONOUS:
        assert lags == [0.0] * 6
    else:
        assert lags[0] == 0.0 and set(lags[1:]) <= {0.0, 1.0} and 1.0 in lags
    assert history[-1].replay["trained_decisions"] == 6 * 16, "nothing is lost on the way"
    assert np.isfinite([u["loss"] for u in made]).all()


@pytest.mark.parametrize(
    ("message", "sections"),
    [
        (r"inference\.workers=2.*rollout\.workers, 1", {"inference": TWO}),
        (r"inference\.workers=2.*local", {"inference": TWO, "rollout": TWO, "launch": {"engine": "local"}}),
        (r"launch\.schedule.*episodes", {"launch": {"schedule": SYNCHRONOUS}, "rollout": {"episodes": 8}}),
        (
            r"launch\.schedule.*imagination",
            {"launch": {"schedule": SYNCHRONOUS}, "imagination": {"environments": 4, "path": "somewhere"}},
        ),
        (r"launch\.schedule.*engine=local", {"launch": {"schedule": OVERLAP, "engine": "local"}}),
    ],
)
def test_schedules_and_replicas_that_cannot_be_are_refused(message: str, sections: dict[str, Any]):
    with pytest.raises(InputError, match=message):
        changed(RunConfig(), **sections)
