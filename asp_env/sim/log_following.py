"""The actions of the logged driver: those that hold the ego on its recorded track, or return it.

The inverse bicycle model alone infers the actions between two recorded states. Executed one after
the other they accumulate an error of position, since headings and speeds decide. Here the inverse
model starts from the present state of the ego, and the state that it aims at is corrected by the
distance to the track, so that the error decays.
"""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.scene import EGO
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, clip_actions, inverse
from asp_env.errors import AspEnvError
from asp_env.sim.world import World

RETURN_S = 1.0
"""Time constant with which a distance to the track decays. Chosen by hand among 0.5, 1, 2 and 3 s:
with it most episodes reach the goal after an excursion of 1.6 s."""

MIN_LOOKAHEAD_M = 5.0
"""The heading never aims at a point of the track nearer than this, which would make slow vehicles
turn sharply because of centimetres. Chosen by hand among 2, 5 and 10 m."""

_AT_LIMIT = 1 - 1e-6
"""Share of the steering limit at which `inverse` has clipped, up to rounding."""


def following_actions(
    states: Float[np.ndarray, "b 4"],
    logged: Float[np.ndarray, "b 4"],
    logged_next: Float[np.ndarray, "b 4"],
    lengths_m: Float[np.ndarray, " b"],
    dt_s: float,
) -> Float[np.ndarray, "b 2"]:
    """Actions that follow a track from states on it or beside it.

    The aim is the logged heading and speed of the next tick. The distance along the track divided
    by `RETURN_S` is added to the speed, and the angle towards a point ahead on the track, as far
    as the ego drives in `RETURN_S`, to the heading. The inverse bicycle model infers the action
    from the present state to that aim. On a track of the bicycle model itself these are the exact
    actions.

    Args:
        states: present states [x m, y m, heading rad, speed m/s].
        logged: logged states at the present tick.
        logged_next: logged states at the next tick.
        lengths_m: lengths of the vehicles, positive.
        dt_s: length of a tick.

    Returns:
        [acceleration m/s², steering rad]; the steering is limited to ±π/4, the acceleration is not.
    """
    heading, speed = logged[:, 2].copy(), states[:, 3].copy()
    offset = logged[:, :2] - states[:, :2]
    ahead_m = np.cos(heading) * offset[:, 0] + np.sin(heading) * offset[:, 1]
    left_m = np.cos(heading) * offset[:, 1] - np.sin(heading) * offset[:, 0]
    aim = logged_next.copy()
    aim[:, 2] += np.arctan2(left_m, np.maximum(speed * RETURN_S, MIN_LOOKAHEAD_M))
    # The aim drives backwards only where the log does.
    aim[:, 3] = np.maximum(aim[:, 3] + ahead_m / RETURN_S, np.minimum(aim[:, 3], 0.0))
    return inverse(states, aim, lengths_m, dt_s)


def logged_actions(world: World) -> tuple[Float[np.ndarray, "b 2"], Bool[np.ndarray, " b"]]:
    """The present actions of the logged drivers of all egos, by `following_actions`.

    They use the recorded state of the next tick, which is not known while driving.

    Args:
        world: a world that replays recordings.

    Returns:
        [acceleration m/s², steering rad], clipped to the limits of both, and a mask of the actions
        that were clipped: there the bicycle model cannot follow. Both are zero where the log has
        ended.

    Raises:
        AspEnvError: the world has no log, since its traffic reacts from the start on.
    """
    if world.traffic != "log":
        raise AspEnvError(
            f"logged actions: the traffic of this world is {world.traffic!r}, which has no logged "
            "driver; use recordings as DATA"
        )
    episodes, rows = world.episodes, np.arange(len(world))
    runs = episodes.elapsed < episodes.length
    now = np.where(runs, world.now, 0)  # any tick that has a next one
    logged = episodes.log_states[rows, now, EGO].astype(np.float64)
    logged_next = episodes.log_states[rows, now + 1, EGO].astype(np.float64)
    lengths_m = np.maximum(episodes.sizes[:, EGO, 0], 0.1).astype(np.float64)
    states = world.ego_states().astype(np.float64)
    actions = following_actions(states, logged, logged_next, lengths_m, world.dt_s)
    beyond = np.abs(actions[:, 0]) > MAX_ACCELERATION_MPS2
    beyond |= np.abs(actions[:, 1]) >= _AT_LIMIT * MAX_STEERING_RAD
    actions = np.where(runs[:, None], clip_actions(actions), 0.0)
    return actions.astype(np.float32), beyond & runs
