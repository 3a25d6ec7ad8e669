# SPDX-License-Identifier: Apache-2.0
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
