"""What policies observe: the environment's observation, reduced to what their networks read.

The environment's vectors hold 16 agents at 16 ticks and 64 pieces of lines, 33 kB; a buffer of
steps stores less:

| key | shape | content |
|---|---|---|
| `state` | (7,) | the fields `STATE` of the environment's `state` |
| `route` | (30, 2) | as in the environment |
| `neighbours` | (K, 25) | the K nearest agents, nearest first: `AGENT_FIELDS` of \
`asp_env.views.vectors` now and three ticks ago, then 1 where there is a policy |
| `lines` | (L, 10, 9) | pieces of lines: `LINE_FIELDS`, then 1 where the point exists |
| `forecast…` | | as in the environment |

How far the logged driver gets (`route_done`, `to_goal_m`) is left out: a planner does not know it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from asp_env.errors import AspEnvError
from asp_env.sim.observation import STATE_FIELDS
from asp_env.views.vectors import AGENT_FIELDS, LINE_FIELDS
from policies.settings import EnvironmentSettings

HIDDEN_STATE = ("route_done", "to_goal_m")
"""Fields of `state` that state how far the logged driver gets."""

STATE = tuple(name for name in STATE_FIELDS if name not in HIDDEN_STATE)
"""Fields of `state` that policies observe."""

_SHOWN = np.array([name in STATE for name in STATE_FIELDS])

PAST_TICKS = 3
"""Neighbours are shown now and this many ticks ago. Chosen by hand: 0.6 s show an acceleration."""

NEIGHBOUR_FIELDS = 2 * len(AGENT_FIELDS) + 1

_VECTORS = ("agents", "agents_valid", "lines", "lines_valid")

Observations = dict[str, np.ndarray]


def components(settings: EnvironmentSettings) -> tuple[str, ...]:
    """The components of the environment's observation that a policy needs."""
    return ("state", "route", "vectors" if settings.view is None else "raster")


def reduced_space(space: spaces.Space[Any], settings: EnvironmentSettings) -> spaces.Dict:
    """The space of a policy's observation.

    Args:
        space: the space of the environment's observation.
        settings: what the policy observes.

    Raises:
        AspEnvError: the observation lacks a component.
    """
    if not isinstance(space, spaces.Dict) or "state" not in space.spaces:
        raise AspEnvError(f"observation space {space}: expected a Dict with state and route")
    kept = {name: box for name, box in space.items() if name not in _VECTORS}
    state = space["state"]
    assert isinstance(state, spaces.Box)
    kept["state"] = spaces.Box(state.low[_SHOWN], state.high[_SHOWN], dtype=np.float32)
    if settings.view is None:
        size = (settings.neighbours, NEIGHBOUR_FIELDS)
        kept["neighbours"] = spaces.Box(-np.inf, np.inf, size, dtype=np.float32)
        if settings.map_lines:
            lines = space["lines"].shape
            assert lines is not None
            size = (settings.map_lines, lines[1], len(LINE_FIELDS) + 1)
            kept["lines"] = spaces.Box(-np.inf, np.inf, size, dtype=np.float32)
    return spaces.Dict(kept)


def reduce_observations(
    observations: Mapping[str, np.ndarray], settings: EnvironmentSettings
) -> Observations:
    """Reduces observations of B environments, each array with a leading axis B.

    Args:
        observations: the environment's observations.
        settings: what the policy observes.
    """
    kept = {name: value for name, value in observations.items() if name not in _VECTORS}
    kept["state"] = observations["state"][:, _SHOWN]
    if settings.view is None:
        others = slice(1, settings.neighbours + 1)
        agents, valid = observations["agents"][:, others], observations["agents_valid"][:, others]
        kept["neighbours"] = np.concatenate(
            [agents[:, :, -1], agents[:, :, -1 - PAST_TICKS], valid[:, :, -1:]],
            axis=-1,
            dtype=np.float32,
        )
        if settings.map_lines:
            shown = slice(settings.map_lines)
            points, exist = observations["lines"][:, shown], observations["lines_valid"][:, shown]
            kept["lines"] = np.concatenate([points, exist[..., None]], axis=-1, dtype=np.float32)
    return kept
