"""Which module may import which, and what importing costs."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("asp_env", "predictors", "scenarios", "policies")

ON_ALL = {
    *("arguments", "errors", "registry", "geometry", "console"),
    *("files", "stored", "workers", "compiled"),
}
FOR_PREDICTORS = {"views", "metrics", "data", "dynamics"} | ON_ALL
ARROWS = {
    "__init__": {"envs", "planning", "data", "dynamics", "errors"},
    "arguments": {"errors"},
    "errors": set[str](),
    "console": set[str](),
    "registry": {"errors"},
    "geometry": {"errors", "compiled"},
    "files": {"errors"},
    "compiled": {"files", "errors"},
    "stored": {"errors"},
    "workers": {"errors"},
    "__main__": {"cli"},
    "cli": {"installation"} | ON_ALL,
    "installation": {"data"} | ON_ALL,
    "dynamics": ON_ALL,
    "data": {"dynamics"} | ON_ALL,
    "metrics": {"data", "dynamics"} | ON_ALL,
    "views": {"data", "dynamics"} | ON_ALL,
    "render": {"data"} | ON_ALL,
    "sim": {"views", "metrics", "data", "dynamics"} | ON_ALL,
    "envs": {"sim", "views", "metrics", "render", "data", "dynamics"} | ON_ALL,
    "planning": {"metrics", "data", "dynamics"} | ON_ALL,
    "evaluation": {
        *("sim", "planning", "envs", "render", "views", "metrics", "data", "dynamics"),
        *ON_ALL,
    },
    "predictors": {"predictors.inference", "predictors.models", *FOR_PREDICTORS},
    "predictors.models": FOR_PREDICTORS,
    "predictors.inference": {"predictors", "predictors.models", *FOR_PREDICTORS},
    "predictors.training": {
        *("predictors", "predictors.inference", "predictors.models"),
        *FOR_PREDICTORS,
    },
    "predictors.experiments": {
        *("predictors", "predictors.training", "predictors.inference", "predictors.models"),
        *("evaluation", "planning", "sim"),
        *FOR_PREDICTORS,
    },
    "scenarios": {"sim", "data", "dynamics"} | ON_ALL,
    "policies": {
        *("evaluation", "planning", "sim", "envs", "views", "metrics", "data", "dynamics"),
        *ON_ALL,
    },
}
"""The parts that each part may import besides itself; those of `asp_env` without its name."""

LEARNING = {"torch", "lightning", "safetensors", "stable_baselines3", "tensorboard"}
RENDERING = {"av", "pygame"}

ADAPTERS = {"asp_env.envs.parallel": "pettingzoo", "asp_env.envs.sb3": "stable_baselines3"}
"""Modules whose classes derive from those of a package of the extras. They are imported only inside
functions."""


def files(*folders: str) -> list[Path]:
    """All Python files below some folders of the project."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def imported(tree: ast.AST) -> Iterator[str]:
    """Full names of everything that some code imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(module: str) -> str:
    """The part of a module: `data` for `asp_env.data.scene`, `scenarios` for `scenarios.tables`."""
    top, *inner = module.split(".")
    if top == "asp_env":
        return inner[0] if inner else top
    if top == "predictors" and inner and f"predictors.{inner[0]}" in ARROWS:
        return f"predictors.{inner[0]}"
    return top


@pytest.mark.parametrize("path", files(*PACKAGES), ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows(path: Path) -> None:
    """A file imports only its own part and the allowed ones."""
    own = part_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
    allowed = ARROWS[own] | {own}
    modules = [name for name in imported(ast.parse(path.read_text())) if name.startswith(PACKAGES)]
    known = {part_of(name) for name in modules}
    assert known <= allowed, f"{own} imports {sorted(known - allowed)}"


@pytest.mark.parametrize("part", sorted(set(ARROWS)))
def test_every_part_named_here_exists(part: str) -> None:
    """A renamed part would otherwise no longer be checked."""
    part = part.replace(".", "/")
    places = (part, f"asp_env/{part}", f"asp_env/{part}.py")
    assert any((ROOT / place).exists() for place in places)


def test_every_part_is_named_here() -> None:
    """A new part needs an entry in `ARROWS`."""
    inside = {part_of(".".join(path.relative_to(ROOT).parts)) for path in files("asp_env")}
    assert {name.removesuffix(".py") for name in inside} <= set(ARROWS)


def test_no_learning_at_the_top_of_a_module() -> None:
    """Packages of the extras for learning are imported only inside functions."""
    for path in files("asp_env"):
        own = ADAPTERS.get(".".join(path.relative_to(ROOT).with_suffix("").parts), "")
        body = [node for node in ast.parse(path.read_text()).body if not _defines(node)]
        taken = {name.partition(".")[0] for node in body for name in imported(node)}
        assert not (taken & LEARNING) - {own}, path


def _defines(node: ast.stmt) -> bool:
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)


def loaded_by(code: str) -> set[str]:
    """The top-level modules that a fresh interpreter has loaded after running some code."""
    report = "import json, sys; print(json.dumps([name.partition('.')[0] for name in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_is_cheap() -> None:
    """`import asp_env` loads none of the extras, and no plug."""
    extras = {"plotly", "sumo", "traci", "sumolib", "highway_env", "selenium"}
    extras |= {"predictors", "scenarios", "policies"}
    adapted = set(ADAPTERS.values())
    assert not loaded_by("import asp_env") & (LEARNING | RENDERING | extras | adapted)


def test_no_module_loads_torch() -> None:
    """Not even all modules together, except the adapters, load torch or packages of windows."""
    code = f"""
import importlib, pkgutil, asp_env
for found in pkgutil.walk_packages(asp_env.__path__, "asp_env."):
    if "plots" not in found.name and found.name not in {set(ADAPTERS)}:
        importlib.import_module(found.name)
"""
    assert not loaded_by(code) & (LEARNING | RENDERING)


def module_of(path: Path) -> str:
    """The dotted name of a file's module."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_no_circular_imports() -> None:
    """The imports at the top of all modules form a directed graph without a cycle.

    `asp_env` and the packages' `__init__` files count as modules of their own; imports inside
    functions count as well, except those that load a plug by its name.
    """
    modules = {module_of(path): path for path in files(*PACKAGES)}
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        taken = set(imported(ast.parse(path.read_text())))
        found = {each if each in modules else each.rpartition(".")[0] for each in taken}
        graph[name] = (found & set(modules)) - {name}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle
