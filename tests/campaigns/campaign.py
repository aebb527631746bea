"""Makes mutants of a format, uses each in full, and judges how that ends.

Every mutant ends in one of these outcomes:

- `accepted`: it was used in full and every number that follows from it is finite;
- `refused`: an `AspEnvError` of one line;
- a fault: any other exception, a number that is not finite, over `LIMIT_S` of CPU time, over
  `LIMIT_BYTES` of memory, or the end of the process.
"""

import contextlib
import io
import resource
import shutil
import signal
import traceback
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asp_env.errors import AspEnvError, LeftOutWarning, RepairWarning
from tests.campaigns.formats import Format, NotFinite
from tests.campaigns.mutations import mutate_file, mutate_folder

COMPILING_S = 120.0
"""Largest CPU time of an input that is not changed, in which functions may be compiled."""

LIMIT_S = 10.0
"""CPU time of one mutant."""

LIMIT_BYTES = 2 << 30
"""Memory of one mutant."""

BLOCKED_S = 120.0
"""Wall time after which a mutant is taken to wait for something forever; CPU time does not show
this, and on a busy machine wall time is no measure of work."""

RENAMED_SHARE = 0.1


class Verdict(NamedTuple):
    """How a mutant ended."""

    mutant: int
    mutation: str
    outcome: str
    """`accepted`, `refused`, or the kind of fault."""
    detail: str

    @property
    def is_fault(self) -> bool:
        """Whether this must not happen."""
        return self.outcome not in ("accepted", "refused")


class _Exceeded(BaseException):
    """A limit of time; no handler of `Exception` stops it."""


def run_mutants(
    kind: Format, mutants: Sequence[int], scratch: Path, *, seed: int = 0
) -> Iterator[Verdict]:
    """Makes and uses mutants of one format, one after the other.

    Args:
        kind: the format.
        mutants: their numbers; the same number and seed give the same mutant.
        scratch: an empty folder.
        seed: seed of all of them.
    """
    origin, changed = scratch / "origin", scratch / "input"
    origin.mkdir()
    kind.make(origin)
    shutil.copytree(origin, changed)
    verdict = judge(kind, changed, -1, "unchanged", limit_s=COMPILING_S)
    if verdict.outcome != "accepted":
        raise AssertionError(
            f"{kind.name}: the unchanged input is {verdict.outcome}: {verdict.detail}"
        )
    for mutant in mutants:
        shutil.rmtree(changed)
        shutil.copytree(origin, changed)  # with times, so that unchanged files stay cached
        rng = np.random.default_rng([seed, zlib.crc32(kind.name.encode()), mutant])
        yield judge(kind, changed, mutant, mutate(rng, kind, changed))


def mutate(rng: np.random.Generator, kind: Format, folder: Path) -> str:
    """Changes one file of an input, or two."""
    if kind.renames and rng.random() < RENAMED_SHARE:
        return mutate_folder(rng, folder)
    files = sorted(path for path in folder.rglob("*") if path.suffix in kind.suffixes)
    names = []
    for _ in range(1 + (rng.random() < 0.15)):
        path = files[int(rng.integers(len(files)))]
        names.append(f"{path.name}: {mutate_file(rng, path)}")
    return ", ".join(names)


def judge(
    kind: Format, folder: Path, mutant: int, mutation: str, *, limit_s: float = LIMIT_S
) -> Verdict:
    """Uses an input and judges how that ends.

    Args:
        kind: the format.
        folder: the input.
        mutant: its number.
        mutation: what was changed.
        limit_s: largest CPU time.
    """
    outcome, detail = "accepted", ""
    try:
        with _limits(limit_s), warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("error")
            for category in (RepairWarning, LeftOutWarning):
                warnings.simplefilter("ignore", category)
            warnings.filterwarnings("ignore", "data .* no recording lasts")
            kind.use(folder)
    except AspEnvError as error:
        outcome, detail = "refused", str(error)
        if "\n" in detail or not detail.strip() or len(detail) > 2_000:
            outcome = "not one line"
    except NotFinite as error:
        outcome, detail = "not finite", str(error)
    except _Exceeded as error:
        outcome, detail = str(error), _place(error)
    except MemoryError as error:
        outcome, detail = "memory", _place(error)
    except Exception as error:  # what a campaign is to find
        outcome = type(error).__name__
        detail = f"{_place(error)}: {' '.join(str(error).split())[:200]}"
    return Verdict(mutant, mutation, outcome, detail)


def _place(error: BaseException) -> str:
    """The innermost line of the project at which an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [
        each
        for each in frames
        if "campaigns" not in each.filename and "site-pack" not in each.filename
    ]
    last = (own or frames)[-1]
    return f"{'/'.join(Path(last.filename).parts[-3:])}:{last.lineno}"


@contextlib.contextmanager
def _limits(limit_s: float) -> Iterator[None]:
    def exceeded(number: int, _: object) -> None:
        raise _Exceeded(f"over {limit_s:g} s" if number == signal.SIGPROF else "blocked")

    before = [signal.signal(number, exceeded) for number in (signal.SIGPROF, signal.SIGALRM)]
    memory = resource.getrlimit(resource.RLIMIT_DATA)
    try:
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        signal.setitimer(signal.ITIMER_REAL, BLOCKED_S)
        resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + LIMIT_BYTES, memory[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, memory)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(number, handler)


def _data_bytes() -> int:
    """Private writable memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
