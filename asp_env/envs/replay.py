"""`asp_env/Replay-v0`: control one vehicle of a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float, Shaped

from asp_env.arguments import shown
from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.recording import DEFAULT_DT_S, Background
from asp_env.data.scenarios.scenario import Scenario, ScenarioFilter, ScenarioSet
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings
from asp_env.envs.episodes import (
    ReplayEpisodes,
    StepResult,
    checked_seed,
    info_of,
    reset_options,
    valid_actions,
)
from asp_env.envs.flat import Flatten, flat_space, flatten_observations
from asp_env.envs.forecasts import ForecastSpec, PredictorSpec
from asp_env.envs.hints import hint_at_large_observations
from asp_env.envs.keyboard import keyboard_actions
from asp_env.envs.options import ReplayOptions, suggest_options
from asp_env.envs.shared_in_spec import SharedInSpec
from asp_env.errors import AspEnvError
from asp_env.render.live import MODES, LiveRenderer, render_fps
from asp_env.sim.traffic.assignment import TrafficSpec
from asp_env.sim.world import World

NOT_BEGUN = "no episode has begun: call reset first"
METADATA = {"render_modes": [*MODES], "render_fps": render_fps(DEFAULT_DT_S)}


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvSnapshot:
    """The whole state of an environment: the course of the episode, and its arrays.

    A pickle leaves the arrays out and has a few kilobytes. An environment made with the same
    arguments restores it by stepping through the actions again.
    """

    origin: Mapping[str, Any]
    """What an environment must have in common with this one to restore the snapshot."""
    scenario: Scenario
    rng: Mapping[str, Any]
    """State of the episode's generator at its start."""
    actions: Float[np.ndarray, "steps 2"]
    """Actions since the start, in [-1, 1]."""
    generator: Mapping[str, Any]
    """State of `np_random`."""
    seed: int | None
    running: bool
    arrays: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the snapshot without the arrays."""
        names = [field.name for field in fields(self) if field.name != "arrays"]
        return partial(EnvSnapshot, **{name: getattr(self, name) for name in names}), ()


class ReplayEnv(SharedInSpec, gymnasium.Env[Any, Any]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """Controls one vehicle of a recording, the ego, among replayed or reacting traffic.

    ## Description
    An episode is a scenario of a drone recording: one vehicle, a start and a length. The ego starts
    in the recorded state after 3 s of recorded history and follows the actions through a kinematic
    bicycle model. Other agents replay their recorded tracks, or a traffic driver moves them. The
    task is to follow the recorded route at least as far as the recorded vehicle, without a
    collision and without leaving the road.

    ## Action Space
    `Box(-1, 1, (2,), float32)`, held for one tick. `asp_env.normalize_actions` and
    `asp_env.denormalize_actions` convert from and to physical units. Actions outside the space are
    clipped.

    | index | action | -1 | 1 | unit |
    |---|---|---|---|---|
    | 0 | acceleration; braking ends at speed 0, no speed is gained backwards | -5 | 5 | m/s² |
    | 1 | steering, left positive | -π/4 | π/4 | rad |

    ## Observation Space
    A `Dict` of the components that `observations` names; only these are computed. All values are
    finite and clipped to the bounds. Coordinates are in the present frame of the ego: x ahead,
    y to the left. Each component has an entry of its own name, except `vectors`, which has the last
    four. The shape of `actions` is that of `dt_s=0.2`.

    | entry | shape | dtype | bounds | unit | content |
    |---|---|---|---|---|---|
    | `raster` | (12, 360, 240) | uint8 | 0, 255 | | raster of `view`, heading up, in the \
shape of the view and `raster_px` |
    | `chauffeurnet` | (12, 360, 240) | uint8 | 0, 255 | | raster of this view |
    | `mtp` | (3, 360, 360) | uint8 | 0, 255 | | raster of this view |
    | `actions` | (15, 2) | float32 | ±10, ±π/4 | m/s², rad | acceleration and steering, \
inferred from the motion of the last 3 s, oldest first |
    | `state` | (9,) | float32 | see below | | motion, position on the route, and size of the ego |
    | `route` | (30, 2) | float32 | ±1000 | m | points 2, 4, … 60 m ahead on the route, in a \
