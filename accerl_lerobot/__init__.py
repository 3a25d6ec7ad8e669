# SPDX-License-Identifier: Apache-2.0
"""Online reinforcement learning of LeRobot policies: asynchronous, exact and small.

Example:
    ::

        from accerl_lerobot import evaluate, load_config, load_policy, train

        config = load_config("recipes/quickstart.yaml", {"env.task": "drawer-open-v3", "seed": 1})
        result = train(config)
        print(result.before, "→", result.after)
        print(evaluate(config, policy=result.policy, episodes=50).success)
        chunk = load_policy(result.policy).act(observation)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from accerl_lerobot.engine.api import evaluate, load_config, load_policy, resume, train
    from accerl_lerobot.engine.config import RunConfig

__version__ = "0.1.0"
__all__ = ["RunConfig", "evaluate", "load_config", "load_policy", "resume", "train"]


def __getattr__(name: str) -> Any:
    # At first use: workers and `accerl --help` import this package too, and need none of it.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "engine.config" if name == "RunConfig" else "engine.api"
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)
