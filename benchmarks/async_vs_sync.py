# SPDX-License-Identifier: Apache-2.0
"""The gain from asynchrony: the same workers, asynchronous, overlapped and synchronous, by turns in one run.

    S    decisions learned from per second, asynchronous over synchronous
    S*   the most that any schedule could gain over the synchronous one: the tightest of what the
    environments, the
         service and the trainer can do at best, over what the synchronous schedule did
    S/S* how much of that there is

A speed-up without the law of the environments' latency says nothing: where all environments take equally
long there is little to gain. So there is one row per law. And it is worth nothing if less is learned from
each sample; hence runs of equally many updates under each schedule, on a problem that the policy made of
time can learn.
"""

from __future__ import annotations

import statistics
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from rich.console import Group

from accerl_lerobot.config.ranges import Positive, Range, Repeats, Seed, Steps
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import Rate, evaluation_plans
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, OVERLAP, SYNCHRONOUS, Schedule
from benchmarks.latency import TRACE
from benchmarks.machinery import MOST_BUSY, MachineryConfig
from benchmarks.simulated_environment import read_trace
from benchmarks.tables import as_markdown, as_table, drawing, host, output_folder, ranged, spread, write
from benchmarks.throughput import ARMS, Block

LEARNING = MachineryConfig(environments=4, latency_ms=4.0, image_size=16, decide_ms=1.0, update_ms=8.0)
"""Small, as nothing is timed in it."""
TRIALS = 100
"""Episodes of the evaluation that ends a run that learns."""


