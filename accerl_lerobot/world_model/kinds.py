# SPDX-License-Identifier: Apache-2.0
"""The world models that ``imagination.model`` can name. A new one is a class and a line here.

Free of torch, as all configs are: `zoo.py` imports what is named here once something is to dream.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ModelKind:
    """Properties of a world model that are known before there is one."""

    make: str
    """``module:name`` of what makes it of a `contract.Means`, the class itself for instance."""
    what: str
    """For ``--help``, one sentence."""
    folder: bool = True
    """True if it is made of the world model in ``imagination.path``, beside which its success model is."""
    learns: bool = False
    """True if that one goes on learning in a run; it dreams then, or a `ShuffledModel` of it does."""
    judges: bool = False
    """True if it tells successes itself, see `Dream.success`; its `WorldModelSpec.provides` says so too."""
    whole: bool = False
    """True if it can begin only where all that led there is known, see `History`."""
    rows: int = 1
    """Dreams that it must have beside each other, at least."""


_ZOO = "accerl_lerobot.world_model.zoo"
KINDS = {
    "learned": ModelKind(make=f"{_ZOO}:learned", what="the one in `path`.", learns=True),
    "shuffled": ModelKind(
        make=f"{_ZOO}:shuffled",
        what="the learnt one, told the actions of the dream beside it.",
        learns=True,
        rows=2,
    ),
    "copy": ModelKind(make=f"{_ZOO}:copy", what="nothing ever moves."),
    "oracle": ModelKind(
        make=f"{_ZOO}:oracle",
        what="a simulator, put where a dream begins, the best there can be.",
        folder=False,
        judges=True,
        whole=True,
    ),
}
