# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import IMAGINED, Segment
from accerl_lerobot.world_model import online
from accerl_lerobot.world_model.config import OnlineLearnConfig, PixelModelConfig, ValidationConfig
from accerl_lerobot.world_model.data import model_arrays
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.online import OnlineLearner, episode_from_segments, episode_weights
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.store import HELD_OUT, THRESHOLD
from tests.runs import adjusted
from tests.world_model.real_segments import SPEC, K, real_episode


def learner(**config: Any) -> OnlineLearner:
    torch.manual_seed(0)
    held_out = config.pop("held_out_offline", [])
    known = config.pop("offline", []) + held_out, {episode.key: HELD_OUT for episode in held_out}
    fields: dict[str, Any] = {"steps_per_episode": 2.0, "validate_every": 4, "held_out": 0.25}
    fields |= {"validation": ValidationConfig(depth=2)} | config
    learn = adjusted(OnlineLearnConfig, **fields)(steps_per_episode=fields.pop("steps_per_episode"))
    model = PixelWorldModel(SPEC, PixelModelConfig(channels=(8, 8)))
    made = OnlineLearner(model, new_success_model(K), learn, *known, seed=0)
    made.given = model  # type: ignore[attr-defined]
    return made


def episodes(*outcomes: bool) -> list[Segment]:
    return [real_episode(seed, solve_at=2 if success else 99)[0] for seed, success in enumerate(outcomes)]


def test_a_segment_is_a_stretch_of_experience():
    [segment] = real_episode(1, solve_at=2)
    episode = episode_from_segments([segment], SPEC)
    frames, robot = model_arrays(segment.observations, SPEC)
    assert segment.steps.tolist() == [4, 4, 4, 1] and episode.times.tolist() == [0, 4, 8, 12, 13]
    assert np.array_equal(episode.frames, frames) and np.array_equal(episode.state, robot)
    assert np.array_equal(episode.actions[:12], segment.actions[:3].reshape(12, 2))
    assert (
        len(episode) == 13 and episode.success_at == 12 and episode.achieved.tolist() == [False] * 4 + [True]
    )
    failure = episode_from_segments(real_episode(1), SPEC)
    assert not failure.success and failure.own


def test_some_episodes_are_held_out_and_steps_are_pending_for_all():
    made = learner()
    for segment in episodes(*[False] * 8):
        made.add(segment)
    assert len(made._held) == 2 and len(made._learnt) == 6 and made.pending_steps == 8, (
        "as validate_every episodes bring"
    )
    kept = {e.frames.tobytes() for e in made._held}
    assert not kept & {e.frames.tobytes() for e in made._learnt}


def test_episodes_are_put_together_from_their_segments():
    made, parts = learner(held_out=0.5), {seed: real_episode(seed, length=1) for seed in (1, 2)}
    assert [len(p) for p in parts.values()] == [4, 4]
    for order in ([0, 2, 1], [3, 0, 1]):
        for seed in (1, 2):
            made.add(parts[seed][order.pop(0)])
    assert not made._learnt and not made._held and made.pending_steps == 0, "neither is complete"
    for i in range(4):
        for seed in (1, 2):
            made.add(parts[seed][i])
    assert len(made._learnt) == len(made._held) == 1 and made.pending_steps == 4
    whole = episode_from_segments(real_episode(1), SPEC)
    for name in ("frames", "times", "state", "actions"):
        assert np.array_equal(getattr(made._learnt[0], name), getattr(whole, name))


def test_imagined_segments_are_refused():
    [segment] = real_episode(1)
    with pytest.raises(ValueError, match=f"real segments, and {segment.key} is imagined"):
        learner().add(replace(segment, source=IMAGINED))


def test_less_than_a_step_in_a_validation_s_time_is_made_later():
    made = learner(steps_per_episode=0.05, validate_every=4)
    for segment in episodes(*[False] * 4):
        made.add(segment)
    assert made.pending_steps == pytest.approx(0.2) and not made.validation_due(last=False)
    for segment in episodes(*[False] * 16):
        made.add(segment)
    assert made.pending_steps == pytest.approx(1.0)


