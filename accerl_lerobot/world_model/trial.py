# SPDX-License-Identifier: Apache-2.0
"""Trying a world model out on episodes that it has not learnt from.

Every trial begins at a real frame and dreams some chunks with the actions that were really made, and again
with actions that were not: another episode's, none, the opposite, and a failed episode's. A model
must be better than a copy of the last frame where something moves, and worse with wrong actions; and its
successes must be judged as the real ones were.

A dream is of whole chunks. Where an episode ended within one, its last action is held; and a failure is cut
short and held just as often when the two are to be told apart.

Depths are counted in chunks, from 1. Shapes: M trials, D depths; see `episodes.py` for the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from accerl_lerobot.world_model import judge
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut, held
from accerl_lerobot.world_model.outcomes import drawn, judged, scores, spaced, threshold
from accerl_lerobot.world_model.replayed import Dreams, cut_alike, dream, made
from accerl_lerobot.world_model.stand_in import SuccessModel
from accerl_lerobot.world_model.success import Examples, probabilities

ARMS = ("true", "shuffled", "zero", "opposite", "failed")
"""Which actions are dreamt with."""
PAIRS = 400
"""Real pairs of frames that the success model is tried on, half of them successes."""
NEVER = ("true", "zero")
"""Arms that cannot succeed, the first one from failures. Actions of other episodes may well do so."""


def trial_places(episodes: Sequence[Episode], config: TrialConfig, seed: int) -> list[Place]:
    """Every so many env steps of each episode, at most so many."""
    at = [Place(e, f) for e, episode in enumerate(episodes) for f in spaced(episode.times, config.every)]
    return drawn(episodes, at, config.most, np.random.default_rng(seed))


def trial_windows(episodes: Sequence[Episode], model: WorldModel, config: TrialConfig, seed: int) -> Windows:
    """The windows at `trial_places`; chunks beyond an episode's end are not valid.

    Their actions are whole chunks all the same, see `held`.
    """
    at = trial_places(episodes, config, seed)
    windows = cut(episodes, at, chunk=model.spec.chunk, context=model.spec.context, chunks=config.depth)
    return replace(windows, actions=held(windows.actions, windows.steps))


def wrong_actions(
    windows: Windows, arm: str, rng: np.random.Generator, failed: np.ndarray | None = None
) -> np.ndarray:
    """(M, D, K, A) of one of `ARMS`; `failed`, bool (M,), says whose episode failed."""
    actions = windows.actions
    if arm == "shuffled":
        return actions[judge.shuffled(len(windows), windows.episode.tolist(), rng)]
    if arm == "failed":
        assert failed is not None
        return actions[judge.shuffled(len(windows), windows.episode.tolist(), rng, np.flatnonzero(failed))]
    return {"true": actions, "zero": np.zeros_like(actions), "opposite": -actions}[arm]


def calibrate(
    model: LearnableWorldModel, episodes: Sequence[Episode], config: TrialConfig, seed: int
) -> None:
    """Makes an uncertainty of 1 the 95th percentile after one whole chunk of these episodes."""
    windows = trial_windows(episodes, model, config, seed + 1)
    doubts = dream(model, windows, windows.actions[:, :1]).uncertainty[:, 0]
    doubts = doubts[windows.steps[:, 0] == model.spec.chunk]
    usual = float(np.quantile(doubts, 0.95)) if len(doubts) else math.nan
    if math.isfinite(usual):  # a model without a state has no doubts
        model.doubt.mul_(max(usual, 1e-6))


def try_out(
    model: WorldModel,
    episodes: Sequence[Episode],
    config: TrialConfig,
    success: SuccessModel | None = None,
    seed: int = 0,
    fresh: bool = False,
) -> dict[str, Any]:
    """Tries a model on episodes it has not learnt from.

    Args:
        model: in inference.
        episodes: to try it on.
        config: what is tried, and what it takes to pass.
        success: what tells successes, if anything does.
        seed: of what is drawn.
        fresh: whether the success model has just been learnt: its threshold is set, on these episodes.

    Returns:
        ``depths``: a row per depth with `judge`'s estimates of skill and sensitivity, errors in pixels and
        state, and with a success model AUROC on the chunk dreamt there and the share of them taken for a
        success under each arm's actions; ``auroc_real``, of the success model on real pairs, its
        ``threshold``, and ``outcomes``, see `outcomes.judged`; ``gates``: each with its value and whether it
        holds; ``passed``; ``trials``, of so many ``episodes``.
    """
    rng = np.random.default_rng((seed, 1))
    ended: dict[str, Any] = {}
    if success is not None:
        found = scores(model, success, episodes, config, seed)
        of_policy = np.array([episodes[e].source == "online" for e in found.episode])
        if fresh:
            success.config.threshold = threshold(found, of_policy, config) or 0.5
        given = None if fresh else success.config.threshold
        ended["outcomes"] = judged(found, of_policy, config, given)
        ended["threshold"] = success.config.threshold
        ended["auroc_real"] = _auroc_real(success, episodes, model, rng)
    windows = trial_windows(episodes, model, config, seed)
    failed = np.array([not episodes[e].success for e in windows.episode])
    # Where there are episodes of the policy, it is their failures that must not be taken for successes.
    online = np.array([episodes[e].source == "online" for e in windows.episode])
    theirs = failed & online if (failed & online).any() else failed
    ends = held(windows.actions, cut_alike(windows.steps, windows.success, rng))
    given = {arm: wrong_actions(windows, arm, rng, failed) for arm in ARMS if arm != "failed" or failed.any()}
    arms = {
        arm: dream(model, windows, actions, ends if arm == "true" else None) for arm, actions in given.items()
    }
    # Some episodes go on after their success. What follows neither succeeds nor fails, wherever it begins.
    ahead = np.array([f < episodes[e].starts for e, f in trial_places(episodes, config, seed)])
    context = model.spec.context
    newest = windows.frames[:, context - 1]
    rows = []
    # Until something is not as it was: a chunk cut short by the end is not what was dreamt.
    whole = np.cumprod(windows.steps == model.spec.chunk, axis=1).astype(bool)
    for d in range(config.depth):
        fits, real = whole[:, d], windows.frames[:, context + d]
        row: dict[str, Any] = {"depth": d + 1, "trials": int(fits.sum())}
        if fits.sum() >= 2:
            row |= _pixels(arms, newest[fits], real[fits], fits, d, windows.episode[fits])
            robots = arms["true"].robot[fits, d]
            if robots.shape[1]:
                there = windows.state[fits, context + d]
                row["state_error"] = float(np.abs(robots - there).mean())
                row["state_error_copy"] = float(np.abs(windows.state[fits, context - 1] - there).mean())
            row["uncertainty"] = float(arms["true"].uncertainty[fits, d].mean())
        if success is not None:
            row |= _judged(success, arms, windows, made(windows)[:, d] & ahead, theirs, newest, d)
        rows.append(row)
    gates = _gates(rows, config, ended.get("outcomes"))
    return ended | {
        "trials": len(windows),
        "episodes": len(np.unique(windows.episode)),
        "depths": rows,
        "gates": gates,
        "passed": all(gate["holds"] for gate in gates.values()),
    }


def _pixels(
    arms: dict[str, Dreams],
    newest: np.ndarray,
    real: np.ndarray,
    fits: np.ndarray,
    d: int,
    groups: np.ndarray,
) -> dict[str, Any]:
    moved = judge.changed(newest, real)
    errors = {arm: judge.squared_errors(dreams.frames[fits, d], real) for arm, dreams in arms.items()}
    copy = judge.squared_errors(newest, real)
    where_moved = judge.squared_errors(arms["true"].frames[fits, d], real, moved)
    copy_where = judge.squared_errors(newest, real, moved)
    wrong = [arm for arm in ("shuffled", "zero", "opposite") if arm in errors]
    return {
        "mse": judge.mean_error(errors["true"]),
        "mse_copy": judge.mean_error(copy),
        "psnr": float(10 * np.log10(255**2 / max(judge.mean_error(errors["true"]), 1e-9))),
        "skill": judge.skill(errors["true"], copy, groups)._asdict(),
        "skill_changed": judge.skill(where_moved, copy_where, groups)._asdict(),
        **{
            f"sensitivity_{arm}": judge.sensitivity(errors["true"], errors[arm], groups)._asdict()
            for arm in wrong
        },
    }


def _judged(
    success: SuccessModel,
    arms: dict[str, Dreams],
    windows: Windows,
    happened: np.ndarray,
    failed: np.ndarray,
    newest: np.ndarray,
    d: int,
) -> dict[str, Any]:
    """The success model's judgement of the chunk at this depth, where it `happened`, see `replayed.made`."""
    labels, groups = windows.success[happened, d], windows.episode[happened]
    found: dict[str, Any] = {"successes": int(labels.sum()), "failures": int((~labels).sum())}
    for arm, dreams in arms.items():
        before = newest if d == 0 else dreams.frames[:, d - 1]
        if arm == "true":
            said = probabilities(success, before[happened], dreams.ends[happened, d])
            found["auroc_dreamt"] = judge.separation(said, labels, groups)._asdict()
        # Of an episode that succeeds, some chunk before the last is all but a success.
        counted = happened & failed if arm == "true" else happened
        said = probabilities(success, before[counted], dreams.frames[counted, d])
        taken = said > success.config.threshold
        found[f"false_success_{arm}"] = float(taken.mean()) if len(taken) else float("nan")
    return found


