"""Which scenarios are meant, in words: `left,!standing-start,length>=8,density>5`."""

import math
import re
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Shaped

from asp_env.data.scenario_tags import COLUMNS, TAGS
from asp_env.errors import AspEnvError, unknown_name

TEXTS = ("recording", "location")
"""What is compared as text, with `=` and `!=` alone."""

_UNITS = ("_s", "_m", "_mps", "_deg")
_SHORT = {name.removesuffix(unit): name for name in COLUMNS for unit in _UNITS}
"""Columns under the names that leave their unit out, and under their own."""

_COMPARISON = re.compile(r"([^<>=!]*)(>=|<=|!=|>|<|=)([^<>=!]*)")
_COMPARE = {
    ">=": np.greater_equal,
    "<=": np.less_equal,
    ">": np.greater,
    "<": np.less,
    "=": np.equal,
    "!=": np.not_equal,
}


@runtime_checkable
class Table(Protocol):
    """What is filtered: an `asp_env.data.scenario.ScenarioSet`."""

    def __len__(self) -> int:
        """How many rows there are."""
        ...

    def has(self, tag: str) -> Bool[np.ndarray, " n"]:
        """Which rows carry a tag."""
        ...

    def column(self, name: str) -> Shaped[np.ndarray, " n"]:
        """A column of numbers or names."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A tag that is there or not, or a column compared with a value."""

    name: str
    operator: str
    """`=` and `!=` for tags, too."""
    value: float | str | None
    """None for tags."""

    def __str__(self) -> str:
        """As it is written."""
        if self.value is None:
            return self.name if self.operator == "=" else f"!{self.name}"
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        return f"{self.name}{self.operator}{value}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFilter:
    """Conditions of which every clause must hold; a clause holds where one of its conditions does.

    In words: conditions with `,` between clauses and `|` between the conditions of one, such as
    `left|right,yielding,!standing-start,length>=8,density>5,recording=00`. A condition is a tag
    (`asp_env.data.scenario_tags.TAGS`), a tag that is not there (`!tag`), or a column
    (`asp_env.data.scenario_tags.COLUMNS`; the unit may be left out) compared by one of
    `>= <= > < = !=` with a number; `recording` and `location` are compared with names. Empty words
    ask for nothing, so that every scenario fits.
    """

    clauses: tuple[tuple[Condition, ...], ...]

    @classmethod
    def parse(cls, text: str) -> "ScenarioFilter":
        """Reads the words.

        Raises:
            AspEnvError: they are not understood; names that are not known list those that are.
        """
        if not text.strip():
            return cls(clauses=())
        return cls(
            clauses=tuple(
                tuple(_condition(each.strip(), text) for each in clause.split("|"))
                for clause in text.split(",")
            )
        )

    def __str__(self) -> str:
        """The words, in one spelling."""
        return ",".join(map(_clause_text, self.clauses))

    def holds(self, table: Table) -> Bool[np.ndarray, " n"]:
        """(n,) which rows of a `ScenarioSet` fit."""
        fits = np.ones(len(table), dtype=bool)
        for clause in self.clauses:
            fits &= _clause_holds(clause, table)
        return fits

    def explain(self, table: Table) -> str:
        """How many rows each clause would leave by itself."""
        counts = (
            f"{_clause_text(clause)} {int(_clause_holds(clause, table).sum())}"
            for clause in self.clauses
        )
        return ", ".join(counts)


def _clause_text(clause: tuple[Condition, ...]) -> str:
    return "|".join(map(str, clause))


def _clause_holds(clause: tuple[Condition, ...], table: Table) -> Bool[np.ndarray, " n"]:
    fits = np.zeros(len(table), dtype=bool)
    for each in clause:
        if each.value is None:
            fits |= table.has(each.name) == (each.operator == "=")
        else:
            fits |= _COMPARE[each.operator](table.column(each.name), each.value)
    return fits


def _condition(words: str, text: str) -> Condition:
    if words.startswith("!") or not set(words) & set("<>="):
        tag = words.removeprefix("!").strip()
        if not tag:
            raise AspEnvError(
                f"scenarios {text!r}: a condition is empty; expected tags and comparisons with "
                "commas between them, such as left,length>=8"
            )
        if tag not in TAGS:
            raise unknown_name("scenario tag", tag, TAGS)
        return Condition(name=tag, operator="!=" if words.startswith("!") else "=", value=None)
    match = _COMPARISON.fullmatch(words)
    if match is None:
        raise AspEnvError(
            f"scenarios {text!r}: {words!r} is not understood; expected a tag, !tag, or a column "
            "compared with a value, such as length>=8"
        )
    name, operator, value = (part.strip() for part in match.groups())
    name = _SHORT.get(name, name)
    if name in TEXTS:
        return _text_condition(name, operator, value)
    if name not in COLUMNS:
        raise unknown_name("scenario column", name, (*COLUMNS, *TEXTS))
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise AspEnvError(f"scenarios {text!r}: {name}{operator}{value}: expected a number")
    return Condition(name=name, operator=operator, value=number)


def _text_condition(name: str, operator: str, value: str) -> Condition:
    if operator not in ("=", "!=") or not value:
        raise AspEnvError(
            f"scenarios: {name}{operator}{value}: expected {name}=NAME or {name}!=NAME"
        )
    return Condition(name=name, operator=operator, value=value)
