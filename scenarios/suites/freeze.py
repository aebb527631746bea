"""Freezes suites: `python -m scenarios.suites.freeze NAME …` writes their lists of scenarios.

A released suite is never frozen again; another list needs another name.
"""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios import choose_scenarios, save_scenarios
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import open_data
from asp_env.errors import unknown_name
from scenarios.suites.suite import MADE, SUITES, make_suite

FILTER = "interactive"
"""The scenarios of a suite; the tag depends on the recording alone."""

MOST_SCENARIOS = 800
"""Scenarios of a suite, at even spacing among those that `FILTER` finds. With a paired standard
deviation of 0.1 they resolve a difference of 0.01 with 80 % power."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Freeze:
    """Make the traffic of suites and write their frozen lists of scenarios.

    Attributes:
        names: Names of the suites.
        out: Folder of the lists.
    """

    names: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME …")]
    out: Path = Path(__file__).parent

    def run(self) -> None:
        """Writes one file for each suite.

        Raises:
            AspEnvError: a suite is unknown, or a package is missing.
        """
        for name in self.names:
            if name not in SUITES:
                raise unknown_name("suite", name, SUITES)
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch) / name
                folder.mkdir()
                make_suite(SUITES[name], folder)
                freeze(folder, self.out / f"{name}.json")


def freeze(folder: Path, path: Path) -> None:
    """Writes the list of scenarios of a suite.

    Args:
        folder: the traffic, made by `make_suite`.
        path: the file to write.
    """
    recordings = open_data(folder)
    history = round(HISTORY_S / DEFAULT_DT_S)
    found = choose_scenarios(recordings, FILTER, dt_s=DEFAULT_DT_S, history=history)
    save_scenarios(path, found.evenly_spaced(MOST_SCENARIOS), recordings)
    facts = json.dumps({"suite": json.loads((folder / MADE).read_text())})
    path.write_text(facts[:-1] + ", " + path.read_text(encoding="utf-8")[1:], encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(Freeze).run()
