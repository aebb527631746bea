"""`asp_env/Replay-v0`: drive one vehicle of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float, Shaped

from asp_env.data.predictor import Forecast
from asp_env.data.recording import Background
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings
from asp_env.envs.episodes import ReplayEpisodes, StepResult, as_actions
from asp_env.render.live import MODES, LiveRenderer
from asp_env.sim.world import World, recorded_future

NOT_BEGUN = "no episode has begun: call reset first"
METADATA = {"render_modes": [*MODES], "render_fps": 5}


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvSnapshot:
    """The whole state of an environment: how it came about, and the arrays of it.

    Pickles hold only how it came about, a few kilobytes; from those an environment that is made
    with the same arguments gets to the same state by driving there.
    """

    scenario: Scenario
    rng: Mapping[str, Any]
    """State of the episode's own generator at its start."""
    actions: Float[np.ndarray, "steps 2"]
    """Since the start, in [-1, 1]."""
    generator: Mapping[str, Any]
    """State of `np_random`."""
    seed: int | None
    running: bool
    arrays: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Without the arrays."""
        names = [field.name for field in fields(self) if field.name != "arrays"]
        return partial(EnvSnapshot, **{name: getattr(self, name) for name in names}), ()


class ReplayEnv(gymnasium.Env[dict[str, Any], Any]):
    """Drive one vehicle of a recording; the traffic around it is replayed or reacts.

    ## Action space
    `Box(-1, 1, (2,), float32)`: acceleration (times 5 m/s²) and steering (times π/4 rad, left
    positive), held for one tick of the kinematic bicycle model. Braking ends at speed 0.

    ## Observation space
    A `Dict` of what `observations` names, in any choice; only that is computed. All values are
    finite and within finite bounds: what would lie beyond is shown at the bound.

    | name | parts and spaces | what it is |
    |---|---|---|
    | `raster` | `raster`: `Box(0, 255, (12, H, W), uint8)` | the picture that `view` draws, \
heading up, see `asp_env.views` |
    | `chauffeurnet`, `mtp`, … | a part of that name | the picture of that view in its usual size, \
beside or instead of `raster` |
    | `vectors` | `agents`: `Box(…, (16, 16, 12), float32)` | the ego and its nearest neighbours \
over the last 3 s, fields as `asp_env.views.vectors.AGENT_FIELDS`, m, rad as cos and sin, m/s, in \
the ego's frame now |
    | | `agents_valid`: `Box(0, 1, (16, 16), int8)` | who was there when |
    | | `lines`: `Box(…, (64, 10, 8), float32)` | the nearest pieces of lanes and boundaries as 10 \
points, fields as `LINE_FIELDS`, in the ego's frame |
    | | `lines_valid`: `Box(0, 1, (64, 10), int8)` | which points there are |
    | `actions` | `actions`: `Box(±[10, π/4], (15, 2), float32)` | acceleration m/s² and steering \
rad of the last 3 s, oldest first, inferred from the motion |
    | `state` | `state`: `Box(…, (9,), float32)` | fields and bounds in \
