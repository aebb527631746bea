"""The weights that ship with this package: `python -m predictors.experiments.pretrained OUT`.

The command generates traffic of SUMO with measurement errors, trains a predictor on it, selects
the epoch and calibrates on other locations and on traffic of highway-env, and rounds the weights to
half precision. The content of `OUT/pretrained` belongs in `predictors/pretrained`. The same OUT can
be given again, and what is finished is not made again.
"""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from asp_env import registry
from asp_env.evaluation.open_loop.evaluate import RATIO, Evaluate, evaluate
from asp_env.files import atomic_folder
from predictors.inference.checkpoint import (
    CARD,
    CONFIG,
    WEIGHTS,
    hash_of,
    read_config,
    read_weights,
    save_weights,
    weights_hash,
    write_json,
)
from predictors.inference.fit_features import add_feature_distance
from predictors.inference.pretrained import PRETRAINED
from predictors.training.command import Train

MODULE = "predictors.experiments.pretrained"

TRAINING = {
    f"{traffic}-{site}": {"site": site, "traffic": traffic, "minutes": 2.5, **options}
    for traffic, options in {
        "normal": {"recordings": 24, "locations": 24, "seed": 7301},
        "dense": {"recordings": 12, "locations": 12, "seed": 7303},
    }.items()
    for site in ("intersection", "roundabout")
} | {
    f"varied-{site}": {
        "site": site,
        "traffic": "varied",
        "minutes": 2.0,
        "recordings": count,
        "locations": count,
        "seed": 9201,
    }
    for site, count in (("intersection", 48), ("roundabout", 24))
}
"""Options of `asp-env synthesize` by name: many locations of SUMO with one short recording each.
Dense traffic has about twice as many snippets in a minute."""

VALIDATION = {
    "varied-intersection": {"site": "intersection", "traffic": "varied"},
    "varied-roundabout": {"site": "roundabout", "traffic": "varied"},
    "highway-intersection": {"site": "highway:intersection"},
    "highway-roundabout": {"site": "highway:roundabout"},
}
"""The traffic on which the epoch is selected and probabilities and accelerations are calibrated:
other locations of varied traffic, and another generator."""

VALIDATION_OPTIONS = {
    "varied": {"recordings": 10, "locations": 10, "minutes": 2.0, "seed": 9202},
    "highway": {"recordings": 4, "minutes": 3.0, "seed": 8812},
}

FAMILIAR = {
    f"normal-{site}": {
        "site": site,
        "traffic": "normal",
        "recordings": 6,
        "locations": 6,
        "minutes": 2.5,
        "seed": 7302,
    }
    for site in ("intersection", "roundabout")
}
"""Traffic like that of the training at other locations: the guard of the forecasts is fitted on it,
and the card has the errors on it."""

SOURCE = "synthetic traffic"
"""Name of the training data in tables, instead of four folders."""

EPOCHS = 24
"""Epochs of each predictor, instead of the recipe's eight. Chosen by hand: the errors on the
validation data still fall, and a run takes a few minutes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pretrain:
    """Train a predictor whose weights ship with this package."""

    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder of traffic and runs; the result is in OUT/pretrained."""
    predictors: tuple[str, ...] = ("ffw-asp", "ssp-asp")
    """Predictors to train."""
    held_out: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA …")] = ()
    """Recordings whose errors the model card states. Nothing is chosen on them."""

    def run(self) -> None:
        """Generates traffic, trains, evaluates and writes the folders.

        Raises:
            AspEnvError: A package is missing, or the data are bad.
        """
        training = [self._traffic("train", name, options) for name, options in TRAINING.items()]
        familiar = [self._traffic("familiar", name, options) for name, options in FAMILIAR.items()]
        validation = [
            self._traffic("validation", name, VALIDATION_OPTIONS[name.partition("-")[0]] | options)
            for name, options in VALIDATION.items()
        ]
        for name in self.predictors:
            run = self.out / "runs" / name
            if not (run / CONFIG).exists():
                Train(
                    predictor=name,
                    data=tuple(training),
                    validation=tuple(validation),
                    out=run,
                    view="vectors",
                    recipe="robust",
                    epochs=EPOCHS,
                ).run()
            shipped = self.out / PRETRAINED / name
            if not shipped.exists():
                ship(run, shipped, made_in=self.out)
                add_feature_distance(shipped, familiar)
            self._complete_card(name, shipped, {"familiar": familiar, "other traffic": validation})

    def _traffic(self, part: str, name: str, options: Mapping[str, Any]) -> str:
        folder = self.out / "traffic" / f"{part}-{name}"
        if not folder.exists():
            registry.find("commands", "synthesize")(out=folder, noise=True, **options).run()
        return str(folder)

    def _complete_card(
        self, name: str, shipped: Path, generated: Mapping[str, Sequence[str]]
    ) -> None:
        """Adds the command and the errors to the model card."""
        rows = [
            _errors(name, shipped, data, note)
            for note, names in {**generated, "held out": self.held_out}.items()
            for data in names
        ]
        card = (shipped / CARD).read_text().partition(_HEADING)[0].rstrip()
        card = card.replace(_TERMS, "license: mit\n")  # generated data have no terms of their own
        (shipped / CARD).write_text(f"{card}\n\n{_HEADING}{_section(name, self.held_out, rows)}")


