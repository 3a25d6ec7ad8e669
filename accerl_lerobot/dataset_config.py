# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Which dataset."""

from __future__ import annotations

from dataclasses import dataclass

from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """A LeRobotDataset, on the Hub or in a folder."""

    repo_id: str | None = None
    """Hub id, or a label for `root`. None: the run records its own demonstrations."""
    root: str | None = None
    """Local folder; None uses the Hub and its cache."""
    revision: str | None = None
    """Hub revision."""

    def check(self, room: str) -> None:
        """Refuses a folder without a name; `room` is where it is on the command line.

        Raises:
            InputError: there is one.
        """
        if self.root is not None and self.repo_id is None:
            remedy = f"name the dataset in {room}.root; any owner/name will do"
            raise InputError(f"{room}.repo_id", None, remedy)
