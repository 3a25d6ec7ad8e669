# SPDX-License-Identifier: Apache-2.0
"""Reading actions off frames: worlds whose actions are there to be read, and worlds where they are not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import InverseConfig, TrialConfig
from accerl_lerobot.world_model.inverse import InverseProbe, learn_probe
from accerl_lerobot.world_model.trial import try_out
from tests.world_model.test_pixels import K, dots
from tests.world_model.test_trial import Deterministic

CONFIG = InverseConfig(steps=150, batch=64, lr=4e-3)


@pytest.fixture(scope="module")
def probe() -> InverseProbe:
    made = learn_probe(dots(60, seed=1), chunk=K, config=CONFIG, seed=0)
    assert made is not None
    return made


def legible(kind: str, probe: InverseProbe) -> list[dict[str, dict[str, float]]]:
    trial = TrialConfig(depth=2, every=2)
    found = try_out(Deterministic(kind), dots(24, seed=3), trial, probe=probe)
    return [{k: v for k, v in row.items() if k.startswith("legible")} for row in found["depths"]]


def test_off_an_exact_world_dreams_are_read_as_reality_is(probe: InverseProbe):
    rows = legible("exact", probe)
    assert all(set(row) == {"legible_real", "legible_true", "legible_change"} for row in rows)
    for row in rows:
        assert row["legible_real"]["low"] > 0.6
        assert row["legible_true"]["value"] == pytest.approx(row["legible_real"]["value"], abs=0.1)
        assert row["legible_change"]["low"] > 0.5


@pytest.mark.parametrize("kind", ["deaf", "copy"])
def test_what_a_world_that_does_not_listen_was_told_cannot_be_read(kind: str, probe: InverseProbe):
    for row in legible(kind, probe):
        assert row["legible_real"]["low"] > 0.6, "reality is not to blame"
        change = row["legible_change"]
        assert change == pytest.approx({"value": 0, "low": 0, "high": 0}, abs=1e-4), (
            "it dreams the same twice"
        )


def test_it_is_not_read_where_it_has_learnt(probe: InverseProbe):
    class Counting(InverseProbe):
        pairs = 0

        def read(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
            Counting.pairs += len(before)
            return super().read(before, after)

    made = Counting(1, 2)
    made.load_state_dict(probe.state_dict())
    counts = []
    for known in (frozenset(), frozenset(range(12)), frozenset(range(24))):
        Counting.pairs, made.known = 0, known
        found = legible("exact", made)
        counts.append(Counting.pairs)
        assert bool(found[0]) is (len(known) < 24)
    assert counts[0] == 2 * counts[1] > counts[2] == 0


def test_equal_seeds_give_equal_probes_and_leave_the_global_generator_alone():
    config, torch_state = replace(CONFIG, steps=3), torch.get_rng_state()
    one, same, other = (learn_probe(dots(4), chunk=K, config=config, seed=s) for s in (0, 0, 1))
    assert one is not None and same is not None and other is not None
    assert torch.equal(torch.get_rng_state(), torch_state)
    pairs = np.random.default_rng(0).integers(256, size=(2, 5, 1, 16, 16, 3)).astype(np.uint8)
    assert np.array_equal(one.read(*pairs), same.read(*pairs))
    assert not np.array_equal(one.read(*pairs), other.read(*pairs))


def test_legibility_of_changes_is_about_none_at_all():
    probe = InverseProbe(1, 1)
    given, groups = np.array([[2.0], [2.0]]), np.arange(2)
    assert math.isnan(probe.legibility(given, given, groups).value), "they do not vary"
    assert probe.legibility(given, given, groups, of_changes=True).value == 1
    assert probe.legibility(given * 0, given, groups, of_changes=True).value == 0
    assert probe.legibility(given / 2, given, groups, of_changes=True).value == pytest.approx(0.75)


def test_legibility_by_hand():
    """Σ|read − given|² = 1 + 1 of Σ|given − mean|² = 8; an action that never varied does not count."""
    probe = InverseProbe(1, 2)
    probe.std.copy_(torch.tensor([2.0, 0.0]))
    given = np.array([[0.0, 9.0], [4.0, 9.0]])
    read = np.array([[1.0, 0.0], [3.0, 5.0]])
    assert probe.legibility(read, given, np.arange(2)).value == pytest.approx(1 - 2 / 8)
    assert probe.legibility(given, given, np.arange(2)).value == 1
    assert math.isnan(probe.legibility(read, given * 0, np.arange(2)).value)


def test_without_a_whole_chunk_there_is_nothing_to_learn():
    assert learn_probe(dots(2, steps=K), chunk=K, config=CONFIG, seed=0) is None
    several = [replace(e, frames=e.frames[::K], times=e.times[::K], state=e.state[::K]) for e in dots(2)]
    assert learn_probe(several, chunk=K, config=replace(CONFIG, steps=1), seed=0) is not None


def test_large_frames_are_read_as_small_ones():
    frames = np.random.default_rng(0).integers(256, size=(2, 3, 2, 128, 128, 3)).astype(np.uint8)
    assert InverseProbe(2, 4).read(*frames).shape == (3, 4)


@pytest.mark.parametrize(("name", "value"), [("steps", -1), ("batch", 1), ("episodes", 0), ("lr", 0.0)])
def test_bad_values_name_their_field(name: str, value: float):
    with pytest.raises(InputError, match=f"^inverse.{name}={value}"):
        InverseConfig(**{name: value})