def _auroc_real(
    success: SuccessModel,
    episodes: Sequence[Episode],
    model: WorldModel,
    rng: np.random.Generator,
) -> float:
    """On pairs that were seen, up to a chunk apart whatever they show; NaN without both kinds."""
    kinds = {bool(shown) for episode in episodes for shown in episode.achieved}
    if len(kinds) < 2:
        return float("nan")
    before, after, labels, _ = Examples(episodes, model.spec.chunk).seen(PAIRS, rng)
    return judge.auroc(probabilities(success, before, after), labels)


def _gates(
    rows: list[dict[str, Any]], config: TrialConfig, outcomes: dict[str, Any] | None
) -> dict[str, dict[str, Any]]:
    first, last = rows[0], rows[-1]

    def at(row: dict[str, Any], key: str, part: str = "value") -> float:
        return float(row[key][part]) if key in row else float("nan")

    wanted = {
        "skill_changed_first": (at(first, "skill_changed"), "above", config.skill_first),
        "skill_changed_last": (at(last, "skill_changed"), "above", config.skill_last),
        "skill_last": (at(last, "skill"), "above", config.skill_last),
        "sensitivity_low": (at(first, "sensitivity_shuffled", "low"), "above", config.sensitivity),
    }
    if outcomes is not None:
        wanted["auroc"] = (float(outcomes["auroc"]["low"]), "above", config.auroc)
        for name in ("false_success", "false_success_still"):
            wanted[name] = (outcomes[name], "at most", config.false_success)
        wanted["recall"] = (outcomes["recall"], "above", config.recall)
    # A number that could not be had passes nothing.
    return {
        name: {
            "value": value,
            "wanted": f"{how} {bound}",
            "holds": bool(value > bound if how == "above" else value <= bound),
        }
        for name, (value, how, bound) in wanted.items()
    }
