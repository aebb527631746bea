"""`asp-env bench`: rates of the hot paths beside memory bandwidth and peers, in one run."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError, unknown_name
from asp_env.evaluation.bench.environments import environments
from asp_env.evaluation.bench.stepping import HISTORY, scaling, stepping
from asp_env.evaluation.bench.timing import (
    REPEATS,
    Latency,
    Rate,
    copy_bandwidth,
    latency_table,
    measure_latencies,
    median_s,
    write_bandwidth,
)
from asp_env.evaluation.selection import no_data_error
from asp_env.views import make_raster_view

SIZES_PX = ((360, 240), (90, 60))
SECTIONS = ("drawing", "stepping", "environments", "scaling")
MANY_EPISODES = (1, 16, 64, 256, 1024, 4096)
MANY_AGENTS = (16, 32, 64, 128, 256)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Measure speeds: pictures, steps and environments beside memory and peers; predictors."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")] = (
        "sample:intersection"
    )
    """DATA to draw and to simulate."""
    episodes: int = 256
    """Episodes that are stepped together."""
    agents: int = 64
    """Vehicles in each episode of a crowd: the traffic of DATA laid over itself."""
    envs: int = 64
    """Environments of a batch."""
    sections: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SECTION …")] = SECTIONS
    """What to measure."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = ()
    """Predictors whose calls are timed for 1, 16 and 64 agents, beside constant velocity."""

    def run(self) -> None:
        """Measures and prints a table for each section, and one of latencies if asked for."""
        for name in ("episodes", "agents", "envs"):
            if getattr(self, name) < 1:
                raise AspEnvError(f"--{name} {getattr(self, name)}: expected at least 1")
        for name in self.sections:
            if name not in SECTIONS:
                raise unknown_name("section", name, SECTIONS)
        console = Console(width=max(Console().width, 120))
        recordings = open_data(self.data)
        latencies: list[Latency] = []
        if self.predictors:
            latencies = measure_latencies(recordings, self.predictors, dt_s=DEFAULT_DT_S)
        copy = copy_bandwidth()
        console.print(
            f"Processor time of one process, medians of {REPEATS}; {os.cpu_count()} cores seen. "
            f"A large memory copy writes {copy / 1e9:.1f} GB/s."
        )
        with console.status("measuring"):
            self._sections(console, recordings, copy)
        if latencies:
            console.print(latency_table(latencies))

    def _sections(self, console: Console, recordings: Recordings, copy: float) -> None:
        write = write_bandwidth() if {"drawing", "environments"} & set(self.sections) else copy
        if "drawing" in self.sections:
            console.print(rates_table("drawing", _drawing(recordings, write), copy))
        if "stepping" in self.sections:
            scenarios = _scenarios(recordings, self.data, self.episodes)
            rates = stepping(recordings, scenarios, agents=self.agents, dt_s=DEFAULT_DT_S)
            console.print(rates_table("stepping, contacts and off-road included", rates, copy))
        if "environments" in self.sections:
            rates = environments(self.data, num_envs=self.envs, write_bytes_per_s=write)
            console.print(rates_table("environments, resets included", rates, copy))
        if "scaling" in self.sections:
            found = scaling(
                recordings[0], episodes=MANY_EPISODES, agents=MANY_AGENTS, dt_s=DEFAULT_DT_S
            )
            console.print(scaling_table(found))


def rates_table(title: str, rates: Sequence[Rate], copy_bytes_per_s: float) -> Table:
    """Rates with their share of copying speed, and their ratio to the same thing done otherwise."""
    table = Table(title=title)
    for heading in ("what", "rate", "bytes written, of a copy", "ratio"):
        what = heading == "what"
        table.add_column(heading, justify="left" if what else "right", no_wrap=what)
    for rate in rates:
        share = rate.per_s * rate.bytes_each / copy_bytes_per_s
        ratio = "" if rate.beside is None else f"{rate.per_s / rate.beside:.3g} x"
        table.add_row(
            rate.what,
            f"{rate.per_s:,.0f} {rate.unit}",
            f"{share:.3f}" if rate.bytes_each else "",
            f"{ratio} {rate.beside_what}".strip(),
        )
    return table


def scaling_table(found: Sequence[tuple[int, int, float]]) -> Table:
    """Rates by number of episodes and of agents; linear where time per agent stays the same."""
    table = Table(title="log-actions by size, contacts and off-road included")
    for heading in ("episodes", "agents", "episode-steps/s", "ns per agent and step"):
        table.add_column(heading, justify="right")
    for episodes, agents, per_s in found:
        table.add_row(f"{episodes:,}", str(agents), f"{per_s:,.0f}", f"{1e9 / per_s / agents:.0f}")
    return table


def _drawing(recordings: Recordings, write_bytes_per_s: float) -> list[Rate]:
    index = index_snippets(recordings, dt_s=DEFAULT_DT_S, horizon_s=3.0)
    if not len(index):
        raise no_data_error("snippet")
    chosen = np.linspace(0, len(index) - 1, min(256, len(index))).astype(int)
    scene = gather_scene(recordings, index.select(chosen))
    found = []
    for height_px, width_px in SIZES_PX:
        view = make_raster_view("chauffeurnet", pixels=(height_px, width_px))
        out = np.zeros((len(chosen), *view.shape), dtype=np.uint8)
        per_s = len(chosen) / median_s(lambda view=view, out=out: view.render(scene, out))
        found.append(
            Rate(
                what=f"raster 12x{height_px}x{width_px}",
                per_s=per_s,
                unit="/s",
                bytes_each=out[0].nbytes,
                beside=write_bytes_per_s / out[0].nbytes,
                beside_what="only writing",
            )
        )
    return found


def _scenarios(recordings: Recordings, source: str, count: int) -> list[Scenario]:
    found = find_scenarios(recordings, source=source, dt_s=DEFAULT_DT_S, history=HISTORY)
    if not len(found):
        raise no_data_error("scenario")
    return [found[i % len(found)] for i in range(count)]
