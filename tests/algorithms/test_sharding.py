# SPDX-License-Identifier: Apache-2.0
"""Several ranks make the updates that one makes, and go on from each other's checkpoints.

Ranks are processes that talk through gloo on the loopback, one group for the whole module; PyTorch's
collectives are real, so is FSDP2.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ranks import prepare
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.errors import InputError
from tests.algorithms import sharded
from tests.algorithms.linear import LinearAdapter
from tests.rounding import assert_close

TOLERANCE = 1e-4
OF_A_PART = ("ess", "explained_variance")
"""No means over decisions: what is reported is the mean over parts of the batch, as with micro-batches."""
OF_RATIOS = ("approx_kl", "clip_fraction", "low_weight")
"""Means over ratios; the same where decisions have different numbers of them."""
SIZE = 3
RUNS = [(name, how) for name in sharded.cases() for how in sharded.SHARDINGS]


@pytest.fixture(scope="module")
def alone() -> dict[str, dict[str, Any]]:
    cases = sharded.cases().items()
    return {name: sharded.run(case, sharded.config_of(case, "ddp", 1)) for name, case in cases}


@pytest.fixture(scope="module")
def folder(alone: dict[str, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("ranks")
    for name, result in alone.items():
        snapshot.save(directory / "alone" / name, result["half"])
    place = torch.multiprocessing.get_context("spawn").SimpleQueue()
    torch.multiprocessing.spawn(sharded.work, (SIZE, place, directory / "alone", directory), nprocs=SIZE)
    return directory


@pytest.fixture(params=RUNS, ids="-".join)
def made(request: pytest.FixtureRequest, folder: Path) -> tuple[str, list[dict[str, Any]]]:
    name, how = request.param
    return name, [snapshot.load(folder / f"{name}-{how}-{rank}") for rank in range(SIZE)]


def assert_same(results: list[dict[str, Any]], expected: dict[str, Any], name: str) -> None:
    """The first rank has the weights where each keeps a part; all have the metrics of the last updates."""
    for key, tensor in expected["weights"].items():
        assert_close(results[0]["weights"][key], tensor)
    for result in results:
        found = result["metrics"]
        for update, (mine, theirs) in enumerate(zip(found, expected["metrics"][-len(found) :], strict=True)):
            assert mine.keys() == theirs.keys()
            for key in mine.keys() - {*OF_A_PART, *(OF_RATIOS if name == "counted" else ())}:
                close = pytest.approx(theirs[key], rel=TOLERANCE, abs=TOLERANCE, nan_ok=True)
                assert mine[key] == close, f"{name}, update {update}: {key}"


@pytest.mark.slow
def test_ranks_make_the_updates_of_one_and_go_on_from_each_other(made: Any, alone: dict[str, dict[str, Any]]):
    name, results = made
    case, expected = sharded.cases()[name], alone[name]
    before = LinearAdapter().export_trainable()
    moved = [np.abs(expected["weights"][key] - tensor).max() for key, tensor in before.items()]
    assert max(moved) > 1e-2, "the case teaches nothing"
    assert len(results[0]["metrics"]) == len(expected["metrics"])
    assert_same(results, expected, name)
    resumed = [result["resumed"] for result in results]
    by_one = [sharded.run(case, sharded.config_of(case, "ddp", 1), results[0]["half"])]
    assert {len(result["metrics"]) for result in resumed + by_one} == {len(expected["metrics"]) // 2}
    assert_same(resumed, expected, name)
    assert_same(by_one, expected, name)


@pytest.mark.slow
def test_ranks_know_the_same_to_the_last_bit(made: Any):
    """So that none of them skips an update that another makes."""
    first, *others = made[1]
    for other in others:
        for mine, theirs in zip(first["metrics"], other["metrics"], strict=True):
            assert list(mine) == list(theirs)
            np.testing.assert_array_equal(list(mine.values()), list(theirs.values()))
        for key, tensor in other["weights"].items():
            if tensor.size:  # else its part has gone to the first
                np.testing.assert_array_equal(tensor, first["weights"][key])


def test_a_policy_without_blocks_cannot_forget():
    with pytest.raises(InputError, match=r"trainer\.activation_checkpointing=True: no block of this policy"):
        prepare(LinearAdapter(), TrainerConfig(activation_checkpointing=True))


@pytest.mark.parametrize(
    ("ranks", "gpus", "others", "shares"),
    [
        (4, 0, 1, (0.0, 0.0)),
        (1, 1, 1, (0.5, 0.5)),
        (1, 2, 1, (1.0, 1.0)),
        (2, 2, 3, (0.6, 0.2)),
        (2, 4, 3, (1.0, 0.5)),
    ],
)
def test_no_two_ranks_share_a_gpu(ranks: int, gpus: int, others: int, shares: tuple[float, float]):
    config = TrainerConfig(ranks=ranks)
    found = config.gpu_shares(gpus, others)
    assert found == pytest.approx(shares)
    assert ranks * found[0] + others * found[1] <= gpus + 1e-9
    assert ranks == 1 or not gpus or found[0] > 0.5