def test_what_never_ends_is_forgotten(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(online, "MOST_UNFINISHED", 2)
    made = learner()
    first, second, third = (real_episode(seed, length=2) for seed in (1, 2, 3))
    for segment in (first[0], second[0], third[0], first[1], third[1]):
        made.add(segment)
    assert len(made._learnt) == 1, "the third"


def test_it_learns_from_real_windows_and_leaves_what_serves_alone():
    made = learner()
    given = made.given  # type: ignore[attr-defined]
    was = {k: v.clone() for k, v in given.state_dict().items()}
    for segment in episodes(False, False, True, False):
        made.add(segment)
    before = {k: v.clone() for k, v in made._learner.serving.state_dict().items()}
    while made.pending_steps >= 1:
        metrics = made.step()
    assert made.version == 8 and made.pending_steps < 1
    assert {"image", "state", "success_loss"} <= set(metrics)
    assert any(not torch.equal(v, before[k]) for k, v in made._learner.serving.state_dict().items())
    assert all(torch.equal(v, was[k]) for k, v in given.state_dict().items())


def test_without_a_success_only_the_world_is_learnt():
    made = learner()
    made.add(episodes(False)[0])
    assert "image" in (metrics := made.step()) and not any(k.startswith("success") for k in metrics)
    assert learner().step() == {}, "nothing to learn from"


def test_a_share_of_every_batch_is_from_the_dataset_it_began_with():
    offline = [episode_from_segments([s], SPEC) for s in episodes(False, True)]
    made = learner(offline=offline)
    assert {p.episode for p in made._draw()} <= {0, 1}, "nothing else is known yet"
    for segment in episodes(*[False] * 4):
        made.add(segment)
    for _ in range(20):
        drawn = [p.episode for p in made._draw()]
        assert sum(e < 2 for e in drawn) == 8 and max(drawn) < 2 + 3


def test_new_and_failed_episodes_are_drawn_more_often():
    weights = episode_weights([True, False] * 4)
    assert weights.sum() == pytest.approx(1) and len(weights) == 8
    assert weights[1::2].sum() == pytest.approx(0.6)
    assert weights[6:].sum() == pytest.approx(0.7), "the newest quarter"
    assert weights[0] == pytest.approx(0.4 * 0.3 / 3) and weights[6] == pytest.approx(0.4 * 0.7)
    assert episode_weights([False] * 4).tolist() == pytest.approx([0.1, 0.1, 0.1, 0.7])
    assert episode_weights([True]).tolist() == [1]


def passes(monkeypatch: pytest.MonkeyPatch, *outcomes: bool) -> list[list[bool]]:
    """Trials end so; returns which episodes of each are the policy's own."""
    results, tried = list(outcomes), []

    def trial(model: Any, held: Any, *rest: Any) -> dict[str, Any]:
        tried.append([e.own for e in held])
        return {"passed": results.pop(0), "checks": {"auroc": {"value": 0.5}}}

    monkeypatch.setattr(online, "validate", trial)
    return tried


def test_what_passes_is_promoted_and_what_does_not_is_not(monkeypatch: pytest.MonkeyPatch):
    demo = [replace(episode_from_segments([s], SPEC), own=False) for s in episodes(True)]
    made = learner(held_out_offline=demo)
    tried = passes(monkeypatch, False, True)
    assert not made.validation_due(last=False)
    for number, segment in enumerate(episodes(*[False] * 8)):
        made.add(segment)
        while made.pending_steps >= 1:
            assert not made.validation_due(last=True), "what it owes comes first, if there is time"
            made.step()
        assert made.validation_due(last=False) is (number in (3, 7))
        if number == 3:
            assert made.promote(last=False) is None and made.metrics()["rejected"] == 1
        if number == 7:
            promotion = made.promote(last=False)
            assert promotion is not None and promotion.version == made.version == 16
            assert not any(p.requires_grad for p in promotion.model.parameters())
            assert not promotion.success.training
            chosen_on = {key for key, role in promotion.roles.items() if role == THRESHOLD}
            assert chosen_on == {episode.key for episode in made._held}, (
                "they are no judges of this threshold"
            )
    assert tried == [[False, True], [False, True, True]]
    assert made.metrics()["check_auroc"] == 0.5 and made.metrics()["promoted"] == 1
    assert made.pending_steps == 0


def test_after_the_last_episode_it_learns_on_until_it_passes_or_is_given_up(monkeypatch: pytest.MonkeyPatch):
    made = learner()
    monkeypatch.setattr(online, "FINAL_VALIDATIONS", 3)
    passes(monkeypatch, False, False, False)
    for segment in episodes(False, True, False, False):
        made.add(segment)
    tries = 0
    while made.may_promote(last=True):
        if made.pending_steps >= 1:
            made.step()
        else:
            assert made.validation_due(last=True)
            made.promote(last=True)
            tries += 1
    assert tries == 3 and made.may_promote(last=False) and not made.validation_due(last=True)
    assert made.version == 8 + 2 * 8 and made.pending_steps == 0, (
        "as many steps as validate_every episodes bring"
    )


def test_after_the_last_episode_one_that_serves_is_tried_once_more(monkeypatch: pytest.MonkeyPatch):
    made = learner()
    passes(monkeypatch, True, True)
    for segment in episodes(*[False] * 4):
        made.add(segment)
    while made.pending_steps >= 1:
        made.step()
    assert made.promote(last=False) is not None
    assert not made.may_promote(last=True), "nothing is new"
    made.add(episodes(False)[0])
    while made.pending_steps >= 1:
        made.step()
    assert (
        made.validation_due(last=True)
        and made.promote(last=True) is not None
        and not made.may_promote(last=True)
    )


def test_a_validation_whose_outcome_nobody_has_yet_is_made_again_by_who_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """A checkpoint may be written during a trial, or before what has passed serves."""
    passes(monkeypatch, False, True)
    made = learner(validate_every=2)
    states: list[dict[str, Any]] = []
    scale = online.fit_uncertainty_scale
    monkeypatch.setattr(online, "fit_uncertainty_scale", lambda *a: states.append(made.state()) or scale(*a))

    def gone_on(state: dict[str, Any]) -> OnlineLearner:
        snapshot.save(tmp_path / "learner", state)
        again = learner(validate_every=2)
        again.restore(snapshot.load(tmp_path / "learner"))
        return again

    for segment in episodes(False, True, False, True):
        made.add(segment)
    made.step()
    assert made.promote(last=False) is None and not made.validation_due(last=False)
    assert gone_on(states[0]).validation_due(last=False), "it was in the middle of its trial"
    assert not gone_on(made.state()).validation_due(last=False), "it has failed, and knows it"
    for segment in episodes(False, True):
        made.add(segment)
    assert made.promote(last=False) is not None
    again = gone_on(made.state())
    assert again.validation_due(last=False) and again.promoted == 0, "nobody rollouts of it yet"
    made.mark_served()
    again = gone_on(made.state())
    assert not again.validation_due(last=False) and again.promoted == 1
    for one, other in zip(made._learner.model.parameters(), again._learner.model.parameters(), strict=True):
        assert torch.equal(one, other)
