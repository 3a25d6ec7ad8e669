# SPDX-License-Identifier: Apache-2.0
"""The door between collecting and learning: who waits, and who lets whom through."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.replay.worker import ReplayWorker
from accerl_lerobot.transport import ServiceStoppedError
from tests.replay.segments import make_segment

CONFIG = ReplayConfig(capacity=64, min_decisions=8, max_unlearned_decisions=8, samples_per_insert=1.0)
BATCH = 8


def play(scene: Callable[[ReplayWorker], Awaitable[Any]], config: ReplayConfig = CONFIG) -> Any:
    """A scene that takes 20 s hangs."""

    async def main() -> Any:
        return await asyncio.wait_for(scene(ReplayWorker(config, seed=0)), 20)

    return asyncio.run(main())


async def waits(task: asyncio.Task[Any]) -> bool:
    """True if a call is still under way after everything that can run has run."""
    for _ in range(20):
        await asyncio.sleep(0)
    return not task.done()


def start(call: Awaitable[Any]) -> asyncio.Task[Any]:
    return asyncio.ensure_future(call)


def test_only_as_many_are_let_in_as_the_pace_allows():
    async def scene(worker: ReplayWorker) -> None:
        await worker.insert([make_segment("first", 8)])
        late = [start(worker.insert([make_segment(f"late{i}", 8)])) for i in range(3)]
        assert all([await waits(task) for task in late])
        await worker.sample(BATCH, 0)
        assert [await waits(task) for task in late] == [False, True, True]
        await worker.sample(BATCH, 0)
        assert [await waits(task) for task in late] == [False, False, True]
        await worker.close()
        assert [await task for task in late] == [True, True, False]

    play(scene)


def test_sample_waits_for_the_warm_start_and_then_for_new_segments():
    async def scene(worker: ReplayWorker) -> None:
        early = start(worker.sample(BATCH, 0))
        assert await waits(early)
        await worker.insert([make_segment("a", 4)])
        assert await waits(early)
        await worker.insert([make_segment("b", 4)])
        assert sorted(s.key for s in await early) == ["a", "b"]
        again = start(worker.sample(BATCH, 1))
        assert await waits(again), "both were drawn as often as the pace allows"
        await worker.insert([make_segment("c", 8)])
        assert [s.key for s in await again] == ["c"]

    play(scene)


def test_sample_that_finds_everything_too_old_lets_rollouts_in_and_waits_on():
    async def scene(worker: ReplayWorker) -> None:
        await worker.insert([make_segment("old", 8, version=0)])
        assert await waits(late := start(worker.insert([make_segment("new", 8, version=9)])))
        segments = await worker.sample(BATCH, trainer_version=9)
        assert [s.key for s in segments] == ["new"] and await late
        assert (await worker.metrics())["removed_segments"] == 1

    play(scene, ReplayConfig(capacity=64, min_decisions=8, max_unlearned_decisions=8, max_lag=3))


@pytest.mark.parametrize("broken", ["insert", "sample"])
def test_what_breaks_in_here_ends_this_worker_and_blames_nobody_else(broken: str):
    """A full disk, say, which whoever brings a segment can do nothing about."""

    async def scene(worker: ReplayWorker) -> None:
        def fall_over(*_: Any) -> None:
            raise OSError("no space left on the device")

        running = start(worker.run())
        await worker.insert([make_segment("a", 8)])
        setattr(worker._replay, broken, fall_over)
        with pytest.raises(ServiceStoppedError, match="no space left"):
            await (worker.sample(BATCH, 0) if broken == "sample" else worker.insert([make_segment("c", 8)]))
        for refused in (running, worker.save(Path("nowhere"), 1)):  # no checkpoint of what is half done
            with pytest.raises(OSError, match="no space left"):
                await refused
        with pytest.raises(ServiceStoppedError, match="no space left"):
            await worker.insert([make_segment("d", 8)])

    play(scene, replace(CONFIG, max_unlearned_decisions=32))


def test_close_releases_everyone_and_stores_nothing_more():
    async def scene(worker: ReplayWorker) -> None:
        running = start(worker.run())
        await worker.insert([make_segment("a", 8)])
        assert len(await worker.sample(BATCH, 0)) == 1
        await worker.insert([make_segment("b", 8)])
        inserting = start(worker.insert([make_segment("c", 8)]))
        sampling = [start(worker.sample(1000, 1)) for _ in range(2)]
        assert all([await waits(task) for task in (running, inserting, *sampling)])
        await worker.close()
        assert await inserting is False and [await task for task in sampling] == [[], []]
        assert await running is None
        assert await worker.insert([make_segment("d", 8)]) is False and await worker.sample(BATCH, 1) == []
        assert (await worker.metrics())["inserted_segments"] == 2

    play(scene)
