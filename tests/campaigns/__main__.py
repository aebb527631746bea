"""`python -m tests.campaigns` (`make campaign`): all formats, in processes of their own.

Prints a table of formats by outcome, and each fault once. The exit status is 1 if there is one.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tests.campaigns.campaign import Verdict, run_mutants
from tests.campaigns.formats import FORMATS

MUTANTS = 5_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The command line."""

    formats: Sequence[str]
    mutants: int
    first: int
    seed: int
    jobs: int
    inside: bool
    """Whether this process makes the mutants itself and writes a line of JSON for each."""

    @classmethod
    def parse(cls) -> "Options":
        """Reads the command line."""
        names = list(FORMATS)
        parser = argparse.ArgumentParser(prog="python -m tests.campaigns", description=__doc__)
        parser.add_argument("--formats", nargs="*", default=names, choices=names)
        parser.add_argument("--mutants", type=int, default=MUTANTS, help="of each format")
        parser.add_argument("--first", type=int, default=0, help="number of the first one")
        parser.add_argument("--seed", type=int, default=0)
        parser.add_argument("--jobs", type=int, default=2)
        parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
        return cls(**vars(parser.parse_args()))


def main() -> int:
    """Runs the formats and prints the table."""
    options = Options.parse()
    if options.inside:
        return run_inside(options)
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("mutants", total=len(options.formats) * options.mutants)
        with ThreadPoolExecutor(options.jobs) as pool:
            found = list(
                pool.map(
                    lambda name: run_outside(name, options, lambda: bar.advance(task)),
                    options.formats,
                )
            )
    by_format = dict(zip(options.formats, found, strict=True))
    sys.stdout.writelines(f"{line}\n" for line in report(by_format))
    return int(any(verdict.is_fault for verdicts in found for verdict in verdicts))


def run_inside(options: Options) -> int:
    """Runs one format in this process."""
    (name,) = options.formats
    mutants = range(options.first, options.first + options.mutants)
    with tempfile.TemporaryDirectory() as scratch:
        for verdict in run_mutants(FORMATS[name], mutants, Path(scratch), seed=options.seed):
            sys.stdout.write(json.dumps(verdict) + "\n")
            sys.stdout.flush()
    return 0


def run_outside(name: str, options: Options, ended: Callable[[], None]) -> list[Verdict]:
    """The verdicts of a format, from a process that is started anew when a mutant ends it.

    Args:
        name: the format.
        options: the command line.
        ended: called after each mutant.
    """
    verdicts: list[Verdict] = []
    first, end = options.first, options.first + options.mutants
    while first < end:
        command = (
            f"-m tests.campaigns --inside --formats {name} --first {first} "
            f"--mutants {end - first} --seed {options.seed}"
        )
        count = len(verdicts)
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryFile("w+") as errors:
            with subprocess.Popen(
                [sys.executable, *command.split()],
                env={**os.environ, "ASP_ENV_CACHE": cache, "OMP_NUM_THREADS": "1"},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            ) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    if line.startswith("["):
                        verdicts.append(Verdict(*json.loads(line)))
                        ended()
            errors.seek(0)
            last = errors.read().strip().rpartition("\n")[2]
        finished = len(verdicts) - count
        first += finished
        if first < end:
            verdicts.append(Verdict(first, "", f"process ended by {process.returncode}", last))
            ended()
            first += 1
            if not finished and len(verdicts) > 1 and verdicts[-2].outcome == verdicts[-1].outcome:
                break  # not one mutant, but every process
    return verdicts


def report(by_format: dict[str, list[Verdict]]) -> Iterator[str]:
    """A row for each format, and a line for each kind of fault with the first mutant of it."""
    faults = [verdict for each in by_format.values() for verdict in each if verdict.is_fault]
    kinds = sorted({fault.outcome for fault in faults})
    yield "  ".join([f"{'format':18}  mutants  accepted  refused", *kinds])
    for name, verdicts in by_format.items():
        counts = Counter(verdict.outcome for verdict in verdicts)
        row = f"{name:18}  {len(verdicts):7,}  {counts['accepted']:8,}  {counts['refused']:7,}"
        yield "  ".join([row, *(f"{counts[kind]:>{len(kind)}}" for kind in kinds)])
    seen: set[tuple[str, str]] = set()
    for name, verdicts in by_format.items():
        for fault in verdicts:
            place = (fault.outcome, fault.detail.partition(": ")[0])
            if fault.is_fault and place not in seen:
                seen.add(place)
                yield (
                    f"{name}, mutant {fault.mutant} ({fault.mutation}): {fault.outcome}: "
                    f"{fault.detail}"
                )


if __name__ == "__main__":
    sys.exit(main())
