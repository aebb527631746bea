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
"""Vehicles do not appear nearer to others than this, as at highway-env's intersection."""


@dataclass(slots=True, kw_only=True)
class _Run:
    """highway-env's part of one episode."""

    road: Road
    frame: int
    """Frame of the recording."""
    history: HiddenHistory


@dataclass(frozen=True, slots=True, kw_only=True)
class _SavedRun:
    """The state of `_Run` at one tick."""

    rows: Rows
    steps: int
    frame: int


class HighwayWorld(World):
    """Episodes that start from recordings of highway-env's traffic and continue reactively.

    Uncontrolled agents are moved by highway-env: its intelligent driver model, its lane changes
    and its right of way. Controlled agents obey the same bicycle model as in every world, so that
    an action has the same meaning; highway-env's own vehicle has its axles at its bumpers.
    Vehicles appear where and when they were recorded to appear, unless another vehicle is within
    15 m; all but the ego are removed at the end of the road. Without control, an episode continues
    exactly as recorded.
    """

    traffic = "own"

    def __init__(
        self, recordings: Sequence[Any], *, num_episodes: int, dt_s: float, history: int
    ) -> None:
        """Creates a world without episodes; `reset` starts them.

        Raises:
            AspEnvError: the time step is not a multiple of 0.2 s, or the recordings are not from a
                folder.
        """
        if not isinstance(recordings, Recordings):
            raise AspEnvError("recordings in memory: expected those of `highway:…`")
        super().__init__(recordings, num_episodes=num_episodes, dt_s=dt_s, history=history)
        self._stride = frames_per_tick(float(STEPS_PER_S), dt_s)
        if self._stride % HIDDEN_EVERY_FRAMES:
            raise AspEnvError(
                f"time step {dt_s:g} s: internal states of highway-env's vehicles are stored every "
                f"{HIDDEN_EVERY_FRAMES * STEP_S:g} s; choose a multiple of that"
            )
        self._folder = recordings
        self._runs: list[_Run | None] = [None] * num_episodes
        self._slots: list[dict[int, int]] = [{} for _ in range(num_episodes)]
        """Per episode, the slot of each track."""
        self._histories: dict[int, HiddenHistory] = {}
        """Internal states by the number of the recording."""

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
            self._begin(b, history, _SavedRun(rows=rows, steps=steps, frame=frame))
            self._show_truth(b)

    def _history(self, recording: int) -> HiddenHistory:
        if recording not in self._histories:
            tracks = self._folder.tracks_path(recording)
            history = load_history(path := hidden_path(tracks))
            if not history.fits(self._folder[recording]):
                raise DataError(
                    f"{path} does not describe the vehicles in {tracks}: expected both as they "
                    f"were {WANTED}"
                )
            self._histories[recording] = history
        return self._histories[recording]

    def _begin(self, b: int, history: HiddenHistory, saved: _SavedRun) -> None:
        road = empty_road(history.site, steps=saved.steps)
        road.vehicles = restore(saved.rows, road, history.site.vehicle)
        self._runs[b] = _Run(road=road, frame=saved.frame, history=history)
        tracks = self.episodes.tracks[b]
        self._slots[b] = {int(tracks[a]): a for a in np.flatnonzero(tracks >= 0).tolist()}

    def _show_truth(self, b: int) -> None:
        """Writes the exact history; the recording is rounded, and may be noisy."""
        run, slots, states = self._runs[b], self._slots[b], self.episodes.states[b]
        assert run is not None
        recorded = min(self.history, run.frame // self._stride)
        for back in range(recorded + 1):
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
        states_at = np.stack(
            [self._drive(states, held, lengths, each, rows, acting) for each in times_s]
        )
        poses = mirror_states(states_at.astype(np.float64)).swapaxes(0, 1).tolist()
        commands = mirror_actions(held.astype(np.float64)).tolist()
        at = 0
        for i, b in enumerate(rows.tolist()):
            steered = np.flatnonzero(acting[i]).tolist()
            commanded = {slot: (at + k) for k, slot in enumerate(steered)}
            for slot, number in commanded.items():
                acceleration, steering = commands[number]
                self._vehicle(b, slot).steer(acceleration, steering, poses[number])
            self._advance(b, controlled[i], commanded)
            self._write(b, int(now[i]) + 1, acting[i], states_at[-1, at : at + len(steered)])
            at += len(steered)

    def _vehicle(self, b: int, slot: int) -> TrafficVehicle:
        run, track = self._runs[b], self.episodes.tracks[b, slot]
        assert run is not None
        return next(each for each in run.road.vehicles if each.track == track)

    def _advance(
        self, b: int, controlled: Bool[np.ndarray, " a"], commanded: dict[int, Any]
    ) -> None:
        """Advances the road of one episode by one tick."""
        run, slots, gone = self._runs[b], self._slots[b], self.episodes.departed[b]
        assert run is not None
        road = run.road
        road.vehicles = [each for each in road.vehicles if not gone[slots[each.track]]]
        for vehicle in road.vehicles:
            if slots[vehicle.track] not in commanded:
                vehicle.release()
        for _ in range(self._stride):
            step_road(road)
            run.frame += 1
            if run.frame % STEPS_PER_S == 0:
                remove_exited(run.history.site, road, ego=int(self.episodes.tracks[b, EGO]))
                free = [track for track, a in slots.items() if not (controlled[a] or gone[a])]
                self._add_arrivals(run, free)

    def _add_arrivals(self, run: _Run, tracks: list[int]) -> None:
        """Adds those of some vehicles that are recorded to appear at this frame.

        A vehicle whose position is occupied does not appear.
        """
        arrivals = run.history.coming(run.frame)
        for row in arrivals[np.isin(arrivals["track"], tracks)]:
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
        """Writes the result of a tick of one episode to the arrays."""
        run, slots, data = self._runs[b], self._slots[b], self.episodes
        assert run is not None
        present = data.valid[b, tick]
        present[:] = False
        vehicles = run.road.vehicles
        if vehicles:
            at = [slots[each.track] for each in vehicles]
            native = np.array([(*v.position, v.heading, v.speed) for v in vehicles])
            data.states[b, tick, at] = mirror_states(native)
            present[at] = True
        data.states[b, tick, acting] = moved
        data.states[b, tick, ~present] = 0.0
        data.departed[b] |= data.valid[b, tick - 1] & ~present

    def _saved_runs(self) -> list[_SavedRun | None]:
        return [
            run and _SavedRun(rows=read_vehicles(run.road), steps=run.road.steps, frame=run.frame)
            for run in self._runs
        ]

    def _continue_runs(self, saved: Sequence[_SavedRun | None]) -> None:
        for b, (each, scenario) in enumerate(zip(saved, self.scenarios, strict=True)):
            self._runs[b] = None
            if each is not None:
                assert scenario is not None
                self._begin(b, self._history(scenario.recording), each)

    def snapshot(self) -> Any:
        """The whole state, for `restore`."""
        return super().snapshot(), self._saved_runs()

    def restore(self, snapshot: Any) -> None:
        """Restores a snapshot, bit for bit."""
        arrays, saved = snapshot
        super().restore(arrays)
        self._continue_runs(saved)

    def __getstate__(self) -> dict[str, Any]:
        """The state for copies and pickles: highway-env's objects hold functions and are left out.

        Internal states of recorded vehicles are read from their files again.
        """
        return {**self.__dict__, "_runs": self._saved_runs(), "_histories": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continues from the state of `__getstate__`."""
        saved = state["_runs"]
        vars(self).update(state, _runs=[None] * len(saved))
        self._continue_runs(saved)


def _states_of(rows: Rows) -> Float[np.ndarray, "n 4"]:
    """States (n, 4) of some rows, in the axes of this package."""
    return mirror_states(np.stack([rows[name] for name in ("x", "y", "heading", "speed")], axis=-1))
