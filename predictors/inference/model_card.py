"""The model card of a run: a `README.md` with a header that model hubs read."""

import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from asp_env.data.classes import PREDICTED, AgentClass
from predictors.models.network import AbstractNetwork

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
"""The paper of each predictor."""

HISTORIES = MappingProxyType(
    {
        "recorded": "as in the files, which may be smoothed with later frames that a vehicle does "
        "not have",
        "causal": "filtered forward from noisy positions, without later frames",
        "accelerations": "as recorded, with the recorded accelerations in past actions",
    }
)
"""What the option `history` of a training means."""


def model_card(config: dict[str, Any], network: type[AbstractNetwork], *, weights: str) -> str:
    """Writes the card of a run; equal configurations give equal text.

    Args:
        config: The content of the run's `config.json`. Facts that are missing there are omitted.
        network: The network's class; the docstring of its module describes the predictor.
        weights: The first digits of the hash of its weights.

    Returns:
        Markdown.
    """
    name, horizon_s = config["predictor"], config["horizon"] * config["dt_s"]
    lines = [
        *_header(config),
        f"# {name}, {horizon_s:g} s",
        "",
        *_description(name, network),
        "",
        *_table(_facts(config, weights)),
        "",
        "```",
        f"asp-env evaluate DATA --predictors {name}:RUN --horizon {horizon_s:g} --out evaluated",
        f"asp-env export {name}:RUN --out {name}.onnx",
        "```",
        "",
        "RUN is this folder. Nothing in it is unpickled.",
        "",
        "## Training data",
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
        "The weights are subject to the terms of the recordings that they were trained on. For "
        "recordings under CC BY-NC-SA, for instance, the weights are for non-commercial use, with "
        "attribution and under the same terms. The program is under the MIT licence.",
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


def _description(name: str, network: type[AbstractNetwork]) -> Iterator[str]:
    """The first two paragraphs of the docstring of the network's module, and the paper."""
    docstring = sys.modules[network.__module__].__doc__ or ""
    for paragraph in docstring.strip().split("\n\n")[:2]:
        yield from (paragraph, "")
    if name in PAPERS:
        yield f"Paper: {PAPERS[name]}."


def _facts(config: dict[str, Any], weights: str) -> dict[str, object]:
    dt_s, history = config["dt_s"], config["history"]
    training = config["provenance"].get("config", {})
    classes = [kind.name.lower() for kind in AgentClass if kind in PREDICTED]
    standing = " and one that stands" if config["network"].get("standing") else ""
    return {
        "recipe": training.get("preset"),
        "view": f"`{json.dumps(config['view'], sort_keys=True)}`",
        "history": f"{history * dt_s:g} s: {history} ticks of {dt_s:g} s",
        "forecast": f"{config['network'].get('modes')} modes{standing} of {config['horizon']} "
        f"ticks of {dt_s:g} s ({config['horizon'] * dt_s:g} s) and their probabilities",
        "agent classes": ", ".join(classes),
        "network": f"`{json.dumps(config['network'], sort_keys=True)}`",
        "weights": f"SHA-256 `{weights}…`",
    }


def _data(provenance: dict[str, Any]) -> dict[str, object]:
    trained_on, training = provenance["trained_on"], provenance.get("config", {})
    parts, snippets = Counter(trained_on["parts"].values()), provenance.get("snippets", {})
    validation, history = training.get("validation"), training.get("history")
    standing_share = training.get("standing_share")
    return {
        "data": f"`{trained_on['source']}`",
        "validation data": f"`{', '.join(validation)}`" if validation else None,
        "split": trained_on["split"],
        "recordings": _counts(parts),
        "snippets": _counts(snippets),
        "standing targets": None
        if standing_share is None
        else f"at most {standing_share:g} of the training snippets",
        "histories": None if history is None else f"{history}: {HISTORIES.get(history, '')}",
        "hash of the data": provenance.get("data_hash"),
    }


def _counts(counts: Mapping[str, int]) -> str | None:
    return ", ".join(f"{count} {part}" for part, count in sorted(counts.items())) or None


def _recipe(provenance: dict[str, Any]) -> dict[str, object]:
    elsewhere = {
        *("view", "pixels", "network", "predictor", "preset", "history", "validation", "split")
    }
    training = provenance.get("config", {})
    best = provenance.get("best_value")
    return {
        **{field: value for field, value in sorted(training.items()) if field not in elsewhere},
        "initial weights": provenance.get("start"),
        "processes": provenance.get("processes"),
        "trained prediction epochs": provenance.get("trained_epochs"),
        "best epoch": provenance.get("best_epoch"),
        "selected by": None
        if best is None
        else f"{best:.4g} m, the lowest of all epochs, counted from 0: the mean distance of "
        "the most probable mode from the recorded position at the last tick, over validation "
        "snippets that move (over 1 m/s now, or over 2 m away at a future tick)",
        "versions": ", ".join(
            f"{name} {number}" for name, number in sorted(provenance.get("versions", {}).items())
        )
        or None,
    }


def _limits(config: dict[str, Any]) -> Iterator[str]:
    history_s = config["history"] * config["dt_s"]
    yield (
        f"- Forecasts vehicles that are observed throughout the last {history_s:g} s, at ticks of "
        f"{config['dt_s']:g} s; bicycles, pedestrians, animals and trailers are not forecast."
    )
    yield (
        "- Trained on the locations, traffic and sensors named above. Its errors elsewhere are "
        "unknown: evaluate it there first."
    )
    yield (
        f"- Probabilities are calibrated by a temperature, {config['temperature']:.4g}, on the "
        "validation data; on other data they may be overconfident."
    )
    yield "- Not tested for use in a vehicle."


def _table(facts: Mapping[str, object]) -> Iterator[str]:
    yield "| | |"
    yield "|---|---|"
    for name, value in facts.items():
        if value is not None:
            yield f"| {name.replace('_', ' ')} | {str(value).replace('|', '/')} |"
