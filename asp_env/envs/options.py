"""The options that all replay environments share, and the error for an unknown one."""

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from asp_env.arguments import positive_number, shown, table, text, whole_number
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios.scenario import ScenarioFilter, ScenarioSet
from asp_env.envs.forecasts import ForecastSpec, PredictorSpec
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.assignment import TrafficSpec

Function = TypeVar("Function", bound=Callable[..., Any])

MAX_RASTER_PX = 4096
"""Largest height and width of a raster. Chosen by hand: 200 MB for each observation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """Options of a replay environment.

    The constructors of the environments have each of these fields as a keyword parameter with the
    same default, so that editors complete them; a test compares the signatures with this class.
    """

    observations: Sequence[str] = ("raster", "actions", "state")
    """Components of the observation: some of `raster`, `vectors`, `actions`, `state`, `route`,
    `nearest` and the names of views that draw rasters."""
    view: str = "chauffeurnet"
    """The view that draws the `raster`."""
    raster_px: int | Sequence[int] | None = None
    """Height and width of the `raster` in pixels, or one number for both; by default the view's.
    """
    traffic: TrafficSpec | None = None
    """The driver of the uncontrolled agents, or a table of drivers by id and class; by default the
    world moves them."""
    dt_s: float = DEFAULT_DT_S
    """Length of a tick in seconds."""
    action_type: str = "direct"
    """What the two numbers of an action mean, see `asp_env.sim.action_types`."""
    action_repeat: int = 1
    """Number of ticks for which each action is held; rewards are summed over them."""
    reward_weights: Mapping[str, float] | None = None
    """Weights of reward terms by name, where they differ from the defaults."""
    scenarios: ScenarioSet | ScenarioFilter | str = ""
    """The scenarios to draw from: a set of them, or a filter such as `left,length>=8`."""
    predictor: PredictorSpec | None = None
    """The predictor whose forecasts the observation shows, or its name; several in a mapping with
    the prefixes of their entries. None adds nothing."""
    forecast: ForecastSpec | None = None
    """`ForecastOptions` or a mapping of its fields; for several predictors also a mapping from
    their prefixes to either."""

    def __post_init__(self) -> None:
        """Checks the types of options that are not checked where they are used.

        Raises:
            AspEnvError: an option is of another type, or out of range.
        """
        if isinstance(self.observations, str) or not isinstance(self.observations, Sequence):
            raise AspEnvError(
                f"observations {shown(self.observations)}: expected a sequence of names such as "
                "('state', 'route')"
            )
        text("view", self.view)
        positive_number("time step", self.dt_s, "s")
        whole_number("action_repeat", self.action_repeat, least=1)
        if self.reward_weights is not None:
            table("reward_weights", self.reward_weights, "numbers by name of the term")
        if not isinstance(self.scenarios, ScenarioSet | ScenarioFilter | str):
            raise AspEnvError(
                f"scenarios {shown(self.scenarios)}: expected a ScenarioSet, a ScenarioFilter or a "
                "text such as 'left,length>=8'"
            )


def raster_size(raster_px: int | Sequence[int] | None) -> tuple[int, int] | None:
    """Returns the height and the width of rasters in pixels.

    Args:
        raster_px: both, one number for both, or None for those of the view.

    Raises:
        AspEnvError: it is neither one nor two whole numbers, or a raster would be too large.
    """
    if raster_px is None:
        return None
    sizes: list[Any] = [raster_px] * 2
    if isinstance(raster_px, Sequence) and not isinstance(raster_px, str):
        sizes = list(raster_px)
    try:
        height, width = (whole_number("", size, least=1, most=MAX_RASTER_PX) for size in sizes)
    except (AspEnvError, ValueError):
        raise AspEnvError(
            f"raster_px {shown(raster_px)}: expected height and width in pixels such as (90, 60), "
            f"or one number for a square raster, from 1 to {MAX_RASTER_PX}"
        ) from None
    return height, width


class UnknownOptionError(AspEnvError, TypeError):
    """A call with a keyword argument that the function does not have."""


def suggest_options(function: Function) -> Function:
    """Makes a call with an unknown keyword argument fail with the nearest known name.

    Python itself names only the unknown argument. The signature stays that of the function.
    """
    known = [name for name in inspect.signature(function).parameters if name != "self"]
    caller = function.__qualname__.removesuffix(".__init__")

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for name in kwargs:
            if name not in known:
                nearest = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {nearest[0]!r}?" if nearest else f"known: {', '.join(known)}"
                raise UnknownOptionError(
                    f"{caller}() got an unexpected keyword argument {name!r}; {hint}"
                )
        return function(*args, **kwargs)

    return cast("Function", checked)
