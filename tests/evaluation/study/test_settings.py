"""Settings of a study from a TOML file and from options."""

from pathlib import Path

import pytest
import tyro

from asp_env.cli import main
from asp_env.errors import AspEnvError
from asp_env.evaluation.study.settings import StudySettings, read_settings
from asp_env.evaluation.study.study import Study

TOML = """
data = ["suite:intersection-v1", "karlsruhe"]
methods = "oracle"
latency_ticks = [0, 2]
max_scenarios = 40
controls = false
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_options_replace_what_the_file_states(tmp_path: Path) -> None:
    path = write(tmp_path, TOML)
    options = {"methods": ("idm",), "max_scenarios": None, "horizon_s": 4.0}
    assert read_settings(path, options) == StudySettings(
        data=("suite:intersection-v1", "karlsruhe"),
        methods=("idm",),
        latency_ticks=(0, 2),
        max_scenarios=40,
        controls=False,
        horizon_s=4.0,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data = 3\nmethods = ['idm']", "data 3, expected a list of str"),
        ("data = ['a', 'a']\nmethods = ['idm']", "data has 'a' twice"),
        ("data = ['a']", "no methods: add them to"),
        ("data = ['a']\nmethods = []", "no methods given"),
        ("data = ['a']\nmethod = ['idm']", "unknown key 'method' \\(did you mean 'methods'"),
        ("data = ['a']\nmethods = ['idm']\nlatency_ticks = [-1]", "latency_ticks -1, expected 0"),
        ("data = ['a']\nmethods = ['idm']\nlatency_ticks = [1.5]", "expected a list of int"),
        ("data = ['a']\nmethods = ['idm']\nhorizon_s = 0", "horizon_s 0, expected a finite"),
        ("data = ['a']\nmethods = ['idm']\nbudget_ms = inf", "budget_ms inf, expected a finite"),
        ("data = ['a']\nmethods = ['idm']\nrules = 3", "rules 3 has a wrong type"),
        ("data = ['a'", "not a TOML file"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(AspEnvError, match=message) as raised:
        read_settings(write(tmp_path, text), {})
    assert "\n" not in str(raised.value)


def test_a_missing_file_and_no_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AspEnvError, match="cannot be read"):
        read_settings(tmp_path / "none.toml", {})
    with pytest.raises(AspEnvError, match="no data and no methods: give a TOML file or options"):
        read_settings(None, {})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--traffic"], "study: no traffic given, expected at least one; leave --traffic out"),
        (["--ray-send-data"], "--ray-send-data: goes with --ray ADDRESS; leave it out"),
        (["--latency-ticks", "2"], "study: no method uses forecasts"),
        (["--methods", ""], "method '': expected PLANNER+PREDICTOR, a predictor or a planner"),
        (["--methods", "pdn+oracle"], "unknown planner 'pdn' (did you mean 'pdm'?)"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_options_that_fit_nothing_are_refused(
    tmp_path: Path, given: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line, before anything is driven or written."""
    out = tmp_path / "study"
    args = ["--data", "sample:roundabout", "--methods", "idm", "--out", str(out), *given]
    assert main(["study", *args]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert (printed.err.count("\n"), printed.out) == (1, "")
    assert not out.exists()


@pytest.mark.parametrize(
    ("given", "controls"), [([], False), (["--no-controls"], False), (["--controls"], True)]
)
def test_controls_is_a_flag_that_replaces_what_the_file_states(
    tmp_path: Path, given: list[str], controls: bool
) -> None:
    path = write(tmp_path, TOML)
    study = tyro.cli(Study, args=[str(path), "--out", "out", *given])
    assert read_settings(path, {"controls": study.controls}).controls is controls
