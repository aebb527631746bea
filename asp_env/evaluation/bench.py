"""`asp-env bench`: rates of the hot paths beside memory bandwidth, and latencies, in one run."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from asp_env.data.scenario import Scenario, find_scenarios
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation.latency import Latency, latency_table, measure_latencies
from asp_env.evaluation.unseen import nothing_left
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic import make_traffic
from asp_env.views import make_picture_view

DT_S = 0.2
HISTORY = 15
REPEATS = 5
SIZES_PX = ((360, 240), (90, 60))
TRAFFICS = ("log", "log-actions", "idm", "hybrid", "predictor:constant-velocity")
COPY_BYTES = 256 * 2**20
STATE_BYTES = 4 * np.dtype(np.float32).itemsize


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Measure speeds: rasters and simulated steps beside memory bandwidth, and predictors."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")] = (
        "sample:intersection"
    )
    """DATA to draw and to simulate."""
    episodes: int = 256
    """Episodes that are stepped together."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = ()
    """Predictors whose calls are timed for 1, 16 and 64 agents, beside constant velocity."""

    def run(self) -> None:
        """Measures and prints a table, and one of latencies where predictors are named."""
        if self.episodes < 1:
            raise AspEnvError(f"--episodes {self.episodes}: expected at least 1")
        recordings = open_data(self.data)
        latencies: list[Latency] = []
        if self.predictors:
            latencies = measure_latencies(recordings, self.predictors, dt_s=DT_S)
        table = Table(title=f"medians of {REPEATS}, {os.cpu_count()} cores seen, one used")
        for heading in ("what", "rate", "bytes written", "share of copy bandwidth"):
            table.add_column(heading, justify="left" if heading == "what" else "right")
        copy = _copy_bandwidth()
        table.add_row("memory copy (bytes written)", f"{copy / 1e9:.1f} GB/s", "", "1.00")
        for height_px, width_px in SIZES_PX:
            per_s, size = _rasters(recordings, height_px, width_px)
            table.add_row(
                f"raster 12x{height_px}x{width_px}",
                f"{per_s:,.0f} /s",
                f"{per_s * size / 1e9:.2f} GB/s",
                f"{per_s * size / copy:.2f}",
            )
        scenarios = _scenarios(recordings, self.data, self.episodes)
        for traffic in TRAFFICS:
            per_s, resets_per_s, size = _steps(recordings, scenarios, traffic)
            name = f"{self.episodes} episodes, {size // STATE_BYTES} slots, {traffic}"
            table.add_row(
                f"{name}, step and events",
                f"{per_s:,.0f} episode-steps/s",
                f"{per_s * size / 1e9:.2f} GB/s",
                f"{per_s * size / copy:.3f}",
            )
            table.add_row(f"{name}, reset", f"{resets_per_s:,.0f} episodes/s")
        console = Console(width=max(Console().width, 110))
        console.print(table)
        if latencies:
            console.print(latency_table(latencies))


def median_s(work: Callable[[], object], prepare: Callable[[], object] = lambda: None) -> float:
    """Median duration of several calls after one that is not counted; preparing is not timed."""
    durations = []
    for _ in range(1 + REPEATS):
        prepare()
        start = perf_counter()
        work()
        durations.append(perf_counter() - start)
    return float(np.median(durations[1:]))


def _copy_bandwidth() -> float:
    source, target = np.ones(COPY_BYTES, dtype=np.uint8), np.zeros(COPY_BYTES, dtype=np.uint8)
    return COPY_BYTES / median_s(lambda: np.copyto(target, source))


def _rasters(recordings: Recordings, height_px: int, width_px: int) -> tuple[float, int]:
    index = index_snippets(recordings, dt_s=DT_S, horizon_s=3.0)
    if not len(index):
        raise nothing_left("snippet")
    chosen = np.linspace(0, len(index) - 1, min(256, len(index))).astype(int)
    scene = gather_scene(recordings, index.select(chosen))
    view = make_picture_view("chauffeurnet", pixels=(height_px, width_px))
    out = np.zeros((len(chosen), *view.shape), dtype=np.uint8)
    return len(chosen) / median_s(lambda: view.draw(scene, out)), out[0].nbytes


def _scenarios(recordings: Recordings, source: str, count: int) -> list[Scenario]:
    found = find_scenarios(recordings, source=source, dt_s=DT_S, history=HISTORY)
    if not len(found):
        raise nothing_left("scenario")
    return [found[i % len(found)] for i in range(count)]


def _steps(
    recordings: Recordings, scenarios: list[Scenario], traffic: str
) -> tuple[float, float, int]:
    """Episode-steps and resets per second, and the bytes of one tick's states of an episode."""
    simulation = Simulation(
        recordings, make_traffic(traffic), num_episodes=len(scenarios), dt_s=DT_S, history=HISTORY
    )
    generators = [np.random.default_rng(0)] * len(scenarios)
    reset_s = median_s(lambda: simulation.reset(scenarios, generators))
    start = simulation.snapshot()
    actions = np.zeros((len(scenarios), 2), dtype=np.float32)
    driven = np.ones(len(scenarios), dtype=bool)
    steps = min(scenario.length for scenario in scenarios)

    def drive() -> None:
        for _ in range(steps):
            simulation.step(actions, driven)
            simulation.world.events()

    step_s = median_s(drive, prepare=lambda: simulation.restore(start))
    size = simulation.world.episodes.ids.shape[1] * STATE_BYTES
    return steps * len(scenarios) / step_s, len(scenarios) / reset_s, size
