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
"""LeRobot policy types that come from this package, and how LeRobot learns of them; free of torch."""

from __future__ import annotations

import importlib

PLUGINS = {"smolvla_bins": "accerl_lerobot.policies.bins_plugin"}
"""LeRobot policy type → the package that registers it."""


def register_policies() -> None:
    """Fills LeRobot's registry of policy types in this process: its own, and ours."""
    importlib.import_module("lerobot.policies")
    for package in PLUGINS.values():
        importlib.import_module(package)


def discovery(policy_type: str | None) -> list[str]:
    """The argument by which stock LeRobot commands find this type; none for LeRobot's own."""
    if policy_type not in PLUGINS:
        return []
    return [f"--policy.discover_packages_path={PLUGINS[policy_type]}"]
