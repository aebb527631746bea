"""`asp-env doctor`: what is installed, which extra is missing for what, caches, GPU, and data."""

import importlib.util
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from asp_env.console import table_console
from asp_env.installation.caches import CacheState, CompiledState, cache_state, compiled_state
from asp_env.installation.found_data import FolderFindings, examine
from asp_env.installation.packages import (
    ExtraState,
    PackageState,
    PlugState,
    extra_states,
    plugs_of_other_packages,
    python_problem,
    required_packages,
)
from asp_env.installation.version import version_line

WITH_PROBLEMS = 1
"""Exit status with problems."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """Everything that `asp-env doctor` reports."""

    version: str
    required: tuple[PackageState, ...]
    extras: tuple[ExtraState, ...]
    plugs: tuple[PlugState, ...]
    """Plugs of other packages."""
    cache: CacheState
    compiled: CompiledState
    gpu: str
    data: tuple[FolderFindings, ...]
    problems: tuple[str, ...]
    """What has to be mended, one line each; empty if everything that is installed can be used."""


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check the installation: packages, extras, caches, GPU, and the data in folders.

    The exit status is 0 without problems, 1 with problems, and 2 if a folder does not exist. A
    missing extra is no problem.
    """

    folders: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER …]")
    ] = ()
    """Folders that every reader searches for recordings.
    All recordings are read, once: later commands find them in the cache."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        """Prints the diagnosis.

        Returns:
            The exit status.

        Raises:
            AspEnvError: a folder does not exist.
        """
        console = table_console()
        diagnosis = diagnose(self.folders, console)
        if self.json:
            content = json.dumps(asdict(diagnosis), indent=2, default=str)
            console.file.write(f"{content}\n")
        else:
            _show(diagnosis, console)
        return WITH_PROBLEMS if diagnosis.problems else 0


def diagnose(folders: Sequence[str], console: Console) -> Diagnosis:
    """Examines the installation and some folders.

    Args:
        folders: the folders, or other DATA.
        console: a terminal shows the recording that is being read.

    Raises:
        AspEnvError: a folder does not exist.
    """
    required, plugs = required_packages(), plugs_of_other_packages()
    gpu, gpu_problem = _gpu()
    with console.status("reading", spinner="line") as status:
        if not console.is_terminal:
            status.stop()
        data = tuple(
            examine(folder, progress=lambda name: status.update(f"reading {escape(name)}"))
            for folder in folders
        )
    cache, compiled = cache_state(), compiled_state()
    extras = extra_states()
    old = {str(each) for extra in extras for each in extra.packages if each.version}
    fit = {str(each) for extra in extras for each in extra.packages if each.fits}
    problems = [
        python_problem(),
        *(f"{each}: pip install --upgrade asp-env" for each in required if not each.fits),
        *(f"{each}: pip install --upgrade {each.split()[0]}" for each in sorted(old - fit)),
        *(each.problem for each in plugs),
        cache.problem,
        compiled.problem,
        gpu_problem,
        *(problem for each in data for problem in each.problems),
    ]
    return Diagnosis(
        version=version_line(),
        required=required,
        extras=extras,
        plugs=plugs,
        cache=cache,
        compiled=compiled,
        gpu=gpu,
        data=data,
        problems=tuple(problem for problem in problems if problem),
    )


def _gpu() -> tuple[str, str | None]:
    """The GPUs that torch can use, and a problem; torch is imported only if it is installed."""
    if importlib.util.find_spec("torch") is None:
        return "torch is not installed", None
    try:
        import torch
    except Exception as error:  # a library of its binary packages is missing
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return "torch cannot be imported", f"torch cannot be imported ({reason}): reinstall torch"
    if torch.cuda.is_available():
        count = torch.cuda.device_count()
        names = ", ".join(torch.cuda.get_device_name(number) for number in range(count))
        return f"{count} by CUDA {torch.version.cuda}: {names}", None
    built_for = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for CPUs"
    return f"none: torch {torch.__version__} ({built_for}) uses the CPU", None


def _show(diagnosis: Diagnosis, console: Console) -> None:
    def line(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    line(diagnosis.version)
    line(f"required: {', '.join(map(str, diagnosis.required))}")
    console.print(_extra_table(diagnosis.extras))
    if diagnosis.plugs:
        console.print(_plug_table(diagnosis.plugs))
    cache, compiled = diagnosis.cache, diagnosis.compiled
    free = "" if cache.free_bytes is None else f", {cache.free_bytes / 1e9:.1f} GB free"
    line(
        f"cache: {cache.folder} (by {cache.named_by}), {cache.num_files} files, "
        f"{cache.num_bytes / 1e6:.1f} MB{free}"
    )
    line(_compiled_line(compiled))
    line(f"GPU: {diagnosis.gpu}")
    for each in diagnosis.data:
        line("")
        console.print(_data_table(each))
    line("")
    for problem in diagnosis.problems:
        line(f"problem: {problem}")
    count = len(diagnosis.problems)
    line("fit for use" if not count else f"{count} problem{'s' if count > 1 else ''}")


def _compiled_line(compiled: CompiledState) -> str:
    if compiled.folder is None:
        return "compiled functions: not stored"
    state = f"{compiled.num_functions} functions, {compiled.num_bytes / 1e6:.1f} MB"
    if not compiled.num_functions:
        state = "none yet: the first use of each function compiles it, half a minute in all"
    return f"compiled functions: {compiled.folder}, {state}"


def _extra_table(extras: Sequence[ExtraState]) -> Table:
    table = Table("extra", "packages", "needed for", title="Extras", title_justify="left")
    table.columns[1].overflow = table.columns[2].overflow = "fold"
    for extra in extras:
        packages = ", ".join(map(str, extra.packages))
        if not extra.complete:
            packages += f": pip install 'asp-env[{extra.name}]'"
        table.add_row(extra.name, packages, extra.purpose)
    return table


def _plug_table(plugs: Sequence[PlugState]) -> Table:
    table = Table("package", "group", "name", "", title="Plugs of other packages")
    table.title_justify = "left"
    for plug in plugs:
        state = "ok" if plug.problem is None else "see the problems"
        table.add_row(plug.package, plug.group, plug.name, state)
    return table


def _data_table(findings: FolderFindings) -> Table:
    names = ("reader", "recordings", "readable", "tracks", "duration s", "repairs")
    table = Table(
        title=f"Data in {findings.data}",
        title_justify="left",
        caption="repairs: lines under Repairs in asp-env inspect",
        caption_justify="left",
    )
    for name in names:
        table.add_column(name, justify="left" if name == "reader" else "right")
    for each in findings.readers:
        counts = (each.num_found, each.num_readable, each.num_tracks)
        table.add_row(
            each.reader, *map(str, counts), f"{each.duration_s:.1f}", str(each.num_repairs)
        )
    return table
