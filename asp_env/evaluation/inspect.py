"""`asp-env inspect`: the contents of DATA, the drift of inferred actions, and all faults."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asp_env.console import table_console
from asp_env.data.classes import AgentClass
from asp_env.data.recording import DEFAULT_DT_S, Recording, frames_per_tick, ticks
from asp_env.data.road_map import RoadMap
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.scenarios.tags import COLUMNS, TAGS
from asp_env.data.snippets import HISTORY_S, SNIPPET_INTERVAL_S, find_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.dynamics import inverse, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError, DataError, RepairWarning
from asp_env.metrics.drivable import drivable_field
from asp_env.metrics.forecast.errors import moving

HORIZONS_S = (3.0, 6.0)
"""Horizons of the counted snippets and of the drift."""
PERCENTILES = (50, 90, 99)
"""Percentiles of the drift."""
CHUNK = 10_000
"""Number of snippets that are rolled out at once, which bounds the memory."""


def drift_m(
    recording: Recording,
    tracks: Int[np.ndarray, " n"],
    ticks: Int[np.ndarray, " n"],
    *,
    dt_s: float,
    horizon: int,
    integrator: Integrator = "heun",
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Drift of inferred actions: distance between a track and the rollout of its own actions.

    The actions are inferred from the recorded headings and speeds by the inverse bicycle model and
    rolled out from the recorded state at the given tick. The drift is the distance of the positions
    at the end: the error of a forecast of exactly these actions. It is no bound for predictors that
    are trained on positions, as the networks are, since other actions may lead nearer.

    Args:
        recording: the recording.
        tracks: indices of the tracks.
        ticks: tick of each track from which its actions are rolled out; the track must last for
            `horizon` more ticks.
        dt_s: duration of a tick in seconds.
        horizon: number of ticks.
        integrator: method of the inverse model and of the rollout.

    Returns:
        The drift of each track in metres, and a mask of the tracks that move: over 1 m/s at the
        start, or over 2 m away from there at any later tick.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    metres, moves = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for start in range(0, len(tracks), CHUNK):
        chunk = slice(start, start + CHUNK)
        track = tracks[chunk]
        begin = recording.starts[track] - recording.first_frames[track] + ticks[chunk] * stride
        rows = begin[:, None] + np.arange(horizon + 1) * stride
        states = recording.states[rows].astype(np.float64)
        lengths_m = recording.sizes[track, 0].astype(np.float64)
        known = np.ones(rows.shape, dtype=bool)
        actions = inverse(
            states[:, :-1], states[:, 1:], lengths_m[:, None], dt_s, integrator=integrator
        )
        rolled_out = rollout(
            states[:, 0], actions, lengths_m, dt_s, integrator=integrator, reverse=True
        )
        metres.append(np.hypot(*(rolled_out[:, -1, :2] - states[:, -1, :2]).T))
        moves.append(moving(states[:, 0], states[:, 1:, :2], known[:, 1:]))
    return np.concatenate(metres), np.concatenate(moves)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drifts:
    """Drift of all snippets of a recording, by horizon in seconds."""

    metres: Mapping[float, Float[np.ndarray, " _"]]
    """By Heun's method."""
    euler_metres: Mapping[float, Float[np.ndarray, " _"]]
    """By Euler's method, the paper's."""
    moving: Mapping[float, Bool[np.ndarray, " _"]]
    """Mask of the snippets whose target moves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSummary:
    """What the tables show of one recording."""

    recording: Recording
    on_road: float
    """Share of the vehicles' positions inside the drivable area; NaN without vehicles."""
    drifts: Drifts
    scenarios: ScenarioSet


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Show the recordings, maps, snippets, scenarios and faults of DATA."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds. Recordings of which it is no
    whole number of frames are resampled."""

    def run(self) -> None:
        """Prints the tables; with faults, those of the recordings that can be read.

        Raises:
            AspEnvError: the data do not exist, some recordings cannot be read, or a tick is
                shorter than a frame.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RepairWarning)  # repairs are listed
            recordings = open_data(self.data, dt_s=self.dt)
        console = table_console()
        summaries, faults = self.examine(recordings, console)
        if summaries:
            console.print(_recording_table(self.data, summaries))
            console.print(_map_table(_maps(summaries)))
            console.print(_drift_table(summaries, self.dt))
            console.print(_scenario_table(summaries))
        self.show_notes(recordings.repairs, summaries, faults, console)
        if faults:
            raise DataError(_summary(recordings, faults))

    def show_notes(
        self,
        copies: Sequence[str],
        summaries: Sequence[RecordingSummary],
        faults: Mapping[str, str],
        console: Console,
    ) -> None:
        """Prints the repairs and the faults, below the tables.

        Args:
            copies: lines about recordings that are left out, since they are in `data` twice.
            summaries: the recordings that can be read.
            faults: why the others cannot, by name.
            console: prints the lines.
        """
        if summaries or copies:
            lines = [*copies, *_repairs(summaries, _maps(summaries))]
            _print_lines(console, "Repairs", lines)
        _print_lines(console, "Faults", list(faults.values()))

    def examine(
        self, recordings: Recordings, console: Console
    ) -> tuple[list[RecordingSummary], dict[str, str]]:
        """Reads the recordings and computes what the tables show.

        Args:
            recordings: the recordings of `data`.
            console: a terminal shows the progress.

        Returns:
            The recordings that can be read, and why the others cannot, by name.

        Raises:
            AspEnvError: a tick of the only recording is shorter than a frame.
        """
        opened: list[Recording] = []
        faults: dict[str, str] = {}
        numbers = track(
            range(len(recordings)),
            description="Reading",
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        for number in numbers:
            name = recordings.names[number]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RepairWarning)  # repairs are listed
                    recording = recordings[number]
            except DataError as error:
                faults[name] = str(error)
                continue
            except AspEnvError as error:  # its frames are too far apart for the tick
                if len(recordings) == 1:
                    raise
                faults[name] = f"recording {name}: {error}"
                continue
            opened.append(recording)
        scenarios = find_scenarios(
            opened, source=self.data, dt_s=self.dt, history=ticks(HISTORY_S, self.dt)
        )
        summaries = [
            RecordingSummary(
                recording=recording,
                on_road=_on_road(recording),
                drifts=_drifts(recording, self.dt),
                scenarios=scenarios.select(scenarios.recording == number),
            )
            for number, recording in enumerate(opened)
        ]
        return summaries, faults


