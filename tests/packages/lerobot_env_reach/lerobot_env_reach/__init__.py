# SPDX-License-Identifier: Apache-2.0
"""An environment of somebody else's package: a point that has to reach a goal, seen from above."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

SIZE = 32


class Reach(gymnasium.Env):
    """Actions are velocities; the task is achieved within 0.1 of the goal."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, speed: float = 0.2, render_mode: str | None = "rgb_array") -> None:
        self.speed, self.render_mode = speed, render_mode
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        point = spaces.Box(-1, 1, (2,), np.float32)
        image = spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        self.observation_space = spaces.Dict(agent_pos=point, goal=point, pixels=image)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.agent, self.goal = self.np_random.uniform(-0.9, 0.9, (2, 2)).astype(np.float32)
        return self.observation(), {}

    def step(self, action: np.ndarray):
        self.agent = np.clip(self.agent + self.speed * action, -1, 1).astype(np.float32)
        distance = float(np.abs(self.agent - self.goal).max())
        return self.observation(), -distance, False, False, {"is_success": distance < 0.1}

    def observation(self) -> dict[str, np.ndarray]:
        return {"agent_pos": self.agent, "goal": self.goal, "pixels": self.render()}

    def render(self) -> np.ndarray:
        image = np.full((SIZE, SIZE, 3), 40, np.uint8)
        for channel, point in enumerate((self.agent, self.goal)):
            row, column = ((point + 1) / 2 * (SIZE - 4)).astype(int)
            image[row : row + 4, column : column + 4, channel] = 255
        return image


gymnasium.register("reach/Reach-v0", Reach)

try:
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.envs.configs import EnvConfig
except ImportError:  # rollout workers of env.type=gym need no LeRobot
    pass
else:

    @EnvConfig.register_subclass("reach")
    @dataclass
    class ReachConfig(EnvConfig):
        """For LeRobot itself: ``lerobot-eval --env.type=reach``."""

        task: str | None = "Reach-v0"
        features: dict[str, PolicyFeature] = field(
            default_factory=lambda: {
                "action": PolicyFeature(FeatureType.ACTION, (2,)),
                "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
                "pixels": PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3)),
            }
        )
        features_map: dict[str, str] = field(
            default_factory=lambda: {
                "action": "action",
                "agent_pos": "observation.state",
                "pixels": "observation.image",
            }
        )

        @property
        def package_name(self) -> str:
            return "reach"

        @property
        def gym_kwargs(self) -> dict[str, Any]:
            return {}