`asp_env.sim.observation.STATE_FIELDS`: speed m/s, acceleration m/s², steering rad, offset to the \
left of the route m, heading error rad, share of the route done, way to the goal m, length m, \
width m |
    | `route` | `route`: `Box(±1000, (30, 2), float32)` | points 2, 4, … 60 m ahead on the ego's \
way, in its frame, m; beyond the end of the way straight on |

    ## Reward
    The weighted sum of the terms in `info["reward_terms"]`: progress along the logged way,
    comfort, collision at fault, off-road (`asp_env.sim.reward`).

    ## Start and end of an episode
    `reset` draws one of the scenarios (a vehicle that covers at least 10 m in 4 to 15 s), or takes
    `options={"scenario": number or name}`. With `ego` (the track id of any vehicle, in the
    recording of the scenario) and `start_tick` it begins anywhere with 3 s of history. Terminated:
    a collision that the ego answers for (`COLLISION`), over 2 m off the road (`OFF_ROAD`), or the
    end of the logged way (`GOAL`). Truncated: the recording has no more (`OUT_OF_DATA`).
    `info["ending"]` names it.

    ## Arguments
    `data`: a folder in the inD/rounD or INTERACTION layout, `sample:intersection`,
    `sample:roundabout`, `synthetic:…` or `highway:…`, in which highway-env's traffic reacts (the
    default of `asp_env/HighwayIntersection-v0` and `asp_env/HighwayRoundabout-v0`). Then those of
    `asp_env.envs.episodes.ReplayOptions`: `observations`, `view` and `raster_px` (height, width;
    by default the view's own) of the raster, `traffic` (`log`, `log-actions`, `idm`, … or a table
    of them; by default `log`, or `own` where traffic reacts), `dt_s` (length of a tick),
    `reward_weights` by name, where they differ from the defaults, and `scenarios` (a set of them,
    or a filter such as `left,length>=8`).

    ## Going back
    `snapshot()` and `restore()` on `env.unwrapped` bring back the whole state bit for bit, that of
    `np_random` included, for search and counterfactuals; snapshots can be pickled.

    ## Rendering
    `render_mode`: `rgb_array`, a picture from above of 80 m by 80 m, or `human`, a window that
    keeps up with the episode (extra `render`). `show` adds a forecast and a plan.

    ## Version history
    v0: first.
    """

    metadata = METADATA

    def __init__(
        self, data: str = "sample:intersection", *, render_mode: str | None = None, **options: Any
    ) -> None:
        """See the class documentation for the arguments.

        Raises:
            AspEnvError: an argument is not understood, or the data hold no scenario.
        """
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, 1)
        self.observation_space = self._episodes.observer.space
        self.action_space = self._episodes.action_space
        self._running = False
        self._start: tuple[Scenario, Mapping[str, Any]] | None = None
        """The scenario, and the state of its generator when it began."""
        self._actions: list[Float[np.ndarray, " 2"]] = []
        dt_s = self._episodes.simulation.world.dt_s
        self.metadata = {**METADATA, "render_fps": round(1 / dt_s, 6)}
        self._live = LiveRenderer(render_mode, title=f"asp-env: {data}", dt_s=dt_s)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts the scenario that the options ask for, or one drawn with the seed.

        Args:
            seed: of `np_random`; never the number of a scenario.
            options: `scenario` (number or name), `ego` (track id of any vehicle, in the recording
                of the scenario) and `start_tick` (of the first observation).

        Raises:
            AspEnvError: an option is unknown, or what it asks for does not exist.
        """
        super().reset(seed=seed)
        self._begin(*self._episodes.draw(self.np_random, options or {}))
        self._running = True
        self._live.clear_overlay()
        self._keep_up()
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One tick; the action is moved to the nearest one in the space.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over, or none has begun.
            AspEnvError: the action has another shape or is not finite.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        outcome = self._act(as_actions(action, (2,)))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._running = not (terminated or truncated)
        info = self._info() | {
            "reward_terms": {name: float(value[0]) for name, value in outcome.terms.items()},
            "ending": outcome.ending[0],
        }
        self._keep_up()
        return self._observe(), float(outcome.reward[0]), terminated, truncated, info

    def snapshot(self) -> EnvSnapshot:
        """The whole state with that of `np_random`, to be handed to `restore`.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        if self._start is None:
            raise gymnasium.error.ResetNeeded(NOT_BEGUN)
        return EnvSnapshot(
            scenario=self._start[0],
            rng=self._start[1],
            actions=np.array(self._actions, dtype=np.float32).reshape(-1, 2),
            generator=self.np_random.bit_generator.state,
            seed=self._np_random_seed,
            running=self._running,
            arrays=self._episodes.snapshot(),
        )

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Goes back to a snapshot of this environment or of one made with the same arguments.

        What comes after is the same bit for bit.
        """
        if snapshot.arrays is None:
            rng = np.random.default_rng()
            rng.bit_generator.state = snapshot.rng
            self._begin(snapshot.scenario, rng)
            for action in snapshot.actions:
                self._act(action)
        else:
            self._episodes.restore(snapshot.arrays)
            self._start = snapshot.scenario, snapshot.rng
            self._actions = list(snapshot.actions)
        self.np_random.bit_generator.state = snapshot.generator
        self._np_random_seed = snapshot.seed
        self._running = snapshot.running
        self._live.clear_overlay()

    def scene(self) -> Scene:
        """All that may be known now, for a predictor in anybody's loop; the ego is slot 0.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        return self._world().scene()

    def show(
        self, *, forecast: Forecast | None = None, plan: Shaped[np.ndarray, "..."] | None = None
    ) -> None:
        """Hands over what to draw besides, until the next time; `reset` forgets it.

        Args:
            forecast: of `scene()`. Later pictures show what is still to come of it.
            plan: the ego's positions at the next ticks, metres, in the first two columns.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: it is not of this scene, or not finite.
        """
        self._live.set_overlay(self.scene(), forecast, plan)
        if self.render_mode == "human":
            self.render()

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """What the targets of a scene of now went on to do, for privileged predictors alone.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        return recorded_future(self._world(), scene, horizon)

    @property
    def dt_s(self) -> float:
        """Length of a tick."""
        return self._episodes.simulation.world.dt_s

    def render(self) -> Any:
        """A picture from above: RGB uint8 (H, W, 3) in mode `rgb_array`, on screen in `human`.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: there is no screen.
        """
        if self.render_mode is None:
            return None
        return self._live.render(self.scene(), self._background())

    def close(self) -> None:
        """Closes the window, if there is one."""
        self._live.close()

    def _keep_up(self) -> None:
        if self.render_mode == "human":
            self._live.update(self.scene(), self._background())

    def _background(self) -> Background | None:
        return self.recordings[int(self._world().episodes.recording[0])].background

    @property
    def recordings(self) -> Recordings:
        """Of DATA."""
        return self._episodes.recordings

    @property
    def scenarios(self) -> ScenarioSet:
        """Those that are drawn from."""
        return self._episodes.scenarios

    def _begin(self, scenario: Scenario, rng: np.random.Generator) -> None:
        self._start, self._actions = (scenario, rng.bit_generator.state), []
        self._episodes.begin([scenario], [rng], np.ones(1, dtype=bool))

    def _act(self, action: Float[np.ndarray, " 2"]) -> StepResult:
        self._actions.append(action)
        return self._episodes.step(action[None])

    def _observe(self) -> dict[str, Any]:
        return {name: value[0] for name, value in self._episodes.observe().items()}

    def _info(self) -> dict[str, Any]:
        return {name: value.tolist()[0] for name, value in self._episodes.info().items()}

    def _world(self) -> World:
        if self._start is None:
            raise gymnasium.error.ResetNeeded(NOT_BEGUN)
        return self._episodes.simulation.world
