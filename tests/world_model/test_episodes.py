# SPDX-License-Identifier: Apache-2.0
"""Windows, cut slowly by hand and compared."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.world_model.episodes import Episode, Place, cut, held, places, split

K = 3


def an_episode(steps: int = 8, *, every: int = 1, success_at: int = -1, last: bool = False) -> Episode:
    """Frame and state say which env step they show; action i is (i, −i)."""
    times = np.arange(0, steps, every)
    if last:
        times = np.append(times[times < steps], steps)
    return Episode(
        frames=np.broadcast_to(times[:, None, None, None, None], (len(times), 1, 2, 2, 3)).astype(np.uint8),
        times=times.astype(np.int64),
        state=times[:, None].astype(np.float32),
        actions=np.stack([np.arange(steps), -np.arange(steps)], 1).astype(np.float32),
        success_at=success_at,
        task="go",
        source="demo",
    )


def shown(frames: np.ndarray) -> list[int]:
    return frames[..., 0, 0, 0, 0].astype(int).tolist()


def test_a_window_inside_an_episode():
    windows = cut([an_episode(20)], [Place(0, 7)], chunk=K, context=3, chunks=2)
    assert shown(windows.frames[0]) == [1, 4, 7, 10, 13] and shown(windows.anchor) == [7]
    assert windows.state[0, :, 0].tolist() == [1, 4, 7, 10, 13] and windows.context == 3
    assert windows.before[0, :, :, 0].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert windows.actions[0, :, :, 0].tolist() == [[7, 8, 9], [10, 11, 12]]
    assert windows.steps.tolist() == [[3, 3]] and windows.valid.all() and not windows.success.any()
    assert windows.task == ("go",) and len(windows) == 1


def test_context_and_anchor_stop_at_the_first_frame():
    windows = cut([an_episode(20)], [Place(0, 4)] * 3, chunk=K, context=3, chunks=1, anchors=[0, 1, 5])
    assert shown(windows.frames[0]) == [0, 1, 4, 7]
    assert windows.before[0, :, :, 1].tolist() == [[0, 0, 0], [-1, -2, -3]]
    assert shown(windows.anchor) == [4, 1, 0]


def test_an_episode_that_ends_within_a_chunk():
    """Demonstrations have no frame after the last step: frames 0 to 7, actions 0 to 7."""
    windows = cut([an_episode(8, success_at=7)], [Place(0, 3)], chunk=K, context=1, chunks=3)
    assert shown(windows.frames[0]) == [3, 6, 7, 7]
    assert windows.steps.tolist() == [[3, 1, 0]] and windows.valid.tolist() == [[True, True, False]]
    assert windows.actions[0, :, :, 0].tolist() == [[3, 4, 5], [6, 0, 0], [0, 0, 0]]
    assert windows.success.tolist() == [[False, True, False]]


def test_chunks_are_made_whole_by_holding_the_last_action():
    windows = cut([an_episode(8, success_at=7)], [Place(0, 3)], chunk=K, context=1, chunks=3)
    whole = held(windows.actions, windows.steps)
    assert whole[0, :, :, 0].tolist() == [[3, 4, 5], [6, 6, 6], [6, 6, 6]]
    assert whole[0, :, :, 1].tolist() == [[-3, -4, -5], [-6, -6, -6], [-6, -6, -6]]
    cut_short = held(windows.actions, np.array([[1, 0, 0]]))
    assert cut_short[0, :, :, 0].tolist() == [[3, 3, 3]] * 3
    assert windows.actions[0, 1, 1, 0] == 0, "they themselves stay"


def test_frames_that_show_the_task_achieved():
    assert an_episode(8, success_at=7).achieved.tolist() == [False] * 7 + [True]
    assert an_episode(8, every=K, success_at=7, last=True).achieved.tolist() == [False] * 3 + [True]
    assert not an_episode(8).achieved.any()


def test_an_episode_that_was_looked_at_when_decisions_were_due():
    episode = an_episode(8, every=K, success_at=7, last=True)
    assert episode.times.tolist() == [0, 3, 6, 8]
    windows = cut([episode], [Place(0, 0), Place(0, 2)], chunk=K, context=2, chunks=3)
    assert shown(windows.frames[0]) == [0, 0, 3, 6, 8] and windows.steps[0].tolist() == [3, 3, 2]
    assert windows.success[0].tolist() == [False, False, True] and windows.valid[0].all()
    assert shown(windows.frames[1]) == [3, 6, 8, 8, 8] and windows.valid[1].tolist() == [True, False, False]


def test_windows_of_one_batch_are_those_cut_alone():
    episodes = [an_episode(9, success_at=4), an_episode(15), an_episode(7, every=K, last=True)]
    at = places(episodes)
    assert len(at) == 8 + 14 + 3 and at[8] == Place(1, 0)
    together = cut(episodes, at, chunk=K, context=2, chunks=2, anchors=[i % 3 for i in range(len(at))])
    for i, place in enumerate(at):
        alone = cut(episodes, [place], chunk=K, context=2, chunks=2, anchors=[i % 3])
        for name in ("frames", "anchor", "state", "actions", "steps", "success", "valid"):
            assert np.array_equal(getattr(together, name)[i], getattr(alone, name)[0]), name
    assert together.valid[:, 0].all(), "something follows every place"


def test_every_success_is_in_exactly_one_chunk_of_a_chain():
    for at in range(8):
        windows = cut([an_episode(8, success_at=at)], [Place(0, 0)], chunk=K, context=1, chunks=3)
        assert windows.success.sum() == 1 and windows.success[0, at // K]


def test_a_split_has_every_outcome_on_both_sides():
    episodes = [an_episode(success_at=3 if i % 4 == 0 else -1) for i in range(20)]
    learn, held = split(episodes, 0.25, np.random.default_rng(0))
    assert sorted(learn + held) == list(range(20)) and len(held) == 1 + 4
    for part in (learn, held):
        assert {episodes[i].success for i in part} == {True, False}
    assert split(episodes, 0.25, np.random.default_rng(0)) == (learn, held)
    assert split(episodes, 0.25, np.random.default_rng(1)) != (learn, held)


@pytest.mark.parametrize("share", [0.01, 0.99])
def test_no_part_of_a_split_is_empty(share: float):
    episodes = [an_episode(), an_episode(), an_episode(success_at=1), an_episode(success_at=1)]
    learn, held = split(episodes, share, np.random.default_rng(0))
    assert len(learn) == len(held) == 2


@pytest.mark.parametrize(
    "changes",
    [
        {"times": np.array([0, 2, 2])},
        {"times": np.array([1, 2, 3])},
        {"times": np.array([0, 4, 9])},
        {"times": np.array([0, 1])},
        {"success_at": 8},
        {"state": np.zeros((2, 1), np.float32)},
        {"actions": np.zeros((0, 2), np.float32)},
    ],
)
def test_arrays_that_do_not_fit(changes: dict[str, object]):
    fields = vars(an_episode(8, every=3)) | changes
    with pytest.raises(ValueError, match="frames|times|success"):
        Episode(**fields)