straight line beyond its end |
    | `nearest` | (8, 13) | float32 | see below | | the nearest agents now: fields of \
`agents`, then 1 where there is an agent |
    | `agents` | (16, 16, 12) | float32 | see below | | the ego and the nearest agents; \
15 past ticks and the present one |
    | `agents_valid` | (16, 16) | int8 | 0, 1 | | mask of agents and ticks |
    | `lines` | (64, 10, 8) | float32 | see below | | nearest pieces of lanes and boundaries as \
10 points |
    | `lines_valid` | (64, 10) | int8 | 0, 1 | | mask of lines and points |

    | index of `state` | field | low | high | unit |
    |---|---|---|---|---|
    | 0 | speed | -60 | 60 | m/s |
    | 1 | acceleration | -10 | 10 | m/s² |
    | 2 | steering | -π/4 | π/4 | rad |
    | 3 | offset to the left of the route | -50 | 50 | m |
    | 4 | heading error to the route | -π | π | rad |
    | 5 | completed share of the route | -1 | 2 | |
    | 6 | distance to the goal along the route | -200 | 1000 | m |
    | 7, 8 | length, width | 0 | 30, 10 | m |

    | index of `agents` | field | low | high | unit |
    |---|---|---|---|---|
    | 0, 1 | x, y | -1000 | 1000 | m |
    | 2, 3 | cosine, sine of the heading | -1 | 1 | |
    | 4 | speed | -60 | 60 | m/s |
    | 5, 6 | length, width | 0 | 30, 10 | m |
    | 7 to 11 | class: car, heavy, two-wheeler, pedestrian, other | 0 | 1 | |

    | index of `lines` | field | low | high | unit |
    |---|---|---|---|---|
    | 0, 1 | x, y | -1000 | 1000 | m |
    | 2, 3 | cosine, sine of the direction | -1 | 1 | |
    | 4 to 7 | kind: lane, curb, solid line, dashed line | 0 | 1 | |

    With `flatten="parts"` each entry is a vector, and rasters stay images. With `flatten=True` the
    observation is one `Box`, the vector of all entries in their order, as of
    `gymnasium.wrappers.FlattenObservation`. Other ids have light observations by default:

    | id | observations | flatten | bytes |
    |---|---|---|---|
    | `asp_env/Replay-v0` | `raster`, `actions`, `state` | `False` | 1,037,000 |
    | `asp_env/ReplayVectors-v0` | `vectors`, `state`, `route` | `"parts"` | 34,000 |
    | `asp_env/ReplayState-v0` | `state`, `route`, `nearest` | `True` | 692 |

    | index of the vector of `asp_env/ReplayState-v0` | content |
    |---|---|
    | 0 to 8 | `state` |
    | 9 to 68 | `route`: x and y of each point |
    | 69 + 13 k to 81 + 13 k | the agent number k of `nearest`, from 0 to 7 |

    ## Rewards
    The sum of four terms, each times its weight in `reward_weights`. `info["reward_terms"]` holds
    the terms without weights.

    | term | weight | value in each step |
    |---|---|---|
    | `progress` | 1 | gained share of the recorded ego's path; sums to 1 at the goal |
    | `comfort` | 0.01 | minus the mean of the squares of longitudinal and lateral acceleration, \
