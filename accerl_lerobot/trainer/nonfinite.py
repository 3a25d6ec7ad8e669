# SPDX-License-Identifier: Apache-2.0
"""A batch with a non-finite loss is kept, for people to look at.

RUN/nonfinite-000123.json, .safetensors    the batch that would have made update 123; `snapshot.load` reads it
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import Segment

if TYPE_CHECKING:
    from accerl_lerobot.trainer.off_policy import OffPolicyUpdate
    from accerl_lerobot.trainer.update import Update


class NonFiniteError(RuntimeError):
    """Too many updates in a row had a non-finite loss or gradient."""


@contextmanager
def keeping(
    directory: Path | None, update: Update | OffPolicyUpdate, segments: Sequence[Segment]
) -> Iterator[None]:
    """Inside, an update is made of segments.

    Args:
        directory: of the run; None: nothing is kept.
        update: whose it is.
        segments: its batch.

    Raises:
        NonFiniteError: what `Update.step` has raised, with the name of the file.
    """
    try:
        yield
    except NonFiniteError as error:
        if directory is None:
            raise
        path = directory / f"nonfinite-{update.version + 1:06d}"
        snapshot.save(path, {"update": update.version + 1, "said": str(error), "segments": list(segments)})
        raise NonFiniteError(f"{error}; its batch is in {path}.json") from error
