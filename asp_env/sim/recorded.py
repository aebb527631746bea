"""What a world's recordings hold of the time to come, for privileged predictors alone."""

import numpy as np

from asp_env.data.scene import Scene
from asp_env.data.snippets import Future, SnippetIndex, gather_ticks
from asp_env.sim.scenario_world import ScenarioWorld


def recorded_future(world: ScenarioWorld, scene: Scene, horizon: int) -> Future:
    """What the recordings say of the coming ticks of the scene's targets, whatever drives them."""
    episodes, b, a = world.episodes, scene.targets[:, 0], scene.targets[:, 1]
    index = SnippetIndex(
        recording=episodes.recording[b],
        track=episodes.tracks[b, a],
        tick=scene.tick[b],
        dt_s=world.dt_s,
        history=0,
        horizon=horizon,
    )
    states, valid = gather_ticks(world.recordings, index, 1 + np.arange(horizon))
    return Future(states=states, valid=valid)
