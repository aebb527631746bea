"""Which scenarios an environment draws from, and the one that a reset asks for."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asp_env.data.classes import VULNERABLE, AgentClass
from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.scenario import MAX_LENGTH_S, Scenario, ScenarioSet
from asp_env.errors import AspEnvError, unknown_name

OPTIONS = ("scenario", "start_tick", "ego")
"""What `reset(options=…)` understands."""


def tagged(found: ScenarioSet, tags: str | Sequence[str] | None, *, data: str) -> ScenarioSet:
    """Those that carry every one of some tags.

    Raises:
        AspEnvError: there is none, or a tag is unknown.
    """
    if not len(found):
        raise AspEnvError(
            f"{data}: no vehicle covers 10 m in 4 s after 3 s of history; use other recordings"
        )
    wanted = [tags] if isinstance(tags, str) else list(tags or ())
    known = {tag for scenario in found for tag in scenario.tags}
    left = found
    for tag in wanted:
        if tag not in known:
            raise unknown_name("scenario tag", tag, known)
        left = left.tagged(tag)
    if not len(left):
        raise AspEnvError(f"{data}: no scenario carries all of the tags {', '.join(wanted)}")
    return left


def checked(given: ScenarioSet, names: Sequence[str], *, data: str) -> ScenarioSet:
    """Scenarios that the caller chose.

    Raises:
        AspEnvError: there is none, or one is not of these recordings.
    """
    if not len(given):
        raise AspEnvError("scenarios: the set is empty; expected at least one scenario")
    for scenario in given:
        if scenario.recording_name not in names[scenario.recording : scenario.recording + 1]:
            raise AspEnvError(
                f"scenario {scenario.name}: expected one of {data}, whose recordings are "
                f"{', '.join(names)}"
            )
    return given


@dataclass(frozen=True, slots=True, kw_only=True)
class Starts:
    """Where episodes of some recordings may begin."""

    recordings: Sequence[Recording]
    scenarios: ScenarioSet
    data: str
    dt_s: float
    history: int

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
        given = self.scenarios[drawn if asked is None else self._number(asked)]
        ego, start_tick = options.get("ego"), options.get("start_tick")
        if ego is None and start_tick is None:
            return given
        if asked is None and ego is None:
            raise AspEnvError(
                f"start_tick {start_tick} alone: name the scenario or the ego that starts there"
            )
        if asked is None and len(self.recordings) > 1:
            raise AspEnvError(
                f"ego {ego} without a scenario: {self.data} has {len(self.recordings)} recordings; "
                "name a scenario of the recording that is meant"
            )
        return self._anywhere(
            given.recording,
            given.ego_id if ego is None else _whole("ego", ego),
            None if start_tick is None else _whole("start_tick", start_tick),
        )

    def _number(self, asked: Any) -> int:
        if isinstance(asked, str):
            names = [scenario.name for scenario in self.scenarios]
            if asked not in names:
                raise unknown_name("scenario", asked, names)
            return names.index(asked)
        whole = isinstance(asked, int | np.integer) and not isinstance(asked, bool)
        if not (whole and 0 <= asked < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {asked}: expected 0 to {len(self.scenarios) - 1} for this data, or a "
                "scenario's name"
            )
        return int(asked)

    def _anywhere(self, number: int, ego_id: int, start_tick: int | None) -> Scenario:
        """An episode of one vehicle of a recording."""
        recording = self.recordings[number]
        where = f"recording {recording.name}"
        found = np.flatnonzero(recording.track_ids == ego_id)
        if not len(found):
            raise AspEnvError(
                f"ego {ego_id}: {where} has no such track; expected one of its "
                f"{len(recording)} track ids"
            )
        track = int(found[0])
        kind = AgentClass(int(recording.classes[track]))
        if kind in VULNERABLE | {AgentClass.TRAILER}:
            raise AspEnvError(f"ego {ego_id}: is a {kind.name.lower()}, expected a vehicle")
        stride = frames_per_tick(recording.frame_rate_hz, self.dt_s)
        earliest = math.ceil(int(recording.first_frames[track]) / stride) + self.history
        last = int(recording.last_frames[track]) // stride
        if earliest >= last:
            raise AspEnvError(
                f"ego {ego_id}: its track spans {last - earliest + self.history} ticks of "
                f"{self.dt_s:g} s, expected over {self.history}: the history and one to drive"
            )
        start = earliest if start_tick is None else start_tick
        if not earliest <= start < last:
            raise AspEnvError(
                f"start_tick {start}: expected {earliest} to {last - 1} for ego {ego_id} of "
                f"{where}, which has its history of {self.history} ticks from then on"
            )
        return Scenario(
            source=self.data,
            recording=number,
            recording_name=recording.name,
            start_tick=start,
            length=min(int(MAX_LENGTH_S / self.dt_s + 1e-6), last - start),
            ego_id=ego_id,
        )


def _whole(name: str, value: Any) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise AspEnvError(f"{name} {value!r}: expected a whole number")
    return int(value)
