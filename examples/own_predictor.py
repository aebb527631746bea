"""A predictor of your own in the loop: everybody brakes gently, in two modes."""

from typing import ClassVar

import numpy as np

from asp_env.data.predictor import Forecast, fill_missing, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.dynamics import normalize_actions, rollout
from asp_env.envs.replay import ReplayEnv
from asp_env.planning.sampling import SamplingPlanner


class Braking:
    """Half of all drivers keep their speed, half brake by 2 m/s²; nobody steers."""

    name = "braking"
    privileged = False
    dt_s = 0.2
    history = 1
    horizon = 15
    trained_on = None
    metadata: ClassVar[dict[str, str]] = {}

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Two modes for every target, through the bicycle model."""
        del future
        scene.check_dt(self.dt_s, self.name)
        at = (scene.targets[:, 0], scene.targets[:, 1])
        actions = np.zeros((len(scene.targets), 2, self.horizon, 2), dtype=np.float32)
        actions[:, 1, :, 0] = -2.0
        now = np.repeat(scene.target_states[:, None], 2, axis=1)
        lengths = np.repeat(scene.sizes[at][:, :1], 2, axis=1)
        return make_forecast(
            scene,
            states=rollout(now, actions, lengths, self.dt_s),
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
        _, _, terminated, truncated, info = env.step(normalize_actions(plan.actions[0, 0]))
        done = terminated or truncated
    return info["progress"]


if __name__ == "__main__":
    import sys

    sys.stdout.write(f"{main():.2f} of the way\n")
