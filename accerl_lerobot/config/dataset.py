# SPDX-License-Identifier: Apache-2.0
"""Which dataset."""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.config.ranges import Section
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class DatasetConfig(Section, section="dataset"):
    """A LeRobotDataset, on the Hub or in a folder."""

    repo_id: str | None = None
    """Hub id, or a label for `root`. None: the run records its own demonstrations."""
    root: str | None = None
    """Local folder; None uses the Hub and its cache."""
    revision: str | None = None
    """Hub revision."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.root is not None and self.repo_id is None:
            remedy = "name the dataset in dataset.root; any owner/name will do"
            raise InputError("dataset.repo_id", None, remedy)
