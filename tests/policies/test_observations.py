"""What policies observe."""

import numpy as np
import pytest

from asp_env import ReplayVectorEnv
from asp_env.errors import AspEnvError
from asp_env.sim.observation import STATE_FIELDS
from policies.environments import make_environments
from policies.observations import NEIGHBOUR_FIELDS, STATE, reduce_observations, reduced_space
from policies.settings import EnvironmentSettings

OBSERVATIONS = ("state", "route", "vectors")


def test_fields() -> None:
    envs = ReplayVectorEnv(2, "sample:roundabout", observations=OBSERVATIONS)
    settings = EnvironmentSettings(neighbours=5, map_lines=7)
    full, _ = envs.reset(seed=3)
    seen = reduce_observations(full, settings)
    space = reduced_space(envs.single_observation_space, settings)
    assert {name: box.shape for name, box in space.items()} == {
        name: value.shape[1:] for name, value in seen.items()
    }
    assert seen["neighbours"].shape == (2, 5, NEIGHBOUR_FIELDS)
    now, past = full["agents"][:, 1:6, -1], full["agents"][:, 1:6, -4]
    np.testing.assert_array_equal(seen["neighbours"][..., :12], now)
    np.testing.assert_array_equal(seen["neighbours"][..., 12:24], past)
    np.testing.assert_array_equal(seen["neighbours"][..., 24], full["agents_valid"][:, 1:6, -1])
    np.testing.assert_array_equal(seen["lines"][..., :8], full["lines"][:, :7])
    for name in STATE:
        column = list(STATE_FIELDS).index(name)
        np.testing.assert_array_equal(seen["state"][:, STATE.index(name)], full["state"][:, column])


def test_the_goal_of_the_logged_driver_is_hidden() -> None:
    assert set(STATE_FIELDS) - set(STATE) == {"route_done", "to_goal_m"}


def test_last_observations_are_reduced_as_well() -> None:
    envs = make_environments(EnvironmentSettings(), "sample:roundabout", 8, scenarios="")
    envs.seed(0)
    first = envs.reset()
    assert isinstance(first, dict)
    for _ in range(40):
        _, _, over, infos = envs.step(np.zeros((8, 2)))
        if over.any():
            last = infos[int(np.flatnonzero(over)[0])]["terminal_observation"]
            assert {k: v.shape for k, v in last.items()} == {
                k: v.shape[1:] for k, v in first.items()
            }
            return
    pytest.fail("no episode ended")


@pytest.mark.parametrize("field", [{"neighbours": 0}, {"neighbours": 16}, {"map_lines": 65}])
def test_numbers_out_of_range(field: dict[str, int]) -> None:
    with pytest.raises(AspEnvError, match="expected"):
        EnvironmentSettings(**field)  # pyright: ignore[reportArgumentType]
