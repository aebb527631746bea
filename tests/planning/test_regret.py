"""Planning regret of costs."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from asp_env.planning.planner import planning_regret

SHAPE = (3, 6)
COSTS = arrays(np.float64, SHAPE, elements=st.floats(-100, 100))


def test_by_hand() -> None:
    """The chosen candidates cost 5, 4 and 7 by the truth, the best ones 4, 4 and -1."""
    costs = np.array([[1.0, 2.0, 3.0], [2.0, 0.0, 1.0], [3.0, 3.0, 3.0]])
    true_costs = np.array([[5.0, 4.0, 6.0], [5.0, 4.0, 6.0], [7.0, -1.0, 0.0]])
    assert planning_regret(costs, true_costs).tolist() == [1.0, 0.0, 8.0]


@given(costs=COSTS, true_costs=COSTS, scale=st.floats(0.1, 10), shift=st.floats(-50, 50))
def test_laws(costs: np.ndarray, true_costs: np.ndarray, scale: float, shift: float) -> None:
    """Never negative, zero for the truth, and unchanged where the forecast chooses the same."""
    regret = planning_regret(costs, true_costs)
    assert (regret >= 0).all()
    assert (planning_regret(true_costs, true_costs) == 0).all()
    chosen = costs == costs.min(axis=1, keepdims=True)
    same_choice = np.where(chosen, shift - scale, shift)
    np.testing.assert_array_equal(planning_regret(same_choice, true_costs), regret)
