"""The source works with every version of Gymnasium that the package declares."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import asp_env

ROOT = Path(asp_env.__file__).parent.parent
ROOMS = ("asp_env", "predictors", "scenarios", "agents")

GENERIC = {
    *("Env", "Space", "Wrapper", "ActionWrapper", "ObservationWrapper", "RewardWrapper"),
    "VectorEnv",
}
"""Classes that are generic in Gymnasium 1.2.0, the oldest declared version; `Box` is not."""


def _gymnasium_names(tree: ast.Module) -> dict[str, str]:
    """The names that a module gives to Gymnasium's modules and classes."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for each in node.names:
                if each.name.split(".")[0] == "gymnasium":
                    names[each.asname or "gymnasium"] = each.name if each.asname else "gymnasium"
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "gymnasium":
            names |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
    return names


def _subscripted(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and full name of each class of Gymnasium that is subscripted at run time."""
    names = _gymnasium_names(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript):
            first, *rest = ast.unparse(node.value).split(".")
            if first in names:
                yield node.lineno, ".".join([names[first], *rest])


@pytest.mark.parametrize("room", ROOMS)
def test_only_classes_that_are_generic_in_the_oldest_version_are_subscripted(room):
    """`spaces.Box[Any]` fails at import with Gymnasium 1.2 and 1.3."""
    for path in sorted((ROOT / room).rglob("*.py")):
        for line, name in _subscripted(ast.parse(path.read_text())):
            assert name.split(".")[-1] in GENERIC, f"{path}:{line}: {name}[…]"


def test_the_search_finds_subscripts():
    source = (
        "from gymnasium import spaces as s\nimport gymnasium\na: s.Box[int]\nb = gymnasium.Env[1]"
    )
    found = {name for _, name in _subscripted(ast.parse(source))}
    assert found == {"gymnasium.spaces.Box", "gymnasium.Env"}
