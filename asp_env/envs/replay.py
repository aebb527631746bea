"""`asp_env/Replay-v0`: drive one vehicle of a recording."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from asp_env.data.clock import DEFAULT_DT_S, ticks
from asp_env.data.forecast import Forecast
from asp_env.data.recording import Background
from asp_env.data.scenario import find_scenarios
from asp_env.data.scene import Scene
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import open_data
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.errors import AspEnvError
from asp_env.render.live import MODES, Live
from asp_env.sim.drivers import make_driver
from asp_env.sim.observation import Observer
from asp_env.sim.reward import reward_terms, weighted_sum, weights_from
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.world import Ending
from asp_env.views import make_picture_view

METADATA = {"render_modes": [*MODES], "render_fps": 5}
FAILURES = (Ending.COLLISION, Ending.OFF_ROAD)


class ReplayEnv(gymnasium.Env[dict[str, Any], Any]):
    """Drive one vehicle of a drone recording; the traffic around it is replayed or reacts.

    ## Action space
    `Box(-1, 1, (2,), float32)`: acceleration (times 5 m/s²) and steering (times π/4 rad, left
    positive), held for one tick of the kinematic bicycle model. Braking ends at speed 0.

    ## Observation space
    A `Dict` of the parts named in `observations`:

    | part | space | what it is |
    |---|---|---|
    | `raster` | `Box(0, 255, (12, H, W), uint8)` | the view, heading up, see `asp_env.views` |
    | `actions` | `Box(±[10, π/4], (15, 2), float32)` | acceleration m/s² and steering rad of the \
last 3 s, oldest first, inferred from the motion |
    | `state` | `Box(…, (9,), float32)` | fields and bounds in \
