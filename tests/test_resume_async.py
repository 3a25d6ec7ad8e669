# SPDX-License-Identifier: Apache-2.0
"""An asynchronous run that is gone on with; its trainer is a stand-in that writes down what it was given."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engines.supervision import RolloutSlot, restore_rollouts, save_rollouts
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.rollout.runner import EpisodePlan
from benchmarks.simulated_environment import LatencyConfig
from tests.rollout.environments import ended
from tests.runs import drive, tiny_run, until, updates

UPDATES, DURING = 40, 12


def test_nothing_committed_is_lost_or_doubled_and_no_update_made_twice(light_engine, tmp_path: Path):
    sections: dict[str, Any] = {
        "env": LatencyConfig(max_steps=16, frame_ms=4.0),
        "rollout": {"workers": 2, "environments": 2},
        "replay": {"capacity": 160, "max_unlearned_decisions": 48, "max_lag": 40},
        "trainer": {"updates": UPDATES},
    }
    first = light_engine(**sections)
    first.plan(evaluation_plans(("match",), DURING, "during"))
    first.train()
    history = until(first, 14)
    saved = first.save(tmp_path)
    assert [u["update"] for u in updates([*history, saved])] == [i + 1.0 for i in range(saved.version)]
    counters = first.poll().rollout
    until(first, saved.version + 6)  # what comes after the checkpoint is to be forgotten
    first.close()

    state = tmp_path / TRAINING_STATE
    cut = snapshot.load(state / "replay")["replay"]
    ledger = snapshot.load(state / "trainer")["ledger"]
    assert len(ledger) == saved.version
    uses = Counter(key for keys in ledger for key in keys)
    held = {entry["segment"].key: entry for entry in cut["entries"]}
    assert len(held) == len(cut["entries"]) > 0
    assert all(entry["uses"] == uses[key] for key, entry in held.items()), "as many as it had learnt from"

    second = light_engine(state, **sections)
    second.train()
    after = drive(second)
    assert [u["update"] for u in updates(after)] == [i + 1.0 for i in range(saved.version, UPDATES)]
    second.save(tmp_path / "end")
    ledger = snapshot.load(tmp_path / "end" / TRAINING_STATE / "trainer")["ledger"]
    assert len(ledger) == UPDATES
    uses = Counter(key for keys in ledger for key in keys)
    assert all(uses[key] <= entry["draws"] for key, entry in held.items())
    incarnations = {key.rsplit(".", 1)[0] for keys in ledger[saved.version :] for key in keys}
    assert {"rollout0.1", "rollout1.1"} <= incarnations, "keys are new, and so are the seeds"
    replay = after[-1].replay
    assert replay["inserted_segments"] == replay["stored_segments"] + replay["removed_segments"]
    assert replay["inserted_decisions"] > cut["counters"].inserted_decisions
    # The batch drawn ahead for the update after the last one is never learnt from.
    assert 0 <= replay["trained_decisions"] - sum(n for keys in ledger for n in keys.values()) < 16 + 3
    assert after[-1].rollout["env_steps"] > counters["env_steps"], "counted on, not anew"
    during = [e.plan.index for p in history + after for e in p.episodes if e.plan.group == "during"]
    assert sorted(during) == list(range(DURING)), "planned episodes have one result each"


def test_the_rollout_workers_part_of_a_checkpoint(tmp_path: Path):
    """Episodes that were paid for are played once; planned ones without a result are played again."""
    config = tiny_run(Path("nowhere"), rollout={"workers": 2, "episodes": 41})
    first, second = ([RolloutSlot(i, None, config, ("match",)) for i in range(2)] for _ in range(2))
    planned = evaluation_plans(("match",), 4, "during")
    explored = EpisodePlan(task="match", seed=7, explore=True)
    for slot in first:
        slot.assign(planned[slot.index :: 2])
    report: Any = SimpleNamespace(episodes=[ended(plan) for plan in (explored, explored, planned[0])])
    first[0].take(report)
    save_rollouts(tmp_path, first)
    restore_rollouts(tmp_path, second)
    assert [slot.budget for slot in second] == [19, 20]
    assert [sorted(slot.outstanding) for slot in second] == [[("during", 2)], [("during", 1), ("during", 3)]]
    assert second[0].begun == [("match", 7), ("match", 7)]
