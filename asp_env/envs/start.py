"""Which scenarios an environment draws from, and the one that a reset asks for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from asp_env.data.scenario import Scenario, ScenarioSet
from asp_env.data.scenario_choice import choose_scenarios, scenario_of
from asp_env.data.scenario_filter import ScenarioFilter
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError, unknown_name

OPTIONS = ("scenario", "start_tick", "ego")
"""What `reset(options=…)` understands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Starts:
    """Where episodes of some recordings may begin."""

    recordings: Recordings
    scenarios: ScenarioSet

    @classmethod
    def choose(
        cls,
        recordings: Recordings,
        wanted: ScenarioSet | ScenarioFilter | str,
        *,
        dt_s: float,
        history: int,
    ) -> "Starts":
        """The scenarios to draw from: those that fit a filter or its words, or those given.

        Raises:
            AspEnvError: there is none, or those given are of other data or another time step.
        """
        data = recordings.source
        if isinstance(wanted, ScenarioSet):
            _check(wanted, recordings, dt_s=dt_s, history=history)
            return cls(recordings=recordings, scenarios=wanted)
        found = choose_scenarios(recordings, str(wanted), dt_s=dt_s, history=history)
        if not len(found):
            raise AspEnvError(
                f"{data}: no vehicle covers 10 m in 4 s after 3 s of history; use other recordings"
            )
        return cls(recordings=recordings, scenarios=found)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Starts":
        """Itself, since nothing of it ever changes."""
        del memo
        return self

    def find(self, options: Mapping[str, Any], drawn: int) -> Scenario:
        """The scenario that the options of a reset ask for, else the drawn one.

        `scenario` is a number or a name. `ego` is the track id of any vehicle, in the recording of
        the scenario; `start_tick` the tick of the first observation. Without a start the episode
        begins as soon as the history is there; it lasts as long as the track, 15 s at most.

        Raises:
            AspEnvError: an option is unknown, or what it asks for does not exist.
        """
        for name in options:
            if name not in OPTIONS:
                raise unknown_name("reset option", str(name), OPTIONS)
        asked = options.get("scenario")
        given = self.scenarios[drawn] if asked is None else self._asked(asked)
        ego, start_tick = options.get("ego"), options.get("start_tick")
        if ego is None and start_tick is None:
            return given
        if asked is None and ego is None:
            raise AspEnvError(
                f"start_tick {start_tick} alone: name the scenario or the ego that starts there"
            )
        if asked is None and len(self.recordings) > 1:
            raise AspEnvError(
                f"ego {ego} without a scenario: {self.scenarios.source} has "
                f"{len(self.recordings)} recordings; name a scenario of the one that is meant"
            )
        return scenario_of(
            self.recordings,
            source=self.scenarios.source,
            recording=given.recording,
            ego_id=given.ego_id if ego is None else _whole("ego", ego),
            start_tick=None if start_tick is None else _whole("start_tick", start_tick),
            dt_s=self.scenarios.dt_s,
            history=self.scenarios.history,
        )

    def _asked(self, asked: Any) -> Scenario:
        if isinstance(asked, str):
            return self.scenarios.by_name(asked)
        whole = isinstance(asked, int | np.integer) and not isinstance(asked, bool)
        if not (whole and 0 <= asked < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {asked}: expected 0 to {len(self.scenarios) - 1} for this data, or a "
                "scenario's name"
            )
        return self.scenarios[int(asked)]


def _check(given: ScenarioSet, recordings: Recordings, *, dt_s: float, history: int) -> None:
    if not len(given):
        raise AspEnvError("scenarios: the set is empty; expected at least one scenario")
    names = tuple(recording.name for recording in recordings)
    if given.recordings != names:
        raise AspEnvError(
            f"scenarios of {given.source}: expected some of {recordings.source}, whose recordings "
            f"are {', '.join(names)}"
        )
    if abs(given.dt_s - dt_s) > 1e-9 or given.history != history:
        raise AspEnvError(
            f"scenarios for {given.history} past ticks of {given.dt_s:g} s: expected {history} of "
            f"{dt_s:g} s"
        )


def _whole(name: str, value: Any) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise AspEnvError(f"{name} {value!r}: expected a whole number")
    return int(value)