`asp_env.sim.observation.STATE_FIELDS`: speed m/s, acceleration m/s², steering rad, offset to the \
left of the route m, heading error rad, share of the route done, way to the goal m, length m, \
width m |

    ## Reward
    The weighted sum of the terms in `info["reward_terms"]`: progress along the logged way,
    comfort, collision at fault, off-road (`asp_env.sim.reward`).

    ## Start and end of an episode
    `reset` draws one of the scenarios (a vehicle that covers at least 10 m in 4 to 15 s) or takes
    the one of `options={"scenario": number}`. Terminated: a collision that the ego answers for
    (`COLLISION`), over 2 m off the road (`OFF_ROAD`), or the end of the logged way (`GOAL`).
    Truncated: the recording has no more (`OUT_OF_DATA`). `info["ending"]` names it.

    ## Arguments
    `data`: a folder in the inD/rounD layout, `sample:intersection`, `sample:roundabout` or
    `synthetic:…`. `observations`: which parts. `view` and `raster_px` (height, width): what the
    raster shows, always 72 m by 48 m. `traffic`: `log`, `log-actions` or `idm`. `dt_s`: length of
    a tick. `reward_weights`: weights by name, where they differ from the defaults.

    ## Rendering
    `render_mode`: `rgb_array`, a picture from above of 80 m by 80 m, or `human`, a window that
    keeps up with the episode (extra `render`). `show` adds a forecast and a plan.

    ## Version history
    v0: first.
    """

    metadata = METADATA

    def __init__(
        self,
        data: str = "sample:intersection",
        *,
        observations: Sequence[str] = ("raster", "actions", "state"),
        view: str = "chauffeurnet",
        raster_px: tuple[int, int] = (360, 240),
        traffic: str = "log",
        dt_s: float = DEFAULT_DT_S,
        reward_weights: dict[str, float] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """See the class documentation for the arguments.

        Raises:
            AspEnvError: an argument is not understood, or the data hold no scenario.
        """
        history = ticks(HISTORY_S, dt_s)
        self.render_mode = render_mode
        self.metadata = {**METADATA, "render_fps": round(1 / dt_s, 6)}
        self._live = Live(render_mode, title=f"asp-env: {data}", dt_s=dt_s)
        self.recordings = open_data(data)
        self.scenarios = find_scenarios(self.recordings, source=data, dt_s=dt_s, history=history)
        if not len(self.scenarios):
            raise AspEnvError(
                f"{data}: no vehicle covers 10 m in 4 s after 3 s of history; use other recordings"
            )
        self._observer = Observer(observations, make_picture_view(view, pixels=raster_px), history)
        self._simulation = Simulation(
            self.recordings, make_driver(traffic), num_episodes=1, dt_s=dt_s, history=history
        )
        self._weights = weights_from(reward_weights or {})
        self._running = False
        self.observation_space = self._observer.space
        self.action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts a scenario: the one of `options["scenario"]`, or one drawn with the seed.

        Raises:
            AspEnvError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        unknown = set(options or {}) - {"scenario"}
        if unknown:
            raise AspEnvError(f"reset option {sorted(unknown)[0]!r}: expected 'scenario'")
        drawn = int(self.np_random.integers(len(self.scenarios)))
        number = (options or {}).get("scenario", drawn)
        whole = isinstance(number, int | np.integer)
        if not (whole and 0 <= number < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {number}: expected 0 to {len(self.scenarios) - 1} for this data"
            )
        rng = np.random.default_rng(self.np_random.integers(2**63))
        self._simulation.reset([self.scenarios[int(number)]], [rng])
        self._running = True
        self._events = self._simulation.world.events()
        scene = self.scene()
        self._live.begin()
        self._live.keep_up(scene, self._background)
        return self._observe(scene), self._info()

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One tick; the action is moved to the nearest one in the space.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over, or none has begun.
            AspEnvError: the action has another shape or is not finite.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        given = _two_numbers(action)
        limits = np.array([MAX_ACCELERATION_MPS2, MAX_STEERING_RAD], dtype=np.float32)
        world = self._simulation.world
        states_before, before = world.ego_states(), self._events
        self._simulation.step(np.clip(given, -1, 1)[None] * limits, np.ones(1, dtype=bool))
        self._events = world.events()
        terms = reward_terms(before, self._events, states_before, world.ego_states(), world.dt_s)
        why = Ending(int(ending(self._events)[0]))
        terminated = why in (*FAILURES, Ending.GOAL)
        truncated = why is Ending.OUT_OF_DATA
        self._running = not (terminated or truncated)
        info = self._info() | {
            "reward_terms": {name: float(value[0]) for name, value in terms.items()},
            "ending": why.name,
        }
        reward = float(weighted_sum(terms, self._weights)[0])
        scene = self.scene()
        self._live.keep_up(scene, self._background)
        return self._observe(scene), reward, terminated, truncated, info

    def scene(self) -> Scene:
        """All that may be known now, for a predictor in anybody's loop; the ego is slot 0.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._simulation.world.scenarios[0] is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")
        return self._simulation.world.scene()

    def show(
        self, *, forecast: Forecast | None = None, plan: Shaped[np.ndarray, "..."] | None = None
    ) -> None:
        """Hands over what to draw besides, until the next time; `reset` forgets it.

        Args:
            forecast: of `scene()`. Later pictures show what is still to come of it.
            plan: the ego's positions at the next ticks, metres, in the first two columns.

        Raises:
            AspEnvError: it is not of this scene, or not finite.
        """
        self._live.tell(self.scene(), forecast, plan)
        if self.render_mode == "human":
            self.render()

    def render(self) -> Any:
        """A picture from above: RGB uint8 (H, W, 3) in mode `rgb_array`, on screen in `human`.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: there is no screen.
        """
        if self.render_mode is None:
            return None
        return self._live.render(self.scene(), self._background)

    def close(self) -> None:
        """Closes the window, if there is one."""
        self._live.close()

    @property
    def _background(self) -> Background | None:
        return self.recordings[int(self._simulation.world.episodes.recording[0])].background

    def _observe(self, scene: Scene) -> dict[str, Any]:
        observed = self._observer.observe(scene, self._events)
        return {name: value[0] for name, value in observed.items()}

    def _info(self) -> dict[str, Any]:
        scenario = self._simulation.world.scenarios[0]
        assert scenario is not None
        events = self._events
        return {
            "scenario": scenario.name,
            "tags": scenario.tags,
            "tick": int(events.elapsed[0]),
            "progress": float(events.route_m[0] / max(float(events.goal_m[0]), 1.0)),
            "collision": bool(events.collision[0]),
            "at_fault": bool(events.at_fault[0]),
            "off_road_m": float(events.off_road_m[0]),
        }


def _two_numbers(action: Any) -> Shaped[np.ndarray, " 2"]:
    try:
        given = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError):
        raise AspEnvError("action: expected two finite numbers in [-1, 1]") from None
    if given.shape != (2,):
        raise AspEnvError(f"action of shape {given.shape}: expected two numbers in [-1, 1]")
    if not np.isfinite(given).all():
        raise AspEnvError(f"action {given.tolist()}: expected finite numbers in [-1, 1]")
    return given
