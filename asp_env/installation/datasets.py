"""`asp-env datasets`: which public recordings can be used, and how each is had."""

from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.table import Table

from asp_env.console import table_console
from asp_env.errors import unknown_name
from asp_env.installation.catalogue import DATASETS, PublicDataset


@dataclass(frozen=True, slots=True, kw_only=True)
class Datasets:
    """List public recordings: content, licence, how to get each, and which reader reads it."""

    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")] = None
    """One data set, which is described in full. The default is a table of all."""

    def run(self) -> None:
        """Prints the table, or the description of one data set.

        Raises:
            AspEnvError: the name is unknown.
        """
        console = table_console()
        if self.name is None:
            console.print(_table())
            console.print(
                "asp-env datasets NAME describes one: where to get it, where to put it, and how to "
                "check it.\nNothing is needed to start: sample:intersection and sample:roundabout "
                "are part of this package.",
                highlight=False,
            )
            return
        by_name = {each.name.lower(): each for each in DATASETS}
        if self.name.lower() not in by_name:
            raise unknown_name("data set", self.name, [each.name for each in DATASETS])
        for line in description(by_name[self.name.lower()]):
            console.print(line, highlight=False, soft_wrap=True)


def description(dataset: PublicDataset) -> list[str]:
    """The lines that describe a data set."""
    reader = dataset.reader or "none yet"
    if dataset.reader:
        reader += f" (tested on: {dataset.tested})"
    lines = [
        dataset.title,
        f"  content: {dataset.holds}",
        f"  licence: {dataset.licence} (the publisher's page decides)",
        f"  get it:  by {dataset.access}: {dataset.obtain}",
        f"  reader:  {reader}",
        f"  folder:  {dataset.folder}, or any other: {dataset.place}",
    ]
    if dataset.notes:
        lines.append(f"  note:    {dataset.notes}")
    if dataset.reader:
        lines += [
            f"  check:   {dataset.check}",
            f"  look:    asp-env inspect {dataset.folder}",
            f"  drive:   asp-env drive {dataset.folder} --max-scenarios 20 --out results",
        ]
    return lines


def _table() -> Table:
    table = Table("name", "content", "licence", "access", "reader")
    for column in table.columns:
        column.overflow = "fold"
    for each in DATASETS:
        table.add_row(each.name, each.holds, each.licence, each.access, each.reader or "none yet")
    return table
