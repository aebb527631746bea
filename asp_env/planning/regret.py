"""Planning regret: what an imperfect forecast costs a planner, by the planner's own costs.

The plan that is chosen with a forecast is compared with the plan that is chosen with the truth;
both are rated under the truth. The regret is zero wherever the forecast leads to the same plan,
however wrong it is, so that only errors that matter to the planner count. Related measures are in
"Injecting Planning-Awareness into Prediction and Detection Evaluation" (Ivanovic and Pavone, arXiv
2110.03270) and "Not All Errors Are Made Equal" (arXiv 2403.04745).
"""

import numpy as np
from jaxtyping import Float


def planning_regret(
    costs: Float[np.ndarray, "b c"], true_costs: Float[np.ndarray, "b c"]
) -> Float[np.ndarray, " b"]:
    """Cost under the truth of the candidate chosen with a forecast, less the lowest one.

    Args:
        costs: costs of C candidates in each of B situations under a forecast, by which the first of
            the cheapest is chosen.
        true_costs: costs of the same candidates under the recorded future.

    Returns:
        Regrets, at least 0, in the unit of the costs.
    """
    chosen = np.take_along_axis(true_costs, costs.argmin(axis=1)[:, None], axis=1)[:, 0]
    return chosen - true_costs.min(axis=1)
