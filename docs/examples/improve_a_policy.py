# SPDX-License-Identifier: Apache-2.0
"""From demonstrations to an improved policy in Python: python docs/examples/improve_a_policy.py"""

from pathlib import Path

from accerl_lerobot import evaluate, load_config, load_policy, train
from accerl_lerobot.envs import make_environment

if __name__ == "__main__":
    config = load_config(Path(__file__).parent / "simulated.yaml", {"seed": 0})
    result = train(config)
    print(f"{result.policy}: {result.before} before, {result.after} after")

    again = evaluate(config, policy=result.policy, episodes=20)
    print(f"evaluated again: {again.success}")

    environment, policy = make_environment(config.env), load_policy(result.policy)
    outcome = None
    observation = environment.reset(seed=7, task=environment.spec.tasks[0])
    while outcome is None or not outcome.done:
        outcome = environment.step_chunk(policy.act(observation))
        observation = outcome.observation
    print("one more episode:", "success" if outcome.success else "failure")
