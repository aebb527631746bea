"""The socket for planners, and `expert`: the recorded ego, the reference for every planner."""

from dataclasses import dataclass
from typing import Any, NoReturn, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from asp_env import registry
from asp_env.arguments import text
from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The coming T ticks of the ego in each of B situations; the first action is executed."""

    actions: Float[np.ndarray, "b t 2"]
    """[acceleration m/s², steering rad]."""
    states: Float[np.ndarray, "b t 4"]
    """[x m, y m, heading rad, speed m/s] after each action."""


@runtime_checkable
class Planner(Protocol):
    """Decides what the egos (slot 0) of a scene do.

    A planner is registered in the entry point group `asp_env.planners`, as a callable without
    arguments that returns it. If the callable has an attribute `from_name`, the planner is named
    `NAME:ARGUMENT`, and `from_name(ARGUMENT)` returns it.
    """

    name: str
    """The name it is registered under."""
    privileged: bool
    """Whether it follows the recorded future; tables mark such planners."""
    uses_forecasts: bool
    """Whether its plans depend on the forecast."""

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """Plans for all B situations of a scene.

        Args:
            scene: the present scene, with the routes of the egos.
            forecast: of all other agents that are present, over T ticks.

        Raises:
            AspEnvError: the scene has no routes.
        """
        ...


@runtime_checkable
class TrainedPlanner(Planner, Protocol):
    """A planner that was trained with the forecasts of one predictor, or without any."""

    def check_predictor(self, predictor: Predictor) -> None:
        """Checks that a predictor is the one of the training.

        Raises:
            AspEnvError: it is another one.
        """
        ...


CandidatesT = TypeVar("CandidatesT")


@runtime_checkable
class CandidatePlanner(Planner, Protocol[CandidatesT]):
    """A planner that executes the cheapest of C candidates, which do not depend on the forecast.

    So the same candidates can be rated by several forecasts, as planning regret does
    (`planning_regret`). A candidate is what is decided now: a plan, or a first phase that
    several continuations may follow. The class of the candidates is the planner's own.
    """

    def candidates(self, scene: Scene, steps: int) -> CandidatesT:
        """The candidates for all B situations of a scene, over `steps` ticks.

        Raises:
            AspEnvError: the scene has no routes.
        """
        ...

    def costs(
        self, scene: Scene, forecast: Forecast, candidates: CandidatesT
    ) -> Float[np.ndarray, "b c"]:
        """Costs of candidates; their unit is the planner's own.

        Args:
            scene: the scene that the candidates are of.
            forecast: of all other agents that are present, over the ticks of the candidates.
            candidates: C candidates for each situation.
        """
        ...


def planning_regret(
    costs: Float[np.ndarray, "b c"], true_costs: Float[np.ndarray, "b c"]
) -> Float[np.ndarray, " b"]:
    """Planning regret: what an imperfect forecast costs a planner, by the planner's own costs.

    It is the cost under the truth of the candidate chosen with a forecast, less the lowest one.
    Regret is zero wherever the forecast leads to the same choice, however wrong it is. Related
    measures are in "Injecting Planning-Awareness into Prediction and Detection Evaluation"
    (Ivanovic and Pavone, arXiv 2110.03270) and "Not All Errors Are Made Equal" (arXiv 2403.04745).

    Args:
        costs: costs of C candidates in each of B situations under a forecast, by which the first of
            the cheapest is chosen.
        true_costs: costs of the same candidates under the recorded future.

    Returns:
        Regrets, at least 0, in the unit of the costs.
    """
    chosen = np.take_along_axis(true_costs, costs.argmin(axis=1)[:, None], axis=1)[:, 0]
    return chosen - true_costs.min(axis=1)


def load_planner(name: str) -> Planner:
    """The planner registered under a name, or `NAME:ARGUMENT` for one that needs an argument.

    Raises:
        AspEnvError: the name is unknown, or the planner rejects the argument.
    """
    kind, colon, argument = text("planner", name).partition(":")

    def made_by(factory: Any) -> Any:
        from_name = getattr(factory, "from_name", None)
        if from_name is not None:
            if not argument:
                raise AspEnvError(f"planner {kind}: name a run as well, such as {kind}:RUN")
            return from_name(argument)
        if colon:
            raise AspEnvError(f"planner {name}: {kind} takes no argument; write {kind}")
        return factory()

    return registry.make("planners", kind, made_by, Planner)


class Expert:
    """The recorded ego, which is replayed position by position; it plans nothing.

    Its score is the noise floor of data and metrics. Code that runs planners checks `privileged`
    and lets the world replay the ego instead of calling `plan`.
    """

    name = "expert"
    privileged = True
    uses_forecasts = False

    def plan(self, scene: Scene, forecast: Forecast) -> NoReturn:
        """Fails, since a scene does not contain the recorded future.

        Raises:
            AspEnvError: always.
        """
        del scene, forecast
        raise AspEnvError("the expert does not plan: let the world replay the ego")
