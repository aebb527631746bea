"""The sites of a table: where is learned, selected and judged, one group of columns each."""

from collections.abc import Sequence
from dataclasses import dataclass

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation.paper_table.cells import site_names


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Data and their content."""

    name: str
    data: str
    data_hash: str
    validation: str | None = None
    """Data to select on; the part validation of `data` if None."""
    validation_hash: str | None = None
    test: str | None = None
    """Data to judge on; the part test of `data` if None."""
    test_hash: str | None = None

    @property
    def judged_on(self) -> str:
        """The data that errors are of."""
        return self.test or self.data

    @property
    def judged_hash(self) -> str:
        """Of their content."""
        return self.test_hash or self.data_hash


def open_sites(data: Sequence[str], validation: Sequence[str], test: Sequence[str]) -> list[Site]:
    """The sites of some data.

    Raises:
        AspEnvError: not as many for each part, data that cannot be read, or a recording twice.
    """
    for option, given in (("--validation", validation), ("--test", test)):
        if given and len(given) != len(data):
            raise AspEnvError(
                f"{option}: {len(given)} given, expected one for each of the {len(data)} DATA"
            )
    if validation and not test:
        raise AspEnvError(
            "--validation: all of DATA is learned from then, so nothing is left to judge on; "
            "give --test too"
        )
    return [
        _open_site(
            name,
            data[number],
            validation[number] if validation else None,
            test[number] if test else None,
        )
        for number, name in enumerate(site_names(data))
    ]


def _open_site(name: str, data: str, validation: str | None, test: str | None) -> Site:
    opened = {given: open_data(given) for given in (data, validation, test) if given is not None}
    if test is not None:
        judged = dict(zip(opened[test].hashes(), opened[test].names, strict=True))
        for other in (each for each in (data, validation) if each is not None):
            if both := set(judged) & set(opened[other].hashes()):
                raise AspEnvError(
                    f"recording {judged[min(both)]} of {test!r} is in {other!r} too: judge on "
                    "recordings that are neither learned from nor selected on"
                )
    hashes = {given: recordings.data_hash() for given, recordings in opened.items()}
    return Site(
        name=name,
        data=data,
        data_hash=hashes[data],
        validation=validation,
        validation_hash=None if validation is None else hashes[validation],
        test=test,
        test_hash=None if test is None else hashes[test],
    )
