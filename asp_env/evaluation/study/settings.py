"""What a study drives: from a TOML file, from options, or from both."""

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.errors import AspEnvError, unknown_name
from asp_env.evaluation.ladder import BASELINE
from asp_env.evaluation.selection import PartChoice
from asp_env.metrics.driving.rules import DEFAULT_RULES


@dataclass(frozen=True, slots=True, kw_only=True)
class StudySettings:
    """The methods of a study and the conditions that each of them drives in.

    The keys of a TOML file are the names of these fields.
    """

    data: tuple[str, ...]
    """DATA, each as for `asp-env drive`."""
    methods: tuple[str, ...]
    """Methods as for `asp-env benchmark`: PLANNER+PREDICTOR, a predictor alone, which drives with
    `contingency`, or a planner without forecasts. A pattern such as `ffw-asp:runs/*` is one method
    of several training runs."""
    traffic: tuple[str, ...] = ()
    """Drivers of the other agents, each as for `asp-env drive`; the default of each DATA if
    empty."""
    latency_ticks: tuple[int, ...] = (0,)
    """Ticks by which forecasts are late."""
    scenarios: str = ""
    """Filter or file of scenarios; if empty, the frozen list of DATA, or all without one."""
    max_scenarios: int | None = None
    """Largest number of scenarios of each DATA, at even spacing."""
    controls: bool = True
    """Whether the whole ladder of controls drives in replayed traffic without latency."""
    reference: str = BASELINE
    """Predictor that differences refer to; it drives in every condition."""
    horizon_s: float = 3.0
    """Horizon of forecasts and plans."""
    dt_s: float = DEFAULT_DT_S
    """Duration of a tick."""
    part: PartChoice = "auto"
    """Part of DATA, as for `asp-env drive`."""
    rules: str = DEFAULT_RULES
    """Driving rules that define the metrics."""
    budget_ms: float | None = None
    """Largest wall time of a forecast, and of a plan; None for no limit."""

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            AspEnvError: a list is empty or names something twice, or a number is out of range.
        """
        for name in ("data", "methods", "traffic", "latency_ticks"):
            given = getattr(self, name)
            if not given and name != "traffic":
                raise AspEnvError(f"study: no {name} given, expected at least one")
            twice = next((each for each in given if given.count(each) > 1), None)
            if twice is not None:
                raise AspEnvError(f"study: {name} has {twice!r} twice, expected it once")
        if min(self.latency_ticks) < 0:
            raise AspEnvError(
                f"study: latency_ticks {min(self.latency_ticks)}, expected 0 ticks or more"
            )
        for name in ("max_scenarios", "horizon_s", "dt_s", "budget_ms"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise AspEnvError(f"study: {name} {value:g}, expected a finite number above 0")

    def as_json(self) -> dict[str, Any]:
        """The settings as plain values."""
        return dataclasses.asdict(self)


def read_settings(path: Path | None, options: Mapping[str, Any]) -> StudySettings:
    """Reads settings; options replace what the file states.

    Args:
        path: a TOML file, or None for options alone.
        options: values by field of `StudySettings`; None for those that are not given.

    Raises:
        AspEnvError: the file cannot be read, or a key or a value is bad.
    """
    values = {} if path is None else _read_toml(path)
    known = {field.name: field for field in dataclasses.fields(StudySettings)}
    for name in values:
        if name not in known:
            raise AspEnvError(f"{path}: {unknown_name('key', name, known)}")
    values |= {name: value for name, value in options.items() if value is not None}
    missing = [name for name in ("data", "methods") if name not in values]
    if missing:
        where = "give a TOML file or options" if path is None else f"add them to {path}"
        raise AspEnvError(f"study: no {' and no '.join(missing)}: {where}")
    return StudySettings(**{name: _checked(name, value) for name, value in values.items()})


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise AspEnvError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise AspEnvError(f"{path}: not a TOML file: {error}") from error


_LISTS = {"data": str, "methods": str, "traffic": str, "latency_ticks": int}
_TEXTS = ("scenarios", "reference", "part", "rules")
_NUMBERS = ("horizon_s", "dt_s", "budget_ms")


def _checked(name: str, value: Any) -> Any:
    """A value with the type of its field."""
    if name in _LISTS:
        items = [value] if isinstance(value, str | int) else value
        kind = _LISTS[name]
        if not isinstance(items, list | tuple) or any(type(each) is not kind for each in items):
            raise AspEnvError(f"study: {name} {value!r}, expected a list of {kind.__name__}")
        return tuple(items)
    if name in _TEXTS:
        good = isinstance(value, str)
    elif name == "controls":
        good = isinstance(value, bool)
    elif name in _NUMBERS:
        good = value is None or type(value) in (int, float)
    else:
        good = value is None or type(value) is int
    if not good:
        raise AspEnvError(f"study: {name} {value!r} has a wrong type, see asp-env study --help")
    return float(value) if name in _NUMBERS and value is not None else value
