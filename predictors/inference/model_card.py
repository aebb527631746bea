"""The model card of a run: a `README.md` for people, with a header that model hubs read."""

import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from asp_env.data.classes import PREDICTED, AgentClass
from predictors.models.network import LearnedPlug

PAPERS: Mapping[str, str] = MappingProxyType(
    {
        "mtp": "H. Cui et al., Multimodal Trajectory Predictions for Autonomous Driving using Deep "
        "Convolutional Networks, ICRA 2019, arXiv:1809.10732",
        "dkm": "H. Cui et al., Deep Kinematic Models for Kinematically Feasible Vehicle Trajectory "
        "Predictions, ICRA 2020, arXiv:1908.00219",
        **dict.fromkeys(
            ("ffw-asp", "ssp-asp"),
            "F. Janjoš, M. Dolgov, J. M. Zöllner, Self-Supervised Action-Space Prediction for "
            "Automated Driving, IV 2021, arXiv:2109.10024",
        ),
    }
)
"""By predictor."""

HISTORIES = MappingProxyType(
    {
        "recorded": "as in the files, which may be smoothed with what came after: more than a "
        "vehicle has",
        "causal": "filtered forward on noisy positions, so that nothing of the future is in them",
    }
)


def model_card(config: dict[str, Any], plug: LearnedPlug, *, weights: str) -> str:
    """The text of a run's card; the same for the same configuration.

    Args:
        config: the content of the run's `config.json`. What it does not say is left out.
        plug: of the predictor.
        weights: the first digits of the hash of its weights.
    """
    name, horizon_s = plug.name, config["horizon"] * config["dt_s"]
    lines = [
        *_header(config),
        f"# {name}, {horizon_s:g} s",
        "",
        *_what(plug),
        "",
        *_table(_facts(config, weights)),
        "",
        "```",
        f"asp-env evaluate DATA --predictors {name}:RUN --horizon {horizon_s:g} --out judged",
        f"asp-env export {name}:RUN --out {name}.onnx",
        "```",
        "",
        "RUN is this folder. Nothing in it is unpickled.",
        "",
        "## Trained on",
        "",
        *_table(_data(config["provenance"])),
        "",
        "## Recipe",
        "",
        *_table(_recipe(config["provenance"])),
        "",
        "## Limits",
        "",
        *_limits(config),
        "",
        "## Terms",
        "",
        "The weights carry the terms of the recordings that they were trained on: those of "
        "recordings under CC BY-NC-SA, for instance, are for non-commercial use, name their source "
        "and are passed on under the same terms. The program is under the MIT licence.",
    ]
    return "\n".join(lines) + "\n"


def _header(config: dict[str, Any]) -> Iterator[str]:
    yield "---"
    yield "library_name: asp-env"
    yield "license: other"
    yield "license_name: terms-of-the-training-data"
    yield "tags:"
    tags = ("trajectory-prediction", "motion-forecasting", "autonomous-driving")
    for tag in (*tags, config["predictor"], config["view"]["name"]):
        yield f"- {json.dumps(tag)}"
    yield "---"
    yield ""


def _what(plug: LearnedPlug) -> Iterator[str]:
    """The first two paragraphs of the predictor's own documentation."""
    told = (sys.modules[plug.network.__module__].__doc__ or "").strip().split("\n\n")
    for paragraph in told[:2]:
        yield from (paragraph, "")
    if plug.name in PAPERS:
        yield f"After {PAPERS[plug.name]}."


def _facts(config: dict[str, Any], weights: str) -> dict[str, object]:
    dt_s, history = config["dt_s"], config["history"]
    training = config["provenance"].get("config", {})
    classes = [kind.name.lower() for kind in AgentClass if kind in PREDICTED]
    return {
        "preset": training.get("preset"),
        "sees": f"view `{json.dumps(config['view'], sort_keys=True)}`",
        "needs": f"{history * dt_s:g} s of history: {history} ticks of {dt_s:g} s",
        "says": f"{config['network'].get('modes')} modes of {config['horizon']} ticks of {dt_s:g} s"
        f" ({config['horizon'] * dt_s:g} s) and their probabilities",
        "of": ", ".join(classes),
        "network": f"`{json.dumps(config['network'], sort_keys=True)}`",
        "weights": f"SHA-256 `{weights}…`",
    }


def _data(provenance: dict[str, Any]) -> dict[str, object]:
    trained_on, training = provenance["trained_on"], provenance.get("config", {})
    parts, snippets = Counter(trained_on["parts"].values()), provenance.get("snippets", {})
    dealt = [f"{count} {part}" for part, count in sorted(parts.items())]
    history = training.get("history")
    return {
        "data": f"`{trained_on['source']}`",
        "validation data": None if not (other := training.get("validation")) else f"`{other}`",
        "split": trained_on["split"],
        "recordings": ", ".join(dealt) or None,
        "snippets": ", ".join(f"{count} {part}" for part, count in sorted(snippets.items()))
        or None,
        "standing targets": None
        if (share := training.get("standing_share")) is None
        else f"at most {share:g} of the training snippets",
        "histories": None if history is None else f"{history}: {HISTORIES.get(history, '')}",
        "hash of the data": provenance.get("data_hash"),
    }


def _recipe(provenance: dict[str, Any]) -> dict[str, object]:
    shown = ("view", "pixels", "network", "predictor", "preset", "history", "validation", "split")
    training = provenance.get("config", {})
    best = provenance.get("best_value")
    return {
        **{field: value for field, value in sorted(training.items()) if field not in shown},
        "started from weights": provenance.get("start"),
        "processes": provenance.get("processes"),
        "best epoch": provenance.get("best_epoch"),
        "selected by": None
        if best is None
        else f"{best:.4g} m, the lowest of all epochs, counted from 0: on validation snippets that "
        "move (over 1 m/s now, or over 2 m away at a tick to come), the mean distance of the most "
        "probable mode from the recorded position at the last tick",
        "versions": ", ".join(
            f"{name} {number}" for name, number in sorted(provenance.get("versions", {}).items())
        )
        or None,
    }


def _limits(config: dict[str, Any]) -> Iterator[str]:
    seconds = config["history"] * config["dt_s"]
    yield (
        f"- Forecasts vehicles that were seen throughout the last {seconds:g} s, at ticks of "
        f"{config['dt_s']:g} s; bicycles, pedestrians, animals and trailers are not forecast."
    )
    yield (
        "- Learned from the places, drivers and sensors named above. Elsewhere nothing is known of "
        "its errors: judge it there first."
    )
    yield (
        f"- Probabilities are calibrated by a temperature, {config['temperature']:.4g}, on the "
        "validation data; on other data they may be too sure."
    )
    yield "- Not tested for use in a vehicle."


def _table(facts: Mapping[str, object]) -> Iterator[str]:
    yield "| | |"
    yield "|---|---|"
    for name, value in facts.items():
        if value is not None:
            yield f"| {name.replace('_', ' ')} | {str(value).replace('|', '/')} |"
