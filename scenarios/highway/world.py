"""A world in which highway-env's vehicles react."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import frames_per_tick
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO
from asp_env.data.source import Recordings
from asp_env.dynamics import forward
from asp_env.errors import AspEnvError, DataError
from asp_env.sim.episodes import gather_controlled
from asp_env.sim.world import World
from scenarios.highway.road_map import mirror_actions, mirror_states
from scenarios.highway.rounds import (
    HIDDEN_EVERY_FRAMES,
    WANTED,
    HiddenHistory,
    Rows,
    hidden_path,
    load_history,
    read_vehicles,
    restore,
    step_road,
)
from scenarios.highway.sites import STEP_S, STEPS_PER_S, empty_road, remove_exited
from scenarios.highway.vehicles import Road, TrafficVehicle

APART_M = 15.0
"""Nobody comes this near to somebody else; highway-env's own rule at the intersection."""


@dataclass(slots=True, kw_only=True)
class _Run:
    """One episode's part of highway-env."""

    road: Road
    frame: int
    """In the recording."""
    history: HiddenHistory


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    """The same as it was at one tick."""

    rows: Rows
    steps: int
    frame: int


class HighwayWorld(World):
    """B episodes that begin as recorded; from then on highway-env's vehicles drive themselves.

    Whom nobody drives is driven by highway-env: its intelligent driver model, its lane changes, its
    rules of the road. Who is driven obeys the same bicycle model as in every world, so that an
    action means the same; highway-env's own vehicle has its axles at its bumpers. Vehicles come
    where and when they were recorded to come, unless somebody is within 15 m; all but the ego leave
    at the end of the road. Left to itself, an episode goes on exactly as it was recorded.
    """

    traffic = "own"

    def __init__(
        self, recordings: Sequence[Any], *, num_episodes: int, dt_s: float, history: int
    ) -> None:
        """A world without episodes yet; `reset` starts them.

        Raises:
            AspEnvError: the time step is no multiple of 0.2 s, or the recordings are of no folder.
        """
        if not isinstance(recordings, Recordings):
            raise AspEnvError("recordings in memory: expected those of `highway:…`")
        super().__init__(recordings, num_episodes=num_episodes, dt_s=dt_s, history=history)
        self._stride = frames_per_tick(float(STEPS_PER_S), dt_s)
        if self._stride % HIDDEN_EVERY_FRAMES:
            raise AspEnvError(
                f"time step {dt_s:g} s: what highway-env's vehicles have in mind is kept every "
                f"{HIDDEN_EVERY_FRAMES * STEP_S:g} s; choose a multiple of that"
            )
        self._folder = recordings
        self._runs: list[_Run | None] = [None] * num_episodes
        self._slots: list[dict[int, int]] = [{} for _ in range(num_episodes)]
        """Of each episode, the slot of each track."""
        self._histories: dict[int, HiddenHistory] = {}
        """By the number of the recording."""

    def reset(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        reset_mask: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts the episodes at `reset_mask` (all by default); the others' entries are not read.

        Raises:
            AspEnvError: a scenario does not fit its recording.
            DataError: highway-env did not make the recording.
        """
        super().reset(scenarios, rngs, reset_mask)
        chosen = np.ones(len(self), dtype=bool) if reset_mask is None else reset_mask
        for b in np.flatnonzero(chosen).tolist():
            history = self._history(scenarios[b].recording)
            frame = scenarios[b].start_tick * self._stride
            rows, steps = history.at(frame)
            self._begin(b, history, _Kept(rows=rows, steps=steps, frame=frame))
            self._show_truth(b)

    def _history(self, recording: int) -> HiddenHistory:
        if recording not in self._histories:
            tracks = self._folder.tracks_path(recording)
            history = load_history(path := hidden_path(tracks))
            if not history.fits(self._folder[recording]):
                raise DataError(
                    f"{path} does not tell of the vehicles in {tracks}: expected both as they were "
                    f"{WANTED}"
                )
            self._histories[recording] = history
        return self._histories[recording]

    def _begin(self, b: int, history: HiddenHistory, kept: _Kept) -> None:
        road = empty_road(history.site, steps=kept.steps)
        road.vehicles = restore(kept.rows, road, history.site.vehicle)
        self._runs[b] = _Run(road=road, frame=kept.frame, history=history)
        tracks = self.episodes.tracks[b]
        self._slots[b] = {int(tracks[a]): a for a in np.flatnonzero(tracks >= 0).tolist()}

    def _show_truth(self, b: int) -> None:
        """Writes the history as it was; the recording's may be rounded or measured with errors."""
        run, slots, states = self._runs[b], self._slots[b], self.episodes.states[b]
        assert run is not None
        for back in range(self.history + 1):
            rows, _ = run.history.at(run.frame - back * self._stride)
            at = [slots[track] for track in rows["track"].tolist()]
            states[self.history - back, at] = _states_of(rows)

    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        controlled: Bool[np.ndarray, "r a"],
        acting: Bool[np.ndarray, "r a"],
    ) -> None:
        states, held, lengths = gather_controlled(self.episodes, rows, now, actions, acting)
        times_s = [*((k + 1) * STEP_S for k in range(self._stride - 1)), self.dt_s]
        ways = np.stack([forward(states, held, lengths, each) for each in times_s])
        poses = mirror_states(ways.astype(np.float64)).swapaxes(0, 1).tolist()
        commands = mirror_actions(held.astype(np.float64)).tolist()
        at = 0
        for i, b in enumerate(rows.tolist()):
            steered = np.flatnonzero(acting[i]).tolist()
            obeying = {slot: (at + k) for k, slot in enumerate(steered)}
            for slot, number in obeying.items():
                acceleration, steering = commands[number]
                self._vehicle(b, slot).steer(acceleration, steering, poses[number])
            self._advance(b, controlled[i], obeying)
            self._write(b, int(now[i]) + 1, acting[i], ways[-1, at : at + len(steered)])
            at += len(steered)

    def _vehicle(self, b: int, slot: int) -> TrafficVehicle:
        run, track = self._runs[b], self.episodes.tracks[b, slot]
        assert run is not None
        return next(each for each in run.road.vehicles if each.track == track)

    def _advance(self, b: int, controlled: Bool[np.ndarray, " a"], obeying: dict[int, Any]) -> None:
        """One tick of one episode's road."""
        run, slots, gone = self._runs[b], self._slots[b], self.episodes.departed[b]
        assert run is not None
        road = run.road
        road.vehicles = [each for each in road.vehicles if not gone[slots[each.track]]]
        for vehicle in road.vehicles:
            if slots[vehicle.track] not in obeying:
                vehicle.release()
        for _ in range(self._stride):
            step_road(road)
            run.frame += 1
            if run.frame % STEPS_PER_S == 0:
                remove_exited(run.history.site, road, ego=int(self.episodes.tracks[b, EGO]))
                away = [slot for slot in slots.values() if controlled[slot] or gone[slot]]
                self._let_in(run, {int(self.episodes.tracks[b, slot]) for slot in away})

    def _let_in(self, run: _Run, away: set[int]) -> None:
        """Those who are recorded to come at this frame, unless somebody is where they would be."""
        comers = run.history.coming(run.frame)
        for row in comers[~np.isin(comers["track"], [*away])]:
            place = np.array([row["x"], row["y"]])
            near = [np.linalg.norm(each.position - place) < APART_M for each in run.road.vehicles]
            if not any(near):
                run.road.vehicles += restore(row[None], run.road, run.history.site.vehicle)

    def _write(
        self,
        b: int,
        tick: int,
        acting: Bool[np.ndarray, " a"],
        moved: Float[np.ndarray, "n 4"],
    ) -> None:
        """What became of one episode, into the arrays."""
        run, slots, data = self._runs[b], self._slots[b], self.episodes
        assert run is not None
        there = data.valid[b, tick]
        there[:] = False
        vehicles = run.road.vehicles
        if vehicles:
            at = [slots[each.track] for each in vehicles]
            theirs = np.array([(*v.position, v.heading, v.speed) for v in vehicles])
            data.states[b, tick, at] = mirror_states(theirs)
            there[at] = True
        data.states[b, tick, acting] = moved
        data.states[b, tick, ~there] = 0.0
        data.departed[b] |= data.valid[b, tick - 1] & ~there

    def snapshot(self) -> Any:
        """The whole state, to be handed to `restore`."""
        kept = [
            run and _Kept(rows=read_vehicles(run.road), steps=run.road.steps, frame=run.frame)
            for run in self._runs
        ]
        return super().snapshot(), kept

    def restore(self, snapshot: Any) -> None:
        """Goes back to a snapshot, bit for bit."""
        arrays, kept = snapshot
        super().restore(arrays)
        for b, (each, scenario) in enumerate(zip(kept, self.scenarios, strict=True)):
            self._runs[b] = None
            if each is not None:
                assert scenario is not None
                self._begin(b, self._history(scenario.recording), each)


def _states_of(rows: Rows) -> Float[np.ndarray, "n 4"]:
    """In our axes."""
    return mirror_states(np.stack([rows[name] for name in ("x", "y", "heading", "speed")], axis=-1))
