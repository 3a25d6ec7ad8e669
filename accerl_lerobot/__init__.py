# SPDX-License-Identifier: Apache-2.0
"""Online reinforcement learning of LeRobot policies: asynchronous, exact and small.

Example:
    ::

        from accerl_lerobot import evaluate, load_config, load_policy, train

        if __name__ == "__main__":  # processes are started, which import this file again
            config = load_config("recipes/quickstart.yaml", {"env.task": "drawer-open-v3", "seed": 1})
            result = train(config)
            print(result.before, "→", result.after)
            print(evaluate(config, policy=result.policy, episodes=50).success)
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig
    from accerl_lerobot.engines.stopping import StoppedError
    from accerl_lerobot.errors import InputError
    from accerl_lerobot.run.train import (
        ActingPolicy,
        EvaluationResult,
        TrainResult,
        evaluate,
        load_config,
        load_policy,
        resume,
        train,
    )

__version__ = "0.1.0"
__all__ = [
    "ActingPolicy", "EvaluationResult", "InputError", "RunConfig", "StoppedError", "TrainResult",
    "evaluate", "load_config", "load_policy", "resume", "train",
]  # fmt: skip
_ELSEWHERE = {"RunConfig": "engines.config", "StoppedError": "engines.stopping", "InputError": "errors"}


def __getattr__(name: str) -> Any:
    # At first use: workers and `accerl --help` import this package too, and need none of it.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_ELSEWHERE.get(name, 'run.train')}")
    return getattr(module, name)
