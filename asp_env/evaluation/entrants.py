"""The predictors that a run compares: loaded, checked, and told apart by short names."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import PurePath

from asp_env.data.predictor import Predictor, load_predictor
from asp_env.errors import AspEnvError


def load_predictors(names: Sequence[str], *, horizon: int, dt_s: float) -> list[Predictor]:
    """The predictors of some names, each of which forecasts at least `horizon` ticks.

    Raises:
        AspEnvError: there is none, one is named twice, or one forecasts less.
    """
    if not names:
        raise AspEnvError("--predictors: none given; expected at least one, such as oracle")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise AspEnvError(f"--predictors: {name} is named {count} times; name it once")
    predictors = [load_predictor(name, horizon=horizon, dt_s=dt_s) for name in names]
    for name, predictor in zip(names, predictors, strict=True):
        if predictor.horizon < horizon:
            raise AspEnvError(
                f"{name} forecasts {predictor.horizon * dt_s:g} s, less than --horizon "
                f"{horizon * dt_s:g}"
            )
    return predictors


def short_names(names: Sequence[str]) -> dict[str, str]:
    """By full name: without its folder, or with what of the folder tells it from the others."""
    found = {name: name.partition(":")[0] for name in names}
    found = _lengthen(found, lambda name: PurePath(name.partition(":")[2]).name)
    return _lengthen(found, lambda name: name.partition(":")[2].strip("/").replace("/", "-"))


def _lengthen(short: dict[str, str], add: Callable[[str], str]) -> dict[str, str]:
    taken = Counter(short.values())
    return {
        name: f"{name.partition(':')[0]} {add(name)}".strip() if taken[label] > 1 else label
        for name, label in short.items()
    }
