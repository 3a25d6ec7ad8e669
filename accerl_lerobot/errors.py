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
"""The one error a user meets: a field, its value and the remedy, on one line."""

from __future__ import annotations

import re
from pathlib import Path

TOKEN = re.compile(r"\bhf_\w{6,}")
"""A token of the Hub, which somebody may have typed where it does not belong; it is not repeated."""
LONGEST = 200
"""Characters of a value that are shown; a whole room may have been given where a number belongs."""


class InputError(ValueError):
    """Bad input, refused before any long work.

    Example:
        >>> raise InputError("env.task", "push-v2", "use one of: push-v3, reach-v3")
        Traceback (most recent call last):
        accerl_lerobot.errors.InputError: env.task='push-v2': use one of: push-v3, reach-v3

    Args:
        field: Dotted name of the offending field, as it is written on the command line.
        value: What was given.
        remedy: What to do instead, one sentence without a full stop.
    """

    def __init__(self, field: str, value: object, remedy: str) -> None:
        self.field, self.value, self.remedy = field, value, remedy
        super().__init__(field, value, remedy)

    def __str__(self) -> str:
        value = repr(self.value)
        if len(value) > LONGEST:
            value = f"{value[: LONGEST - 1]}…"
        return TOKEN.sub("<token>", " ".join(f"{self.field}={value}: {self.remedy}".split()))


def check_absent(path: Path) -> None:
    """Refuses a folder for results that exists.

    Raises:
        InputError: it does.
    """
    if path.exists():
        raise InputError("output_dir", str(path), "the folder exists; choose another or remove it")