each divided by 5 m/s² |
    | `collision` | 1 | -1 for a collision at the ego's fault |
    | `off_road` | 1 | -`dt_s` while a corner of the ego is more than 0.3 m off the drivable area |

    ## Starting State
    `reset` draws one of `scenarios` with the seed. A scenario is a vehicle that covers at least
    10 m in 4 to 15 s; longer tracks are cut into several. `reset(options=…)` names a start:

    | option | meaning |
    |---|---|
    | `scenario` | number or name of a scenario |
    | `ego` | track id of any vehicle in the recording of the scenario |
    | `start_tick` | tick of the first observation, with 3 s of the ego's track before it |

    ## Episode End
    `info["ending"]` names the reason.

    | ending | flag | condition |
    |---|---|---|
    | `COLLISION` | terminated | the ego is at fault for a collision |
    | `OFF_ROAD` | terminated | a corner of the ego is more than 2 m off the drivable area |
    | `GOAL` | terminated | the ego reaches the end of the recorded ego's path |
    | `OUT_OF_DATA` | truncated | the scenario has run its length |

    Where the recorded ego itself leaves the drivable area, which may be a gap in the map, only the
    excess counts.

    ## Info
    The infos of `reset` and `step` have the same keys, types and shapes, in `ReplayVectorEnv` with
    a first axis `num_envs`.

    | key | value |
    |---|---|
    | `scenario` | name of the scenario |
    | `tags` | (13,) bool: which of `asp_env.data.scenarios.TAGS` the scenario has |
    | `tick` | ticks since the start |
    | `progress` | share of the recorded ego's path |
    | `collision`, `at_fault` | whether the ego touches an agent, and whether it is at fault |
    | `off_road_m` | distance of the outermost corner from the drivable area, m |
    | `reward_terms` | the terms of the last step's reward without weights; zeros after `reset` |
    | `ending` | the reason of the end, or `RUNNING` |
    | `is_success` | whether the episode has ended with `GOAL`: the ego reached its goal, and had \
neither a collision at its fault nor left the road by more than 2 m |
    | `episode_return`, `episode_length` | sum of the rewards and number of steps since `reset` |

    Gymnasium's `RecordEpisodeStatistics` adds its own `episode`, which is why these infos have
    none; those of `asp_env.sb3_vec_env` have one at the end of an episode, as of a `VecMonitor`.

    ## Arguments
    ```python
    import gymnasium, asp_env

    env = gymnasium.make("asp_env/Replay-v0", data="sample:intersection", traffic="idm")
    ```

    | argument | default | meaning |
    |---|---|---|
    | `data` | `"sample:intersection"` | a folder in the inD/rounD or INTERACTION layout, \
`sample:intersection`, `sample:roundabout`, `synthetic:…`, or `highway:…` with reacting traffic |
    | `flatten` | `False` | `True`: the observation is one vector; `"parts"`: each entry is one |
    | `render_mode` | `None` | `rgb_array`: an image of 80 m by 80 m from above; `human`: a \
window that shows every tick (extra `render`) |
    | `observations` | `("raster", "actions", "state")` | components of the observation |
    | `view` | `"chauffeurnet"` | view that draws the `raster`, see `asp_env.views` |
    | `raster_px` | `None` | height and width of the `raster`, or one number for a square \
one, which shows more to both sides of a view that is not square; the view's own by default |
    | `traffic` | `None` | driver of the uncontrolled agents: `log`, `log-actions`, `idm`, … or a \
table of drivers; `log` by default, `own` in a world with reacting traffic |
    | `dt_s` | `0.2` | length of a tick in seconds |
    | `reward_weights` | `None` | weights of reward terms that differ from the defaults |
    | `scenarios` | `""` | a set of scenarios, or a filter such as `left,length>=8` |
    | `predictor` | `None` | predictor whose forecasts become entries of the observation, or its \