@dataclass(frozen=True, kw_only=True)
class BenchAsyncVsSyncConfig(MachineryConfig):
    """Fields of ``python -m benchmarks async_vs_sync``."""

    cvs: tuple[Annotated[float, Range("[0, 10]")], ...] = (0.0, 0.1, 0.3, 0.5, 1.0)
    """Laws of latency: standard deviation over mean; takes the place of `latency_cv`."""
    traces: tuple[str, ...] = ()
    """More laws: files of the benchmark `latency`, each an environment's own; takes the place of
    `latency_trace`."""
    seconds: Positive = 8.0
    """Shortest duration of a block."""
    rounds: Repeats = 3
    """Times each arm is measured twice, forth and back."""
    learning_updates: Steps = 18
    """Updates of each run that learns; 0: none does."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds of the runs that learn."""
    output_dir: str = "outputs/async_vs_sync"
    """Folder for async_vs_sync.json, .md and .png."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.cvs or self.traces):
            raise InputError("cvs", self.cvs, "name at least one law, here or in traces")
        for law in laws(self):  # what a run would refuse is refused now
            law.run_config()
        for seed in self.seeds if self.learning_updates else ():
            LEARNING.run_config(updates=self.learning_updates, seed=seed)


def bench_async_vs_sync(config: BenchAsyncVsSyncConfig) -> dict[str, Any]:
    """Measures all laws, then what is learned.

    Returns:
        ``laws``: for each, the blocks, decisions per second by arm, S, S*, S/S* and whether the processors
        were busy; ``learning``: success by arm and seed; ``config`` and ``host``.
    """
    for trace in config.traces:
        read_trace(trace, "traces")
    console, root = Console(), output_folder(config.output_dir)
    result: dict[str, Any] = {"config": asdict(config), "host": host(), "laws": []}
    every = laws(config)
    with console.stage("laws", total=len(every)) as stage:
        for of in every:
            law = _law(config, of)
            result["laws"].append(law)
            stage.update(len(result["laws"]), f"CV {of.cv:.3g}: S {law['speed_up']['median']:.2f}")
    result |= {"learning": {}, "host_after": host()}
    write(root, "async_vs_sync", result, markdown(result))
    if config.learning_updates:
        result["learning"] = _learning(config, console)
    write(root, "async_vs_sync", result, markdown(result), _draw)
    console.say(f"wrote async_vs_sync.json, .md and .png into {root}")
    return result


def compare(config: MachineryConfig, blocks: list[Block]) -> dict[str, Any]:
    """Compares one law's blocks: `bench_async_vs_sync`'s ``laws``."""
    rates = {arm: [b.decisions_per_s for b in blocks if b.schedule == arm] for arm in ARMS}
    waits = {arm: [b.trainer_waits for b in blocks if b.schedule == arm] for arm in ARMS}
    pairs = {
        arm: [a / b for a, b in zip(rates[ASYNCHRONOUS], rates[arm], strict=True)]
        for arm in (OVERLAP, SYNCHRONOUS)
    }
    reached = [rate / config.bound for rate in rates[ASYNCHRONOUS]]
    return {
        "cv": config.cv,
        "trace": config.latency_trace,
        "bound": config.bound,
        "rates": {arm: spread(values) for arm, values in rates.items()},
        "trainer_waits": {arm: statistics.median(values) for arm, values in waits.items()},
        "speed_up": spread(pairs[SYNCHRONOUS]),
        "speed_up_over_overlap": spread(pairs[OVERLAP]),
        "largest_speed_up": config.bound / statistics.median(rates[SYNCHRONOUS]),
        "share_of_largest": spread(reached),
        "processor_bound": max(b.processors for b in blocks) > MOST_BUSY,
        "blocks": [asdict(block) for block in blocks],
    }


def table(result: dict[str, Any]) -> Group:
    """`result` for people."""
    title = f"{result['config']['environments']} environments, decisions learned from per second"
    shown = [as_table(title, _COLUMNS, _rows(result))]
    if result["learning"]:
        shown.append(as_table(_learnt(result), _LEARNING, _learning_rows(result)))
    return Group(*shown)


def markdown(result: dict[str, Any]) -> str:
    """`table` for the docs."""
    text = as_markdown(_COLUMNS, _rows(result))
    if result["learning"]:
        text += f"\n{_learnt(result)}:\n\n{as_markdown(_LEARNING, _learning_rows(result))}"
    return text


def laws(config: BenchAsyncVsSyncConfig) -> list[MachineryConfig]:
    """The same machinery under each law, those of `cvs` first."""
    sizes = {field.name: getattr(config, field.name) for field in fields(MachineryConfig)}
    made = [MachineryConfig(**sizes | {"latency_cv": cv, "latency_trace": None}) for cv in config.cvs]
    return made + [MachineryConfig(**sizes | {"latency_trace": trace}) for trace in config.traces]


def _law(config: BenchAsyncVsSyncConfig, of: MachineryConfig) -> dict[str, Any]:
    with of.open() as engine:
        order = config.rounds * (*ARMS, *reversed(ARMS))
        return compare(of, [engine.block(arm, config.seconds) for arm in order])


def _named(law: dict[str, Any]) -> str:
    if law["trace"] is None:
        return f"{law['cv']:g}"
    # `benchmarks latency` calls all of them alike, in folders of their own.
    trace = Path(law["trace"])
    return f"{law['cv']:.2f} ({trace.stem if trace.name != TRACE else trace.resolve().parent.name})"


def _learning(config: BenchAsyncVsSyncConfig, console: Console) -> dict[str, Any]:
    """Success after equally many updates of equally many decisions."""
    found: dict[str, Any] = {arm: [] for arm in ARMS}
    with console.stage("learning", total=len(ARMS) * len(config.seeds)) as stage:
        for seed in config.seeds:
            for arm in ARMS:
                found[arm].append(success(config.learning_updates, arm, seed))
                stage.update(sum(map(len, found.values())), f"{arm} {found[arm][-1]:.0%}")
    return {"success": found, "n": TRIALS, "updates": config.learning_updates, "seeds": list(config.seeds)}


def success(updates: int, arm: Schedule, seed: int) -> float:
    """Success after so many updates under a schedule."""
    from accerl_lerobot.engines.ray_engine import RayEngine

    run = LEARNING.run_config(updates=updates, seed=seed)
    run = replace(run, launch=replace(run.launch, schedule=arm))
    engine = RayEngine(run, ("match",), load=LEARNING.load())
    try:
        engine.train()
        while not engine.poll().done:
            pass
        engine.plan(evaluation_plans(("match",), TRIALS, "after", seed=seed))
        results: list[bool] = []
        while len(results) < TRIALS:
            results += [e.success for e in engine.poll().episodes if e.plan.group == "after"]
        return sum(results) / TRIALS
    finally:
        engine.close()


_COLUMNS = ("CV", *ARMS, "S", "S over overlap", "S*", "S/S*", "trainer waits", "")
_LEARNING = ("schedule", "success (each seed)")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for law in result["laws"]:
        rows.append(
            [
                _named(law),
                *(ranged(law["rates"][arm], ".0f") for arm in ARMS),
                ranged(law["speed_up"], ".2f"),
                ranged(law["speed_up_over_overlap"], ".2f"),
                f"{law['largest_speed_up']:.2f}",
                ranged(law["share_of_largest"], ".2f"),
                " / ".join(f"{law['trainer_waits'][arm]:.0%}" for arm in ARMS),
                "processors busy" if law["processor_bound"] else "",
            ]
        )
    return rows


def _learning_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for arm, values in result["learning"]["success"].items():
        n = result["learning"]["n"] * len(values)
        rate = Rate(successes=round(sum(values) * result["learning"]["n"]), n=n)
        rows.append([arm, f"{rate} ({' '.join(f'{100 * v:.0f}' for v in values)})"])
    return rows


def _learnt(result: dict[str, Any]) -> str:
    return f"Success after {result['learning']['updates']} updates of equally many decisions"


def _draw(path: Path, result: dict[str, Any]) -> None:
    """Speed-up by law, beside the largest one possible."""
    found = result["laws"]
    x = range(len(found))
    with drawing(path) as axes:
        axes.plot(x, [law["largest_speed_up"] for law in found], "k_", ms=30, label="S*, the most possible")
        for name, key, place in (
            ("over synchronous", "speed_up", -0.1),
            ("over overlap", "speed_up_over_overlap", 0.1),
        ):
            middle = [law[key]["median"] for law in found]
            error = [
                [m - law[key]["min"] for m, law in zip(middle, found, strict=True)],
                [law[key]["max"] - m for m, law in zip(middle, found, strict=True)],
            ]
            axes.errorbar([i + place for i in x], middle, yerr=error, fmt="o", capsize=3, label=name)
        axes.set_xticks(list(x), [_named(law) for law in found])
        axes.set(
            xlabel="latency of the environments: standard deviation over mean",
            ylabel="speed-up of the asynchronous schedule",
            title=f"{result['config']['environments']} environments, decisions learned from per second",
        )
        axes.set_ylim(bottom=0)
        axes.legend()
