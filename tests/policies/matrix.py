# SPDX-License-Identifier: Apache-2.0
"""The table of docs/policies.md: what every policy type does, small, offline, on LeRobot's own classes.

python -m tests.policies.matrix   prints it; the same rows are asserted in test_matrix.py
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from accerl_lerobot.experience import TASK, Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import save_pretrained
from tests.conftest import write_smolvla
from tests.policies.checkpoints import write_act, write_diffusion, write_gaussian_actor
from tests.policies.tiny import adapter_at, log_ratio, looking_back, perturb, requests
from tests.policies.tiny_bins import write_bins
from tests.policies.tiny_pi import hub, small, write_pi

SFT_STEPS = 20
DECISIONS = 24


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One policy type."""

    write: Callable[[Path], Path]
    learns: str
    """The test in which it improves at a small problem in one process."""
    image: int = 32
    ask: Callable[..., list[Request]] = requests
    supervised: bool = True
    """False: LeRobot has no loss on demonstrations for it."""
    context: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    """Holds whenever the policy is built."""


def _pi(kind: str, **options: Any) -> Callable[[Path], Path]:
    return lambda path: write_pi(path, kind, **options)


KINDS = {
    "smolvla": Kind(write=write_smolvla, learns="tests/test_local.py::test_a_random_policy_learns_the_task"),
    "pi0": Kind(
        write=_pi("pi0"),
        learns="tests/policies/test_pi0_training.py::test_a_random_pi0_learns_the_task",
        context=small,
    ),
    "pi05": Kind(
        write=_pi("pi05"),
        learns="tests/policies/test_pi0_training.py::test_a_random_pi05_gets_better",
        context=small,
    ),
    "pi0_fast": Kind(
        write=_pi("pi0_fast", num_steps=8),
        learns="tests/policies/test_pi0_fast_training.py::test_a_random_policy_gets_better",
        context=small,
    ),
    "smolvla_bins": Kind(
        write=write_bins, learns="tests/policies/test_smolvla_bins.py::test_it_learns_by_reinforcement"
    ),
    "act": Kind(
        write=write_act, learns="tests/policies/test_act.py::test_a_random_policy_learns_the_task", image=16
    ),
    "gaussian_actor": Kind(
        write=write_gaussian_actor,
        learns="tests/policies/test_gaussian_actor.py::test_a_random_policy_learns_the_task",
        image=16,
        supervised=False,
    ),
    "diffusion": Kind(
        write=lambda path: write_diffusion(path, image=40, n_obs_steps=2),
        learns="tests/policies/test_diffusion.py::test_a_random_policy_gets_better_at_the_task",
        image=40,
        ask=looking_back,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """Findings about one policy."""

    parameters: int
    losses: tuple[float, float] | None
    """LeRobot's own loss on one batch before and after some of its gradient steps."""
    chunk: tuple[int, ...]
    factors: int
    """Number of a decision's log-prob factors."""
    mismatch: float
    """Largest |ρ − 1| at equal weights, decided alone and re-scored together."""
    reloaded: bool
    """True if stock LeRobot loads our checkpoint, tensor for tensor, and acts with it."""


def examine(name: str, directory: Path) -> Row:
    """Does everything the table says, in `directory`, which is empty."""
    kind = KINDS[name]
    asked = kind.ask(DECISIONS, image=kind.image)
    with kind.context():
        path = kind.write(directory / "pretrained_model")
        parameters = sum(p.numel() for p in adapter_at(path).policy.parameters())
        losses = _supervised(adapter_at(path), asked) if kind.supervised else None
        adapter = adapter_at(path)
        perturb(adapter, 0.05)
        decisions = [adapter.decide([request], 0)[0] for request in asked]
        assert all(np.isfinite(d.chunk).all() and np.isfinite(d.log_prob).all() for d in decisions)
        ratio = log_ratio(adapter, asked, decisions).exp()
        return Row(
            parameters=parameters,
            losses=losses,
            chunk=decisions[0].chunk.shape,
            factors=len(decisions[0].log_prob),
            mismatch=float((ratio - 1).abs().max()),
            reloaded=_reloaded(adapter, path, directory / "saved", asked[0]),
        )


def _supervised(adapter: LeRobotAdapter, asked: Sequence[Request]) -> tuple[float, float]:
    """LeRobot's own training step on one batch, as ``lerobot-train`` makes it."""
    config, policy = adapter.policy.config, adapter.policy
    observations, tasks = stack_observations(asked)
    generator = torch.Generator().manual_seed(0)
    rows, dims = len(config.action_delta_indices), config.output_features["action"].shape[0]
    batch: dict[str, Any] = {TASK: list(tasks)}
    for key in config.input_features:
        value = torch.from_numpy(observations[key])
        batch[key] = value.movedim(-1, -3) / 255.0 if value.dtype == torch.uint8 else value
    batch["action"] = 0.3 * torch.randn(len(asked), rows, dims, generator=generator)
    batch["action_is_pad"] = torch.zeros(len(asked), rows, dtype=torch.bool)
    batch = adapter.processing.preprocessor(batch)
    policy.train()
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=1e-3)
    losses = []
    for _ in range(SFT_STEPS + 1):
        torch.manual_seed(1)  # the same noise and times each step, so that losses can be compared
        loss = policy.forward(batch)[0]
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return losses[0], losses[-1]


def _reloaded(adapter: LeRobotAdapter, path: Path, saved: Path, request: Request) -> bool:
    from lerobot.policies.factory import get_policy_class

    save_pretrained(adapter, saved, PolicyConfig(path=str(path), device="cpu"))
    with hub(saved.parent / "hub"), adapter.model.loading():
        stock = get_policy_class(adapter.policy.config.type).from_pretrained(saved)
    ours, theirs = adapter.policy.state_dict(), stock.state_dict()
    same = ours.keys() == theirs.keys() and all(torch.equal(ours[k], theirs[k]) for k in ours)
    batch = adapter.processing.prepare(*stack_observations([request]))
    if adapter.policy.config.n_obs_steps > 1:  # LeRobot keeps the history itself
        batch = {k: v[:, -1] if k in adapter.policy.config.input_features else v for k, v in batch.items()}
    action = stock.select_action(batch)
    return same and bool(torch.isfinite(action).all())


def fixed(row: Row) -> tuple[str, str, str]:
    """The cells that are the same on every machine."""
    return f"{row.parameters / 1e6:.2g} M", " × ".join(map(str, row.chunk)), str(row.factors)


def markdown(rows: dict[str, Row]) -> str:
    """The table."""
    columns = (
        "type", "parameters here", "a decision", "log-prob factors", "loss in LeRobot's SFT steps",
        "largest error of ρ at equal weights", "stock LeRobot reloads it", "learns in one process",
    )  # fmt: skip
    lines = [columns, ("---",) * len(columns)]
    for name, row in rows.items():
        losses = "has none" if row.losses is None else f"{row.losses[0]:.2f} → {row.losses[1]:.2f}"
        file, test = KINDS[name].learns.split("::")
        reloaded = "yes" if row.reloaded else "NO"
        test = f"`{Path(file).name}::{test}`"
        lines.append((f"`{name}`", *fixed(row), losses, f"{row.mismatch:.1e}", reloaded, test))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> None:
    """Prints the table."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    rows = {}
    for name in KINDS:
        with tempfile.TemporaryDirectory() as directory:
            rows[name] = examine(name, Path(directory))
    sys.stdout.write(markdown(rows))


if __name__ == "__main__":
    main()
