"""A predictor of your own in the loop: every agent keeps its speed or brakes gently."""

import sys
from typing import ClassVar

import numpy as np

from asp_env import Forecast, ReplayEnv, Scene, normalize_actions
from asp_env.data import Future, fill_missing, make_forecast
from asp_env.dynamics import rollout
from asp_env.planning import SamplingPlanner


class Braking:
    """Forecasts two equally probable modes: constant speed, and braking by 2 m/s²."""

    name = "braking"
    privileged = False
    dt_s = 0.2
    history = 1
    horizon = 15
    trained_on = None
    metadata: ClassVar[dict[str, str]] = {}

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts every target of the scene by actions through the bicycle model."""
        del future
        scene.check_dt(self.dt_s, self.name)
        actions = np.zeros((len(scene.targets), 2, self.horizon, 2), dtype=np.float32)
        actions[:, 1, :, 0] = -2.0
        situation, slot = scene.targets.T
        states = np.repeat(scene.target_states[:, None], 2, axis=1)
        lengths_m = np.repeat(scene.sizes[situation, slot, :1], 2, axis=1)
        return make_forecast(
            scene,
            states=rollout(states, actions, lengths_m, self.dt_s),
            actions=actions,
            log_probs=np.full(actions.shape[:2], np.log(0.5)),
            valid=scene.predictable,
        )


def main() -> float:
    """Drives one episode of the sample with the sampling planner; returns its progress."""
    env = ReplayEnv(observations=("state",))
    predictor, planner = Braking(), SamplingPlanner()
    _, info = env.reset(seed=0)
    done = False
    while not done:
        scene = env.scene()
        plan = planner.plan(scene, fill_missing(predictor.predict(scene), scene))
        action = normalize_actions(plan.actions[0, 0])
        _, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    return info["progress"]


if __name__ == "__main__":
    sys.stdout.write(f"progress {main():.2f}\n")
