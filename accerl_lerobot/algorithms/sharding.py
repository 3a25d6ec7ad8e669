# SPDX-License-Identifier: Apache-2.0
"""A policy of whose weights each rank keeps a part, by PyTorch's FSDP2 (`fully_shard`).

The adapter is the module that is shared out: `evaluate` and `values` gather its weights and let go of them.
What is gathered and let go of at once is a *block*: one of the network's repeated modules, whose weights are
used inside its own forward pass and nowhere else. LeRobot's policies do not make that plain: SmolVLA, π0 and
theirs run the inside of a layer without calling the layer, attention reads weights of linear layers that it
never calls, caches carry gradients past a layer's output, and embeddings are tied. So one evaluation is
watched, and a layer that is no block falls into the largest of its parts that are. What is left over belongs
to the adapter as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves
from torch.utils.checkpoint import checkpoint

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint.tensors import in_parts
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import PolicyAdapter


def arrange(adapter: PolicyAdapter, config: TrainerConfig) -> None:
    """Prepares an adapter for `trainer.sharding` and `trainer.activation_checkpointing`, in place.

    It has the same weights on every rank; nobody may have taken hold of its parameters.
    """
    if not (config.zero or config.activation_checkpointing):
        return
    seen = Watch(adapter, partial(adapter.evaluate, *adapter.example()))
    if config.activation_checkpointing:
        forget(seen)
    if not config.zero:
        return
    import torch.distributed as dist
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method

    mesh = init_device_mesh(adapter.device.type, (dist.get_world_size(),))
    for module in (*seen.blocks, adapter):
        fully_shard(module, mesh=mesh, reshard_after_forward=config.sharding == "zero3")
    for name in ("evaluate", "values"):
        register_fsdp_forward_method(adapter, name)


def forget(seen: Watch) -> None:
    """Makes blocks compute again for the gradient what they computed before; see `arrange`."""
    forgetful = [block for block in seen.blocks if list(block.children())]
    if not forgetful:
        hint = "no block of this policy can be computed again by itself; leave the field out"
        raise InputError("trainer.activation_checkpointing", True, hint)
    for block in forgetful:
        # FSDP's hooks stand around this, at the module's call: weights are there when it is repeated.
        block.forward = partial(checkpoint, block.forward, use_reentrant=False)


@contextmanager
def swapped_in(
    adapter: PolicyAdapter, live: Sequence[nn.Parameter], tensors: Sequence[Tensor]
) -> Iterator[None]:
    """Parameters have other values inside, and their own again afterwards, whatever happens."""
    sharded = any(map(in_parts, live))
    own = [p.detach().clone() if sharded else p.data for p in live]

    @torch.no_grad()
    def put(values: Sequence[Tensor]) -> None:
        for parameter, tensor in zip(live, values, strict=True):
            if sharded:  # FSDP gathers from memory of its own, whatever a parameter points to
                parameter.copy_(tensor)
            else:
                parameter.data = tensor
        for module in adapter.modules() if sharded else ():  # what has been gathered is of other values
            if hasattr(module, "reshard"):
                module.reshard()

    try:
        put(tensors)
        yield
    finally:
        put(own)


class Watch(TorchFunctionMode):
    """Which modules one evaluation calls, and where it uses which parameter.

    `blocks`, see the top of this file, are those found; none is within another.
    """

    def __init__(self, adapter: PolicyAdapter, evaluate: Callable[[], object]) -> None:
        super().__init__()
        self._called: set[nn.Module] = set()
        self._leaky: set[nn.Module] = set()
        """Modules that were handed something in which a call can leave tensors, such as a key-value cache."""
        self._stack: list[nn.Module] = []
        self._around: dict[Tensor, set[nn.Module]] = {}
        """The modules whose calls enclose every use of a parameter."""
        hooks = [h for m in adapter.modules() for h in (
            m.register_forward_pre_hook(self._enter, with_kwargs=True), m.register_forward_hook(self._leave)
        )]  # fmt: skip
        try:
            with torch.no_grad(), self:
                evaluate()
        finally:
            for hook in hooks:
                hook.remove()
        self._owners: dict[Tensor, set[nn.Module]] = {}
        """The modules that hold each parameter as their own; several where it is tied."""
        for module in adapter.modules():
            for parameter in module.parameters(recurse=False):
                self._owners.setdefault(parameter, set()).add(module)
        self.blocks = list(dict.fromkeys(self._blocks(adapter, repeated=False)))

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        if _tensors(result):  # else it has only been asked what it is like
            for tensor in _tensors((args, kwargs)):
                if isinstance(tensor, nn.Parameter):
                    around = self._around.setdefault(tensor, set(self._stack))
                    around.intersection_update(self._stack)
        return result

    def _enter(self, module: nn.Module, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        self._called.add(module)
        self._stack.append(module)
        if not _plain((arguments, tuple(options.values()))):
            self._leaky.add(module)

    def _leave(self, module: nn.Module, arguments: Any, output: Any) -> None:
        self._stack.pop()

    def _blocks(self, module: nn.Module, repeated: bool) -> Iterator[nn.Module]:
        if repeated and self._is_block(module):
            yield module
            return
        for child in module.children():
            yield from self._blocks(child, repeated or isinstance(module, (nn.ModuleList, nn.Sequential)))

    def _is_block(self, module: nn.Module) -> bool:
        """Called, of more than vectors, and no weight of it is used or held anywhere else."""
        parameters = list(module.parameters())
        # Gradients that come by way of a cache pass by a module's output, where FSDP waits for them; and what
        # is computed again would be put there again.
        if module not in self._called or module in self._leaky or all(p.dim() < 2 for p in parameters):
            return False
        inside = set(module.modules())
        return all(module in self._around.get(p, (module,)) and self._owners[p] <= inside for p in parameters)


def _tensors(value: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]


def _plain(value: Any) -> bool:
    """True if it is made of tensors and numbers, none of which a call can leave another tensor in."""
    if isinstance(value, tuple):
        return all(map(_plain, value))
    return value is None or isinstance(value, (Tensor, str, int, float, torch.dtype, torch.device))
