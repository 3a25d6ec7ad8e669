# SPDX-License-Identifier: Apache-2.0
"""Memory that a policy takes where it lives, for ``accerl doctor``: from its sizes, and from one decision.

Weights, gradients and Adam's moments follow from the numbers of parameters. What a decision adds depends on
images, denoising steps, precision and tuning mode, so a decision is made, and one and two are prepared for
their gradient, while every tensor is counted. Networks of more than `FAKED_FROM` parameters compute with
PyTorch's fake tensors, which have shapes and no data: π0 needs no 14 GiB to be measured.
"""

from __future__ import annotations

import copy
import weakref
from contextlib import nullcontext
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from accerl_lerobot.algorithms.ranks import recompute
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.family import Action
from accerl_lerobot.policies.loading import sizes_of
from accerl_lerobot.policies.stock import StockAdapter

FAKED_FROM = 10**9
"""SmolVLA cannot be faked: its encoder indexes by a mask, whose shape does not say how many are True."""
FLOAT32 = 4


class PolicyMemory(NamedTuple):
    """Bytes: of a batch whatever its size, and of each decision in it."""

    weights: int  # all parameters, in float32 whatever ``policy.precision``
    trained: int  # parameters that are trained, the critic's included
    acting_batch: int  # most at a time while a batch is decided; copies of weights in bf16
    acting: int
    learning_batch: int  # a batch that waits for its gradient
    learning: int

    def trainer(self, decisions: int, copies: int = 3) -> int:
        """A rank that learns from `decisions` at a time; `copies` are the gradient and Adam's moments."""
        return self.weights + copies * self.trained + self.learning_batch + decisions * self.learning

    def replica(self, decisions: int) -> int:
        """An inference replica that decides `decisions` at a time."""
        return self.weights + self.acting_batch + decisions * self.acting


class Counter(TorchDispatchMode):
    """Bytes of the tensors that are made under it and still live: `now`, and the most so far, `peak`."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._live: set[int] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        for tensor in tree_leaves((args, kwargs)):  # what is there already, such as weights, costs nothing
            self._add(tensor, counted=False)
        result = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            self._add(tensor, counted=True)
        return result

    def _add(self, tensor: Any, *, counted: bool) -> None:
        if not isinstance(tensor, Tensor):
            return
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes() if counted else 0
        if key not in self._live:
            self._live.add(key)
            self.now += size
            self.peak = max(self.peak, self.now)
            weakref.finalize(storage, self._freed, key, size)

    def _freed(self, key: int, size: int) -> None:
        self._live.discard(key)
        self.now -= size


def policy_memory(
    adapter: LeRobotAdapter | StockAdapter, *, imitates: bool, checkpointing: bool = False
) -> PolicyMemory:
    """Measures an adapter on the CPU, which is of no use afterwards.

    `imitates` is true of off-policy algorithms, `checkpointing` is ``trainer.activation_checkpointing``.
    """
    from torch._subclasses.fake_tensor import FakeCopyMode, FakeTensorMode

    sizes = sizes_of(adapter)
    weights, trained = FLOAT32 * sizes.policy, FLOAT32 * sizes.trained
    if isinstance(adapter, StockAdapter):  # its layers are not known: the weights alone
        return PolicyMemory(weights, trained, 0, 0, 0, 0)
    requests = adapter.example_requests()
    batch = adapter.processing.prepare(*stack_observations(requests))
    mode: Any = nullcontext()
    if sizes.policy > FAKED_FROM:
        mode = FakeTensorMode(allow_non_fake_inputs=True)
        batch = tree_map_only(Tensor, mode.from_tensor, batch)
        with FakeCopyMode(mode):  # tokenisers stay as they are
            adapter = copy.deepcopy(adapter, {id(adapter.processing): adapter.processing})
    one = tree_map_only(Tensor, lambda tensor: tensor[:1], batch)
    peaks, kept = [], []
    with mode:
        for rows, asked in ((batch, requests), (one, requests[:1])):
            with torch.no_grad(), adapter.autocast(), Counter() as counter:
                action = adapter.family.act(adapter.model.encode(rows), asked)
            peaks.append(counter.peak)
        learn = partial(_prepare_gradient, adapter, action, imitates)
        if checkpointing:
            recompute(adapter)
        for rows in (batch, one):
            with Counter() as counter:
                waiting = learn(rows)
            kept.append(counter.now)
            del waiting
    return PolicyMemory(weights, trained, *_line(*peaks), *_line(*kept))


def _line(two: int, one: int) -> tuple[int, int]:
    """Bytes of a batch whatever its size, and of each decision, from those of two decisions and of one."""
    each = max(0, two - one)
    return max(0, one - each), each


def _prepare_gradient(adapter: LeRobotAdapter, action: Action, imitates: bool, batch: dict[str, Any]) -> Any:
    """The forward pass of an update, and all that it keeps."""
    rows = max(len(value) for value in batch.values() if isinstance(value, Tensor))
    with adapter.autocast():
        encoded = adapter.model.encode(batch)
        if imitates:
            return adapter.family.imitation_loss(encoded, action.chunk.expand(rows, -1, -1))
        latent = {name: tensor.expand(rows, *tensor.shape[1:]) for name, tensor in action.latent.items()}
        log_prob, _ = adapter.family.score(encoded, latent)
    return log_prob, adapter.value_head(encoded.features, encoded.mask)
