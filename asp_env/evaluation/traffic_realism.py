"""How much like the recording the simulated traffic of some drives was."""

import numpy as np
from jaxtyping import Bool

from asp_env.metrics.masked import Masked
from asp_env.metrics.realism import features, realism
from asp_env.sim.scenario_world import ScenarioWorld
from asp_env.sim.world import EGO


def traffic_realism(world: ScenarioWorld, lasted: Bool[np.ndarray, "b t"]) -> dict[str, Masked]:
    """`realism` (b,) of each episode's traffic, simulated once; missing where all was replayed.

    Of the agents present at the first tick, but the ego, those count that ever were elsewhere than
    in their log.
    """
    episodes = world.episodes
    found: dict[str, list[Masked]] = {}
    for b, count in enumerate(lasted.sum(axis=1).tolist()):
        ticks = slice(world.history, world.history + count)
        states, valid = episodes.states[b, ticks], episodes.valid[b, ticks]
        logged, there = episodes.log_states[b, ticks], episodes.log_valid[b, ticks]
        differs = ((states != logged).any(axis=-1) | (valid != there)).any(axis=0)
        asked = differs & valid[0]
        asked[EGO] = False
        about = (
            episodes.sizes[b],
            world.recordings[int(episodes.recording[b])].road_map,
            asked,
            world.dt_s,
        )
        simulated = features(states, valid, *about)
        for name, each in realism(features(logged, there, *about), [simulated]).items():
            found.setdefault(name, []).append(each)
    return {
        name: Masked(
            value=np.concatenate([each.value for each in parts]),
            valid=np.concatenate([each.valid for each in parts]),
        )
        for name, parts in found.items()
    }
