"""`asp-env bench`: rates of the main operations beside memory bandwidth and reference rates."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from asp_env.console import text_console
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError, unknown_name
from asp_env.evaluation.bench.environments import environment_rates
from asp_env.evaluation.bench.stepping import HISTORY, scaling_rates, stepping_rates
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

RASTER_SIZES_PX = ((360, 240), (90, 60))
SECTIONS = ("rasters", "stepping", "environments", "scaling")
RENAMED_SECTIONS = {"drawing": "rasters"}
"""Old names of sections. They work for one more release, with a warning."""
MOST = {"episodes": 65_536, "agents": 1_024, "envs": 65_536}
"""Largest numbers, chosen by hand: more than that is not faster, and needs tens of gigabytes."""
SCALING_EPISODES = (1, 16, 64, 256, 1024, 4096)
SCALING_AGENTS = (16, 32, 64, 128, 256)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Measure the speed of rasters, simulation, environments and predictors."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")] = (
        "sample:intersection"
    )
    """Recordings to rasterize and to simulate, named as for asp-env drive."""
    episodes: int = 256
    """Number of episodes that are simulated together."""
    agents: int = 64
    """Number of vehicles in each episode with dense traffic, which overlays the tracks of DATA."""
    envs: int = 64
    """Number of environments in a batch."""
    sections: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SECTION …")] = SECTIONS
    """Sections of the benchmark to run."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = ()
    """Predictors whose latency is measured for 1, 16 and 64 agents, beside constant velocity."""

    def run(self) -> None:
        """Measures the sections and the latencies and prints a table for each."""
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise AspEnvError(f"--{name} {getattr(self, name)}: expected 1 to {most:,}")
        if not self.sections and not self.predictors:
            raise AspEnvError(f"--sections: none given; expected some of {', '.join(SECTIONS)}")
        sections = [_current_section(name) for name in self.sections]
        console = text_console(width=max(text_console().width, 120))
        recordings = open_readable(self.data, dt_s=DEFAULT_DT_S)
        latencies: list[Latency] = []
        if self.predictors:
            latencies = measure_latencies(recordings, self.predictors, dt_s=DEFAULT_DT_S)
        copy = copy_bandwidth()
        console.print(
            f"Processor time of one process, medians of {REPEATS}; {os.cpu_count()} cores. "
            f"A large memory copy writes {copy / 1e9:.1f} GB/s."
        )
        with console.status("measuring"):
            self._print_sections(console, sections, recordings, copy)
        if latencies:
            console.print(latency_table(latencies))

    def _print_sections(
        self, console: Console, sections: Sequence[str], recordings: Recordings, copy: float
    ) -> None:
        write = write_bandwidth() if {"rasters", "environments"} & set(sections) else copy
        if "rasters" in sections:
            console.print(rates_table("rasters", _raster_rates(recordings, write), copy))
        if "stepping" in sections:
            scenarios = _scenarios(recordings, self.data, self.episodes)
            rates = stepping_rates(recordings, scenarios, agents=self.agents, dt_s=DEFAULT_DT_S)
            title = "simulation, contacts and off-road events included"
            console.print(rates_table(title, rates, copy))
        if "environments" in sections:
            rates = environment_rates(self.data, num_envs=self.envs, write_bytes_per_s=write)
            console.print(rates_table("environments, resets included", rates, copy))
        if "scaling" in sections:
            rates = scaling_rates(
                recordings[0], episodes=SCALING_EPISODES, agents=SCALING_AGENTS, dt_s=DEFAULT_DT_S
            )
            console.print(scaling_table(rates))


def _current_section(name: str) -> str:
    """A section by its current or its old name.

    Raises:
        AspEnvError: There is no such section.
    """
    if name in RENAMED_SECTIONS:
        current = RENAMED_SECTIONS[name]
        sys.stderr.write(f"asp-env: section {name} is deprecated; use {current}\n")
        return current
    if name not in SECTIONS:
        raise unknown_name("section", name, SECTIONS)
    return name


def rates_table(title: str, rates: Sequence[Rate], copy_bytes_per_s: float) -> Table:
    """Rates as a table for the terminal.

    Args:
        title: Title of the table.
        rates: The rows.
        copy_bytes_per_s: Bandwidth of a memory copy, which written bytes are compared with.
    """
    table = Table(title=title)
    for heading in ("name", "rate", "bytes written / copy", "ratio"):
        is_name = heading == "name"
        table.add_column(heading, justify="left" if is_name else "right", no_wrap=is_name)
    for rate in rates:
        share = rate.per_s * rate.bytes_each / copy_bytes_per_s
        reference = rate.reference_per_s
        ratio = "" if reference is None else f"{rate.per_s / reference:.3g} x"
        table.add_row(
            rate.name,
            f"{rate.per_s:,.0f} {rate.unit}",
            f"{share:.3f}" if rate.bytes_each else "",
            f"{ratio} {rate.reference}".strip(),
        )
    return table


def scaling_table(rates: Sequence[tuple[int, int, float]]) -> Table:
    """Rates by number of episodes and agents as a table for the terminal.

    The cost is linear where the time per agent and step is constant.
    """
    table = Table(title="log-actions by size, contacts and off-road events included")
    for heading in ("episodes", "agents", "episode-steps/s", "ns per agent and step"):
        table.add_column(heading, justify="right")
    for episodes, agents, per_s in rates:
        table.add_row(f"{episodes:,}", str(agents), f"{per_s:,.0f}", f"{1e9 / per_s / agents:.0f}")
    return table


def _raster_rates(recordings: Recordings, write_bytes_per_s: float) -> list[Rate]:
    index = index_snippets(recordings, dt_s=DEFAULT_DT_S, horizon_s=3.0)
    if not len(index):
        raise no_data_error("snippet")
    chosen = np.linspace(0, len(index) - 1, min(256, len(index))).astype(int)
    scene = gather_scene(recordings, index.select(chosen))
    rates = []
    for height_px, width_px in RASTER_SIZES_PX:
        view = make_raster_view("chauffeurnet", pixels=(height_px, width_px))
        out = np.zeros((len(chosen), *view.shape), dtype=np.uint8)
        per_s = len(chosen) / median_s(lambda view=view, out=out: view.render(scene, out))
        rates.append(
            Rate(
                name=f"raster 12x{height_px}x{width_px}",
                per_s=per_s,
                unit="/s",
                bytes_each=out[0].nbytes,
                reference_per_s=write_bytes_per_s / out[0].nbytes,
                reference="write bandwidth",
            )
        )
    return rates


def _scenarios(recordings: Recordings, source: str, count: int) -> list[Scenario]:
    """The scenarios of DATA, repeated until there are `count`."""
    scenarios = find_scenarios(recordings, source=source, dt_s=DEFAULT_DT_S, history=HISTORY)
    if not len(scenarios):
        raise no_data_error("scenario")
    return [scenarios[i % len(scenarios)] for i in range(count)]