name; several in a mapping with their prefixes |
    | `forecast` | `None` | `ForecastOptions` or a mapping of its fields |

    An unknown argument raises a `TypeError` that names the nearest known one.
    `asp_env/HighwayIntersection-v0` and `asp_env/HighwayRoundabout-v0` are this environment with
    `data="highway:intersection"` and `data="highway:roundabout"`.

    `asp_env/HighwayIntersectionVectors-v0` and the like have the light observations above.

    Besides Gymnasium's interface there are `scene()` for predictors and planners, `snapshot()` and
    `restore()` for search and counterfactuals, `logged_action()` for imitation, and `show()`, which
    draws a forecast and a plan.

    ## Version History
    - v0: initial version
    """

    metadata = METADATA

    @suggest_options
    def __init__(
        self,
        data: str = "sample:intersection",
        *,
        flatten: Flatten = False,
        render_mode: str | None = None,
        observations: Sequence[str] = ("raster", "actions", "state"),
        view: str = "chauffeurnet",
        raster_px: int | Sequence[int] | None = None,
        traffic: TrafficSpec | None = None,
        dt_s: float = DEFAULT_DT_S,
        action_type: str = "direct",
        action_repeat: int = 1,
        reward_weights: Mapping[str, float] | None = None,
        scenarios: ScenarioSet | ScenarioFilter | str = "",
        predictor: PredictorSpec | None = None,
        forecast: ForecastSpec | None = None,
    ) -> None:
        """Makes the environment; the arguments are those of the class documentation.

        Raises:
            AspEnvError: an argument is invalid, or the data hold no scenario.
            MissingExtraError: a window is requested and its package is not installed.
        """
        options = ReplayOptions(
            observations=observations,
            view=view,
            raster_px=raster_px,
            traffic=traffic,
            dt_s=dt_s,
            action_type=action_type,
            action_repeat=action_repeat,
            reward_weights=reward_weights,
            scenarios=scenarios,
            predictor=predictor,
            forecast=forecast,
        )
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, 1)
        self.observation_space = flat_space(self._episodes.space, flatten)
        self._flatten: Flatten = flatten
        hint_at_large_observations(self._episodes.space, is_vector=False)
        self.action_space = self._episodes.action_space
        self._running = False
        self._start: tuple[Scenario, Mapping[str, Any]] | None = None
        """The scenario, and the state of its generator at the start."""
        self._actions: list[Float[np.ndarray, " 2"]] = []
        self.metadata = {**METADATA, "render_fps": render_fps(dt_s * action_repeat)}
        self._live = LiveRenderer(render_mode, title=f"asp-env: {data}", dt_s=dt_s)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seed of `np_random`, which draws the scenario; not the number of a scenario.
            options: `scenario`, a number or a name; `ego`, the track id of any vehicle in the
                recording of the scenario; `start_tick`, the tick of the first observation.

        Raises:
            AspEnvError: the seed or an option is invalid, or there is no such scenario.
        """
        chosen = reset_options(options)
        super().reset(seed=checked_seed(seed))
        self._begin(*self._episodes.draw(self.np_random, chosen))
        self._running = True
        self._live.clear_overlay()
        self._update_window()
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Steps by one tick with an action (2,), which is clipped to [-1, 1].

        Raises:
            gymnasium.error.ResetNeeded: the episode is over, or none has begun.
            AspEnvError: the action has another shape or is not finite.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        result = self._act(valid_actions(action, (2,)))
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        self._running = not (terminated or truncated)
        self._update_window()
        return self._observe(), float(result.reward[0]), terminated, truncated, self._info()

    def scene(self) -> Scene:
        """Returns everything that may be known now, for predictors and planners; the ego is slot 0.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        self._check_begun()
        return self._episodes.scene()

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """Returns the recorded future of a scene's targets, for privileged predictors.

        Args:
            scene: the present scene, possibly with other targets.
            horizon: number of ticks.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        self._check_begun()
        return self._episodes.recorded_future(scene, horizon)

    def logged_action(self) -> Float[np.ndarray, " 2"]:
        """Returns the action of the logged driver at this tick, in [-1, 1].

        It leads the ego along its recorded track, and back to it where the ego has left it: see
        `asp_env.sim.log_following`. It uses the recorded state of the next tick, which is not known
        while driving. It is zero once the log has ended.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: the world has no logged driver, as highway-env's.
        """
        self._world()
        return self._episodes.logged_actions()[0][0]

    def logged_action_clipped(self) -> bool:
        """Returns whether `logged_action()` was clipped: the ego cannot follow the log there.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: the world has no logged driver, as highway-env's.
        """
        self._world()
        return bool(self._episodes.logged_actions()[1][0])

    def snapshot(self) -> EnvSnapshot:
        """Returns the whole state, including that of `np_random`, for `restore`.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._start is None:
            raise gymnasium.error.ResetNeeded(NOT_BEGUN)
        return EnvSnapshot(
            origin=self._episodes.origin,
            scenario=self._start[0],
            rng=self._start[1],
            actions=np.array(self._actions, dtype=np.float32).reshape(-1, 2),
            generator=self.np_random.bit_generator.state,
            seed=self._np_random_seed,
            running=self._running,
            arrays=self._episodes.snapshot(),
        )

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Restores a snapshot of this environment or of one made with the same arguments.

        Everything that follows is the same bit for bit.

        Raises:
            AspEnvError: the snapshot is of an environment with other arguments.
        """
        if not isinstance(snapshot, EnvSnapshot):
            raise AspEnvError(
                f"snapshot {shown(snapshot)}: expected what snapshot() of a ReplayEnv returns"
            )
        self._episodes.check_origin(snapshot.origin)
        if snapshot.arrays is None:
            rng = np.random.default_rng()
            rng.bit_generator.state = snapshot.rng
            self._begin(snapshot.scenario, rng)
            for action in snapshot.actions:
                self._episodes.make_forecasts()
                self._act(action)
        else:
            self._episodes.restore(snapshot.arrays)
            self._start = snapshot.scenario, snapshot.rng
            self._actions = list(snapshot.actions)
        self.np_random.bit_generator.state = snapshot.generator
        self._np_random_seed = snapshot.seed
        self._running = snapshot.running
        self._live.clear_overlay()

    def show(
        self, *, forecast: Forecast | None = None, plan: Shaped[np.ndarray, "..."] | None = None
    ) -> None:
        """Sets the overlay of the images, until the next call or `reset`.

        Args:
            forecast: a forecast of `scene()`; later images show its remaining ticks.
            plan: (steps, 2 or more) positions of the ego at the next ticks, x and y in metres.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: the forecast is not of this scene, or a value is not finite.
        """
        self._live.set_overlay(self.scene(), forecast, plan)
        if self.render_mode == "human":
            self.render()

    def render(self) -> Any:
        """Renders the present tick.

        Returns:
            uint8 (H, W, 3) RGB in mode `rgb_array`; None in `human`, where the window is updated.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: there is no screen.
        """
        if self.render_mode is None:
            return None
        return self._live.render(self.scene(), self._background())

    def get_keys_to_action(self) -> dict[str | tuple[str | int, ...], Float[np.ndarray, " 2"]]:
        """Returns the actions of keys for `gymnasium.utils.play.play`.

        W or up accelerates by 2 m/s², S or down brakes by 4 m/s², and A, D, left and right steer by
        9°. The empty text stands for no key.
        """
        return keyboard_actions()

    def close(self) -> None:
        """Closes the window."""
        self._live.close()

    @property
    def episodes(self) -> ReplayEpisodes:
        """The single episode as a batch of one, for wrappers."""
        return self._episodes

    @property
    def dt_s(self) -> float:
        """Length of a tick in seconds."""
        return self._episodes.simulation.world.dt_s

    @property
    def recordings(self) -> Recordings:
        """The recordings of `data`."""
        return self._episodes.recordings

    @property
    def predictors(self) -> tuple[Predictor, ...]:
        """The predictors whose forecasts are part of the observation."""
        return self._episodes.predictors

    @property
    def scenarios(self) -> ScenarioSet:
        """The scenarios to draw from."""
        return self._episodes.scenarios

    def _begin(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self._start, self._actions = (scenario, rng.bit_generator.state), []
        self._episodes.begin([scenario], [rng], np.ones(1, dtype=bool))

    def _act(self, action: Float[np.ndarray, " 2"]) -> StepResult:
        self._actions.append(action)
        return self._episodes.step(action[None])

    def _observe(self) -> Any:
        seen = flatten_observations(self._episodes.observe(), self._flatten)
        return seen[0] if self._flatten is True else {name: each[0] for name, each in seen.items()}

    def _info(self) -> dict[str, Any]:
        return info_of(self._episodes.info(), 0)

    def _check_begun(self) -> None:
        if self._start is None:
            raise gymnasium.error.ResetNeeded(NOT_BEGUN)

    def _world(self) -> World:
        self._check_begun()
        return self._episodes.simulation.world

    def _update_window(self) -> None:
        if self.render_mode == "human":
            self._live.update(self.scene(), self._background())

    def _background(self) -> Background | None:
        return self.recordings[int(self._world().episodes.recording[0])].background