_HEADING = "## Pretrained weights\n"
_TERMS = "license: other\nlicense_name: terms-of-the-training-data\n"


def ship(run: Path, shipped: Path, *, made_in: Path) -> None:
    """Copies a finished run with its weights in half precision, which halves their size.

    The name of the training data becomes `SOURCE`, and the folder that all was made in `OUT`.

    Args:
        run: The folder of the run.
        shipped: The folder to create.
        made_in: The folder that the training data are in.

    Raises:
        CheckpointError: The run's weights are missing or damaged.
    """
    with atomic_folder(shipped) as folder:
        config = read_config(run)
        config["provenance"]["trained_on"]["source"] = SOURCE
        config = json.loads(json.dumps(config).replace(f"{made_in}/", "OUT/"))
        weights = read_weights(run / WEIGHTS)
        save_weights({n: each.to(torch.float16) for n, each in weights.items()}, folder / WEIGHTS)
        write_json({**config, "weights_sha256": hash_of(folder / WEIGHTS)}, folder / CONFIG)
        card = (run / CARD).read_text().replace(f"{made_in}/", "OUT/")
        (folder / CARD).write_text(card.replace(weights_hash(run), weights_hash(folder)))


def _errors(name: str, shipped: Path, data: str, note: str) -> str:
    """A row of the card: errors of moving targets on all recordings of some data."""
    names = ("constant-velocity", f"{name}:{shipped}")
    result = evaluate(
        Evaluate(data=data, out=shipped, predictors=names, part="all", planner="none")
    )
    cells = []
    for metric, selection in (
        ("FDE", "most-probable"),
        (RATIO, "most-probable"),
        ("FDE", "best-of-3"),
        (RATIO, "best-of-3"),
    ):
        row = next(
            row
            for row in result.rows
            if (row.predictor, row.metric, row.selection, row.subset)
            == (names[1], metric, selection, "moving")
        )
        cells.append(f"{row.value:.2f} [{row.low:.2f}, {row.high:.2f}]")
    snippets = result.manifest["moving snippets"]
    return f"| {Path(data).name} ({note}) | {snippets} | {' | '.join(cells)} |"


def _section(name: str, held_out: Sequence[str], rows: Sequence[str]) -> str:
    names = [Path(each).name for each in held_out]
    data = f" --held-out {shlex.join(names)}" if names else ""
    lines = [
        "",
        "```",
        f"python -m {MODULE} OUT --predictors {name}{data}",
        "```",
        "",
        "makes this folder (`OUT/pretrained`): it generates normal, dense and varied traffic of "
        "SUMO with measurement errors, trains with augmentation, and rounds the weights to half "
        "precision; the network computes in single precision. The epoch, the probabilities and the "
        "factor on accelerations were chosen on varied traffic at other locations and on traffic "
        "of highway-env. All traffic is generated, so no terms of recordings apply.",
        "",
        "Displacement at 3 s of moving targets, m, and its ratio to constant velocity's, with the "
        "shipped weights; 95 % intervals from a bootstrap over recordings:",
        "",
        "| data | targets | FDE, most probable | ratio | FDE, best of 3 | ratio |",
        "|---|---|---|---|---|---|",
        *rows,
        "",
        "Trained on generated traffic alone, they need not be better than constant velocity "
        "elsewhere.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    tyro.cli(Pretrain).run()
