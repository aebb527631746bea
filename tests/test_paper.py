"""The table of the paper's statements names code and tests that exist."""

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "paper.md"
QUOTED = re.compile(r"`([^`]+)`")


def statements() -> list[list[str]]:
    """The cells of all rows of tables with the columns statement, code, test and departures."""
    found, header = [], [""]
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line[:1] == "|" else [""]
        if header == [""] or cells == [""]:
            header = cells
        elif header == ["statement", "code", "test", "departures"] and set(line) - set("|-"):
            found.append(cells)
    return found


ROWS = statements()


def test_every_row_is_complete() -> None:
    """Four cells each; every number of an equation occurs, from 1 to 20."""
    assert len(ROWS) > 45
    for row in ROWS:
        assert len(row) == 4, row
        assert all(row), row
    numbers = {
        int(number)
        for row in ROWS
        for group in re.findall(r"\((\d+(?:, \d+)*)\)", row[0])
        for number in group.split(", ")
    }
    assert numbers == set(range(1, 21))


@pytest.mark.parametrize("row", ROWS, ids=[row[0][:40] for row in ROWS])
def test_named_code_and_tests_exist(row: list[str]) -> None:
    symbols, tests = QUOTED.findall(row[1]), QUOTED.findall(row[2])
    assert symbols
    assert tests
    for symbol in symbols:
        _resolve(symbol)
    for name in tests:
        path, _, function = name.partition("::")
        tree = ast.parse((ROOT / path).read_text())
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize(
    "symbol", ["asp_env.dynamics.bicycle.tricycle", "asp_env.tricycle.forward"]
)
def test_a_missing_symbol_is_noticed(symbol: str) -> None:
    with pytest.raises(AttributeError):
        _resolve(symbol)


def _resolve(symbol: str) -> object:
    """The object of a dotted name; fields of dataclasses may have no default."""
    parts = symbol.split(".")
    for length in range(len(parts) - 1, 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            fields = getattr(found, "__dataclass_fields__", {})
            found = fields[part] if part in fields else getattr(found, part)
        return found
    raise ModuleNotFoundError(symbol)
