"""Drive with random actions on the shipped sample and print how each episode ends."""

import sys

import gymnasium as gym

import asp_env


def main(episodes: int = 3) -> list[str]:
    """Returns a line for each episode: its scenario, its ending and the sum of its rewards."""
    env = gym.make("asp_env/Replay-v0", observations=("actions", "state"))
    env = asp_env.FlatParts(env)
    env.action_space.seed(0)
    lines = []
    for episode in range(episodes):
        _, info = env.reset(seed=episode)
        reward_sum, done = 0.0, False
        while not done:
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            reward_sum += float(reward)
            done = terminated or truncated
        lines.append(f"{info['scenario']}: {info['ending']}, reward {reward_sum:.2f}")
    return lines


if __name__ == "__main__":
    sys.stdout.write("\n".join(main()) + "\n")
