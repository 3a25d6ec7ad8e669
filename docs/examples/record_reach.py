# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of a Gymnasium environment as a LeRobotDataset: python docs/examples/record_reach.py"""

import gymnasium
import lerobot_env_reach  # noqa: F401  registers reach/Reach-v0
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

if __name__ == "__main__":
    env = gymnasium.make("reach/Reach-v0")
    data = LeRobotDataset.create(
        "me/reach",
        fps=20,
        root="outputs/reach",
        use_videos=False,
        features={
            "observation.images.front": {
                "dtype": "image",
                "shape": (32, 32, 3),
                "names": ["height", "width", "channels"],
            },
            "observation.state": {"dtype": "float32", "shape": (4,), "names": None},
            "action": {"dtype": "float32", "shape": (2,), "names": None},
            "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        },
    )
    for seed in range(20):
        seen, _ = env.reset(seed=seed)
        success = False
        while not success:
            action = np.clip((seen["goal"] - seen["agent_pos"]) / 0.2, -1, 1)
            frame = {"observation.images.front": seen["pixels"], "action": action, "task": "Reach the goal"}
            frame["observation.state"] = np.concatenate([seen["agent_pos"], seen["goal"]])
            seen, _, _, _, info = env.step(action)
            success = info["is_success"]
            data.add_frame(frame | {"next.success": np.array([success])})
        data.save_episode()
    data.finalize()
