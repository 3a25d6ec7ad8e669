# SPDX-License-Identifier: Apache-2.0
"""Schedules: who waits for whom, on paper and in a run."""

import functools
from collections import Counter
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines import Progress, ray_engine
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference import worker as inference_worker
from accerl_lerobot.inference.worker import InferenceConfig, InferenceWorker
from accerl_lerobot.replay.buffer import OVERLAP, SYNCHRONOUS, ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.world_model.config import ImaginationConfig
from benchmarks.simulated_environment import LatencyConfig
from benchmarks.simulated_policy import SimulatedPolicyConfig, load_simulated
from tests.replay.segments import make_segment
from tests.replay.test_worker import BATCH, play, start, waits
from tests.runs import polls


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

    play(
        scene, ReplayConfig(capacity=64, min_decisions=8, max_unlearned_decisions=16, samples_per_insert=1.0)
    )


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

    play(
        scene, ReplayConfig(capacity=64, min_decisions=8, max_unlearned_decisions=16, samples_per_insert=1.0)
    )


def run_of(schedule: Any) -> RunConfig:
    return RunConfig(
        env=LatencyConfig(max_steps=16, reward="dense", frame_ms=3.0, latency_cv=0.5),
        rollout=RolloutConfig(workers=2, environments=2, segment_length=4, decision_cost=0.0),
        inference=InferenceConfig(max_batch=3),
        replay=ReplayConfig(
            capacity=256, min_decisions=16, max_unlearned_decisions=16, samples_per_insert=1.0
        ),
        trainer=TrainerConfig(updates=6, batch_decisions=16, probe_every=0),
        launch=LaunchConfig(schedule=schedule, stall_s=60.0),
    )


class CountingInference(InferenceWorker):
    """Counts batches by their observations."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._sizes: Counter[int] = Counter()

    def _serve_batch(self, batch: list[Any]) -> None:
        super()._serve_batch(batch)
        self._sizes[sum(map(len, batch))] += 1

    async def sizes(self) -> Counter[int]:
        return Counter(self._sizes)


@pytest.fixture
def counted(light_ray: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_engine, "POLL_S", 0.05)
    monkeypatch.setattr(inference_worker, "InferenceWorker", CountingInference)


def drive_counting(engine: Any) -> tuple[list[Progress], Counter[int]]:
    """Trains to the end; all that was reported, and the sizes of batches before the end.

    When training has ended nobody waits for the others any more, and until that is noticed there may be any
    number of batches of any size.
    """
    history, sizes = [], [Counter[int](), Counter[int]()]
    for progress in polls(engine):
        history.append(progress)
        if progress.done:
            break
        sizes.append(sum((w.call("sizes") for w in engine._inference), Counter()))
    return history, sizes[-2]  # another look after it has found the run in training


@pytest.mark.slow
@pytest.mark.parametrize("schedule", [SYNCHRONOUS, OVERLAP])
def test_a_run_in_turn(counted: None, schedule: Any):
    """Episodes of one segment each, of all four environments: a batch is exactly what they do in one
    round."""
    from accerl_lerobot.engines.ray_engine import RayEngine

    load = functools.partial(load_simulated, SimulatedPolicyConfig(decide_ms=1.0, update_ms=30.0))
    engine = RayEngine(run_of(schedule), ("match",), load=load)
    try:
        engine.train()
        history, sizes = drive_counting(engine)
        updates = [update for progress in history for update in progress.updates]
        assert [u["update"] for u in updates] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
        lags = [u["lag_max"] for u in updates]
        if schedule == SYNCHRONOUS:
            assert lags == [0.0] * 6
        else:
            assert lags[0] == 0.0 and set(lags[1:]) <= {0.0, 1.0} and 1.0 in lags
        # In lock step all four decide together, in batches of three and one.
        assert sizes[3] + sizes[1] > 0.9 * sizes.total() >= 10
        assert abs(sizes[3] - sizes[1]) < 0.15 * sizes.total()
        # Nothing is lost on the way from the environments to the trainer.
        assert history[-1].replay["trained_decisions"] == 6 * 16
        assert np.isfinite([u["loss"] for u in updates]).all()
    finally:
        engine.close()


def test_schedules_and_replicas_that_cannot_be_are_refused():
    local, synchronous = LaunchConfig(engine="local"), LaunchConfig(schedule=SYNCHRONOUS)
    two = InferenceConfig(workers=2)
    cases: list[tuple[str, dict[str, Any]]] = [
        (r"inference\.workers=2.*rollout\.workers, 1", {"inference": two}),
        (
            r"inference\.workers=2.*local",
            {"inference": two, "rollout": RolloutConfig(workers=2), "launch": local},
        ),
        (
            r"launch\.schedule.*rollout\.episodes",
            {"launch": synchronous, "rollout": RolloutConfig(episodes=8)},
        ),
        (
            r"launch\.schedule.*imagination",
            {"launch": synchronous, "imagination": ImaginationConfig(environments=4, path="somewhere")},
        ),
    ]
    for message, sections in cases:
        with pytest.raises(InputError, match=message):
            RunConfig(**sections)
    with pytest.raises(InputError, match=r"launch\.schedule.*engine=local"):
        LaunchConfig(schedule=OVERLAP, engine="local")
