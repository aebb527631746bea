"""Nothing that comes from a file or a socket is executed, and names from data are only text."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from asp_env.evaluation.report import write_report
from policies.comparison import curves_figure
from tests.builders import make_recording
from tests.evaluation.runs import make_examples, make_rollout, metric_rows, write_tables

ROOT = Path(__file__).parents[1]
PACKAGES = ("asp_env", "predictors", "scenarios", "policies")

UNSAFE_MODULES = {
    *("pickle", "_pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"),
    *("jsonpickle", "yaml", "code", "runpy", "imp", "telnetlib"),
    *("socket", "socketserver", "asyncio", "http", "xmlrpc", "urllib", "requests", "ftplib"),
    *("multiprocessing.connection", "multiprocessing.managers", "multiprocessing.reduction"),
    *("xml", "lxml", "zipimport"),
}
"""Modules that execute what they read, open sockets, or expand entities."""

ALLOWED_MODULES = {
    "asp_env/compiled.py": {"pickle"},  # files of its own, whose owner and mode are checked
    # Between a process and its children, over a pair of sockets that no other can open.
    "asp_env/workers.py": {
        *("pickle", "socket", "multiprocessing.connection", "multiprocessing.reduction"),
    },
    # Whether a cluster answers at the address that the user gives; nothing is sent or read.
    "asp_env/evaluation/study/ray_cluster.py": {"socket"},
    "asp_env/data/readers/osm.py": {"xml"},  # refuses entities before it parses
    "scenarios/sumo/network.py": {"xml"},  # what netconvert has just written
}

UNSAFE_NAMES = {"eval", "exec", "compile", "__import__"}
UNSAFE_CALLS = {
    *("torch.load", "os.system", "os.popen", "tempfile.mktemp", "pd.eval", "np.fromregex"),
    *("read_pickle", "extractall", "all_gather_object", "broadcast_object_list"),
    *("scatter_object_list", "unsafe_load", "load_from_checkpoint"),
}
ALLOWED_CALLS = {
    # Between the processes of one training, docs/security.md.
    "predictors/training/trainer.py": {"all_gather_object"},
}


def unsafe(tree: ast.AST, *, modules: frozenset[str], calls: frozenset[str]) -> Iterator[str]:
    """What a file imports and calls that may execute data, each with its line.

    Args:
        tree: the file.
        modules: modules that are allowed.
        calls: functions that are allowed.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from (f"line {node.lineno}: {name}" for name in _modules(node) - modules)
        elif isinstance(node, ast.Call) and (name := _unsafe_call(node)) and name not in calls:
            yield f"line {node.lineno}: {name}"


def _modules(node: ast.Import | ast.ImportFrom) -> set[str]:
    """The unsafe modules that a statement imports."""
    found = set()
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    else:
        names = [str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)]
    for name in names:
        parts = name.split(".")
        starts = {".".join(parts[:count]) for count in range(1, len(parts) + 1)}
        found |= starts & UNSAFE_MODULES
    return found


def _unsafe_call(node: ast.Call) -> str:
    """The name of a call that may execute data, or "" for a harmless one."""
    name = ast.unparse(node.func)
    last = name.rpartition(".")[2]
    keywords = {each.arg: ast.unparse(each.value) for each in node.keywords}
    if name in UNSAFE_NAMES or name in UNSAFE_CALLS or last in UNSAFE_CALLS:
        return last if last in UNSAFE_CALLS else name
    if name in ("np.load", "numpy.load") and keywords.get("allow_pickle") != "False":
        return "np.load without allow_pickle=False"
    if keywords.get("allow_pickle", "False") != "False":
        return f"{name} with allow_pickle"
    if keywords.get("shell", "False") != "False":
        return f"{name} with a shell"
    of_frame = last in ("eval", "query") and name not in (last, f"self.{last}")
    if of_frame and (node.args or node.keywords):
        return f"{last} of pandas"  # `network.eval()` has no arguments
    return ""


@pytest.mark.parametrize(
    "path",
    sorted(path for folder in PACKAGES for path in (ROOT / folder).rglob("*.py")),
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_nothing_is_executed(path: Path) -> None:
    """No module unpickles, evaluates, parses entities or opens a socket, but the ones named."""
    name = str(path.relative_to(ROOT))
    found = unsafe(
        ast.parse(path.read_text()),
        modules=frozenset(ALLOWED_MODULES.get(name, set())),
        calls=frozenset(ALLOWED_CALLS.get(name, set())),
    )
    assert not list(found)


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import xml.etree.ElementTree as tree",
        "from multiprocessing import connection",
        "from multiprocessing.connection import Listener",
        "from http.server import HTTPServer",
        "eval(text)",
        "exec(text, {})",
        "torch.load(path)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.savez(path, a, allow_pickle=True)",
        "frame.query(text)",
        "pd.read_pickle(path)",
        "subprocess.run(text, shell=True)",
        "distributed.all_gather_object(values, value)",
        "archive.extractall(path)",
    ],
)
def test_the_check_finds(code: str) -> None:
    """Each of these lines, anywhere in a file."""
    tree = ast.parse(f"def function():\n    {code}")
    (found,) = unsafe(tree, modules=frozenset(), calls=frozenset())
    assert found.startswith("line 2: ")


@pytest.mark.parametrize(
    "code",
    ["network.eval()", "np.load(path, allow_pickle=False)", "import json", "re.compile(pattern)"],
)
def test_the_check_leaves(code: str) -> None:
    assert not list(unsafe(ast.parse(code), modules=frozenset(), calls=frozenset()))


EVIL = '<script>alert("1")</script><img src=x onerror=alert(2)>'


def test_names_from_data_are_text_in_reports(tmp_path: Path) -> None:
    """A recording, a location, predictors, a planner, subsets and values that are HTML.

    Scripts of the page write them as the text of elements, see `test_scripts_write_no_markup`.
    """
    rows = metric_rows()
    for row in rows:
        row["data"] = EVIL
        for field in ("predictor", "planner", "subset", "traffic"):
            row[field] = f"{row[field]}{EVIL}" if row.get(field) else row.get(field)
    write_tables(tmp_path, rows)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    manifest |= {"data": EVIL, EVIL: {EVIL: [EVIL]}}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    recording = make_recording(duration_s=10.0, name=EVIL)
    track = int(recording.predicted.nonzero()[0][0])
    start = -(-int(recording.first_frames[track]) // round(0.2 * recording.frame_rate_hz))
    rollout = make_rollout(recording, track=track, start_tick=start, length=10, lag=0.1)
    folder = tmp_path / "rollouts" / EVIL.replace("/", "")
    folder.mkdir(parents=True)
    rollout.save(folder / "0.npz")
    path = write_report(
        tmp_path,
        title=EVIL,
        lead=EVIL,
        maps={EVIL: recording.road_map},
        examples=make_examples([recording], count=1),
    )
    page = path.read_text()
    assert "alert(" in page
    assert not re.findall(r"<script>alert|<img src=x", page)


def test_scripts_write_no_markup() -> None:
    """The scripts of the pages never parse text as HTML."""
    scripts = [*(ROOT / "asp_env/evaluation/report/assets").glob("*.js")]
    assert scripts
    for path in scripts:
        found = re.findall(
            r"innerHTML|outerHTML|insertAdjacentHTML|document\.write", path.read_text()
        )
        assert not found, path


def test_names_of_policies_are_text_in_learning_curves() -> None:
    import numpy as np

    figure = curves_figure({EVIL: np.zeros((2, 4))})
    assert all("<" not in (trace.name or "") for trace in figure.data)
    assert "<script>alert" not in figure.to_html(include_plotlyjs=False)