def _maps(summaries: Sequence[RecordingSummary]) -> list[RoadMap]:
    """The maps, each once."""
    maps = {id(each.recording.road_map): each.recording.road_map for each in summaries}
    return list(maps.values())


def _drifts(recording: Recording, dt_s: float) -> Drifts:
    metres, euler_metres, moves = {}, {}, {}
    for horizon_s in HORIZONS_S:
        horizon = ticks(horizon_s, dt_s)
        index = find_snippets(
            recording,
            dt_s=dt_s,
            history=ticks(HISTORY_S, dt_s),
            horizon_ticks=horizon,
            interval_ticks=ticks(SNIPPET_INTERVAL_S, dt_s),
        )
        metres[horizon_s], moves[horizon_s] = drift_m(recording, *index, dt_s=dt_s, horizon=horizon)
        euler_metres[horizon_s], _ = drift_m(
            recording, *index, dt_s=dt_s, horizon=horizon, integrator="euler"
        )
    return Drifts(metres=metres, euler_metres=euler_metres, moving=moves)


def _on_road(recording: Recording) -> float:
    vehicles = np.flatnonzero(recording.predicted)
    if not len(vehicles):
        return float("nan")
    points = np.concatenate([recording.track(int(i))[::5, :2] for i in vehicles])
    field = drivable_field(recording.road_map)
    return float((field.distance_m(points) <= 0).mean())


def _recording_table(data: str, summaries: Sequence[RecordingSummary]) -> Table:
    table = Table(
        title=f"Recordings of {data}",
        title_justify="left",
        caption="3+3 s, 3+6 s: snippets with a history of 3 s and a horizon of 3 s or 6 s; Hz in "
        "parentheses: of the files, where resampled",
        caption_justify="left",
    )
    for name in ("name", "location"):
        table.add_column(name)
    table.add_column("start")
    for name in ("Hz", "duration s", "rows", "tracks"):
        table.add_column(name, justify="right")
    table.add_column("classes", overflow="fold")
    for name in ("parked", "on road %", "3+3 s", "3+6 s"):
        table.add_column(name, justify="right")
    table.add_column("image")
    for each in summaries:
        recording = each.recording
        table.add_row(
            recording.name,
            recording.location,
            _start(recording),
            _rate(recording),
            f"{recording.duration_s:.1f}",
            f"{len(recording.states):,}",
            str(len(recording)),
            _class_counts(recording),
            str(int(recording.parked.sum())),
            "-" if np.isnan(each.on_road) else f"{100 * each.on_road:.0f}",
            *(f"{len(each.drifts.metres[horizon_s]):,}" for horizon_s in HORIZONS_S),
            "yes" if recording.background else "no",
        )
    if len(summaries) > 1:
        table.add_section()
        sums = [
            sum(len(each.drifts.metres[horizon_s]) for each in summaries)
            for horizon_s in HORIZONS_S
        ]
        table.add_row(
            f"all {len(summaries)}",
            "",
            "",
            "",
            f"{sum(each.recording.duration_s for each in summaries):.1f}",
            f"{sum(len(each.recording.states) for each in summaries):,}",
            str(sum(len(each.recording) for each in summaries)),
            "",
            str(sum(int(each.recording.parked.sum()) for each in summaries)),
            "",
            *(f"{count:,}" for count in sums),
            "",
        )
    return table


def _rate(recording: Recording) -> str:
    """Frames per second, with those of the files in parentheses where it is resampled."""
    measured_hz = recording.resampled_from_hz
    of_files = "" if measured_hz is None else f" ({measured_hz:g})"
    return f"{recording.frame_rate_hz:g}{of_files}"


def _start(recording: Recording) -> str:
    """Day and time of day at which the recording starts, as far as the files give them."""
    parts = [] if recording.weekday is None else [recording.weekday]
    if recording.start_hour is not None:
        minutes = round(60 * recording.start_hour)
        parts.append(f"{minutes // 60}:{minutes % 60:02d}")
    return " ".join(parts) or "-"


def _class_counts(recording: Recording) -> str:
    counts = np.bincount(recording.classes, minlength=len(AgentClass))
    return ", ".join(f"{counts[kind]} {kind.name.lower()}" for kind in AgentClass if counts[kind])


def _map_table(maps: Sequence[RoadMap]) -> Table:
    table = Table(title="Maps", title_justify="left")
    table.add_column("name")
    for name in ("lanes", "successors", "lines", "drivable m²", "repairs"):
        table.add_column(name, justify="right")
    for road_map in maps:
        area_m2 = drivable_field(road_map).drivable_m2()
        table.add_row(
            road_map.name,
            str(len(road_map.lanes)),
            str(len(road_map.successors)),
            str(len(road_map.lines)),
            f"{area_m2:,.0f}",
            str(len(road_map.repairs)),
        )
    return table


def _drift_table(summaries: Sequence[RecordingSummary], dt_s: float) -> Table:
    table = Table(
        title=f"Drift of inferred actions ({dt_s:g} s) in metres: median / 90 % / 99 %",
        title_justify="left",
        caption="distance between tracks and the rollout of the actions inferred from them; no "
        "bound for networks, which are trained on positions",
        caption_justify="left",
    )
    table.add_column("name")
    table.add_column("method")
    for horizon_s in HORIZONS_S:
        for name in (f"n {horizon_s:g} s", "all", "n moving", "moving"):
            table.add_column(name, justify="right")
    with_snippets = [each for each in summaries if len(each.drifts.metres[HORIZONS_S[0]])]
    for each in with_snippets:
        _add_drift_rows(table, each.recording.name, [each.drifts])
    if len(with_snippets) != 1:
        table.add_section()
        _add_drift_rows(table, "all", [each.drifts for each in summaries])
    return table


def _add_drift_rows(table: Table, name: str, drifts: list[Drifts]) -> None:
    table.add_row(name, "Heun", *_drift_cells(drifts, "metres"))
    table.add_row("", "Euler", *_drift_cells(drifts, "euler_metres"))


def _drift_cells(drifts: list[Drifts], method: Literal["metres", "euler_metres"]) -> list[str]:
    cells = []
    for horizon_s in HORIZONS_S:
        metres = np.concatenate([getattr(each, method)[horizon_s] for each in drifts])
        moves = np.concatenate([each.moving[horizon_s] for each in drifts])
        for values in (metres, metres[moves]):
            cells += [f"{len(values):,}", _percentiles(values)]
    return cells


def _scenario_table(summaries: Sequence[RecordingSummary]) -> Table:
    table = Table(title="Scenarios by tag, with medians of their measures", title_justify="left")
    for name in ("tag", "n", *COLUMNS):
        table.add_column(name, justify="left" if name == "tag" else "right")
    values = np.concatenate([each.scenarios.values for each in summaries])
    tags = np.concatenate([each.scenarios.tags for each in summaries])
    rows = {"all": np.ones(len(tags), dtype=bool)} | dict(zip(TAGS, tags.T, strict=True))
    for tag, member in rows.items():
        medians = np.median(values[member], axis=0).tolist() if member.any() else []
        cells = [f"{value:.1f}" for value in medians] or ["-"] * len(COLUMNS)
        table.add_row(tag, f"{int(member.sum()):,}", *cells)
    return table


def _percentiles(metres: Float[np.ndarray, " n"]) -> str:
    if not len(metres):
        return "-"
    return " / ".join(f"{value:.2f}" for value in np.percentile(metres, PERCENTILES))


def _repairs(summaries: Sequence[RecordingSummary], maps: Sequence[RoadMap]) -> list[str]:
    of_maps = [f"map {road_map.name}: {line}" for road_map in maps for line in road_map.repairs]
    return of_maps + [
        f"recording {each.recording.name}: {line}"
        for each in summaries
        for line in each.recording.repairs
    ]


def _print_lines(console: Console, title: str, lines: list[str]) -> None:
    console.print(f"{title}: {len(lines) or 'none'}", highlight=False)
    for line in lines:
        console.print(f"  {line}", soft_wrap=True, highlight=False)


def _summary(recordings: Recordings, faults: Mapping[str, str]) -> str:
    if len(faults) == 1:
        return next(iter(faults.values()))
    return (
        f"data {recordings.source!r}: {len(faults)} of {len(recordings)} recordings cannot be "
        f"read ({', '.join(faults)}); repair or remove the files named above"
    )
