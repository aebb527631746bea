"""The settings of a policy: everything that a run folder states about its training."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from asp_env.arguments import MAX_SEED
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.errors import AspEnvError, unknown_name
from asp_env.stored import brief, check_fields, parse_json

Algorithm = Literal["ppo", "sac", "recurrent-ppo", "bc"]
ALGORITHMS: tuple[str, ...] = get_args(Algorithm)

CONFIG = "config.json"

REWARD_WEIGHTS = {"collision": 2.0, "comfort": 0.02, "goal": 1.0, "route": 0.1}
"""Weights of the reward in training, where they differ from those of the environment. Chosen by
hand on the training and validation places of docs/rl.md: `goal` makes slow driving as bad as
standing, and a collision costs more than the progress that it saves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentSettings:
    """What a policy observes, what its actions mean, and what it is rewarded for."""

    scenarios: str = ""
    """Filter of the scenarios for training."""
    traffic: str | None = None
    """Driver of the other agents; that of the world by default."""
    dt_s: float = DEFAULT_DT_S
    action_type: str = "route"
    action_repeat: int = 3
    """Ticks for which an action is held."""
    reward_weights: Mapping[str, float] = field(default_factory=lambda: dict(REWARD_WEIGHTS))
    predictor: str | None = None
    """Name of the predictor whose forecasts are observed."""
    forecast: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `asp_env.envs.ForecastOptions` that differ from the defaults."""
    neighbours: int = 8
    """Number of nearest agents that are observed."""
    map_lines: int = 0
    """Number of pieces of lane centre lines, curbs and markings that are observed."""
    view: str | None = None
    """View whose rasters are observed in place of neighbours and lines."""
    raster_px: tuple[int, int] | None = None
    """Height and width of the rasters; the view's own by default."""

    def __post_init__(self) -> None:
        """Checks numbers.

        Raises:
            AspEnvError: a number is out of range.
        """
        if not 1 <= self.neighbours <= MAX_NEIGHBOURS:
            raise AspEnvError(f"neighbours {self.neighbours}: expected 1 to {MAX_NEIGHBOURS}")
        if not 0 <= self.map_lines <= MAX_MAP_LINES:
            raise AspEnvError(f"map_lines {self.map_lines}: expected 0 to {MAX_MAP_LINES}")
        if self.forecast and self.predictor is None:
            raise AspEnvError(
                f"forecast {', '.join(self.forecast)}: there are no forecasts without a predictor; "
                "name one, such as constant-velocity"
            )
        if self.raster_px is not None and self.view is None:
            raise AspEnvError(
                f"raster_px {self.raster_px}: there are no rasters without a view; name one, such "
                "as chauffeurnet"
            )


MAX_NEIGHBOURS = 15
"""The vectors show the target and 15 others."""

MAX_WIDTH = 4_096
"""Largest width of the layers, which bounds the memory. Chosen by hand."""

MIN_RASTER_PX = 36
"""Smallest side of rasters: the convolutions of the policy leave one pixel of it."""

MAX_MAP_LINES = 64
"""The vectors show 64 pieces of lines."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySettings:
    """A policy: an algorithm, its environment, and its numbers."""

    algorithm: str = "ppo"
    """One of `ALGORITHMS`."""
    data: str = "sample:intersection"
    """The data that the policy is trained on."""
    environment: EnvironmentSettings = field(default_factory=EnvironmentSettings)
    steps: int = 400_000
    """Steps of training, of `action_repeat` ticks each, summed over the environments."""
    num_envs: int = 64
    seed: int = 0
    width: int = 64
    """Width of the layers of the network."""
    encoder: str | None = None
    """Trained predictor whose encoder of rasters is reused, as `NAME:RUN`."""
    gamma: float = 0.9
    learning_rate: float = 6e-4
    """At the start of the training; it falls linearly to a twentieth."""
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the algorithm's class that differ from `DEFAULTS`."""
    normalize_reward: bool = True
    """Divides rewards by the deviation of their discounted sum (`VecNormalize`)."""
    curriculum: str | None = None
    """Column of the scenarios, such as `-pet_behind_s` for easy ones with a large time gap first;
    the share that is drawn grows from 0.3 to 1 over the first half of the training."""
    demonstrations: int = 0
    """Epochs of behaviour cloning of the logged drivers before the training; for `bc` they are the
    training."""

    def __post_init__(self) -> None:
        """Checks numbers and names.

        Raises:
            AspEnvError: a number is out of range, or a name is unknown.
        """
        if self.algorithm not in ALGORITHMS:
            raise unknown_name("algorithm", self.algorithm, ALGORITHMS)
        self._check_numbers()
        if self.algorithm == "bc" and not self.demonstrations:
            raise AspEnvError(
                "algorithm bc, behaviour cloning: give the number of epochs, such as "
                "demonstrations=30"
            )
        if self.demonstrations and self.algorithm not in ("ppo", "bc"):
            raise AspEnvError(
                f"demonstrations {self.demonstrations}: only ppo can start from them, and bc"
            )
        if self.encoder is not None and self.environment.view is None:
            raise AspEnvError(
                f"encoder {self.encoder}: it reads rasters; name the view that it was trained with"
            )
        raster_px = self.environment.raster_px
        if self.encoder is None and raster_px is not None and min(raster_px) < MIN_RASTER_PX:
            raise AspEnvError(f"raster_px {raster_px}: expected at least {MIN_RASTER_PX} each")

    def _check_numbers(self) -> None:
        for name, least in (("steps", 1), ("num_envs", 1), ("width", 1), ("demonstrations", 0)):
            if getattr(self, name) < least:
                raise AspEnvError(f"{name} {getattr(self, name)}: expected at least {least}")
        if self.width > MAX_WIDTH:
            raise AspEnvError(f"width {self.width}: expected at most {MAX_WIDTH:,}")
        if not 0.0 <= self.gamma < 1.0:
            raise AspEnvError(f"gamma {self.gamma}: expected at least 0 and less than 1")
        if not 0.0 < self.learning_rate <= 1.0:
            raise AspEnvError(
                f"learning_rate {self.learning_rate}: expected a positive number of at most 1"
            )
        if not 0 <= self.seed <= MAX_SEED:
            raise AspEnvError(f"seed {self.seed}: expected 0 to {MAX_SEED}")

    def to_json(self) -> str:
        """The settings as JSON."""
        return json.dumps(dataclasses.asdict(self), indent=1)


DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "ppo": {"n_steps": 32, "batch_size": 1024, "n_epochs": 10, "gae_lambda": 0.9},
    "bc": {},
    "recurrent-ppo": {"n_steps": 32, "batch_size": 1024, "n_epochs": 5, "gae_lambda": 0.9},
    "sac": {
        "batch_size": 512,
        "buffer_size": 200_000,
        "learning_starts": 5_000,
        "train_freq": 1,
        "gradient_steps": 4,
        "ent_coef": "auto_0.1",
    },
}
"""Arguments of the algorithms' classes. Chosen by hand on validation places."""


def read_settings(folder: Path) -> PolicySettings:
    """Reads the settings of a run folder.

    Raises:
        AspEnvError: the folder holds no run of a policy, or its settings are damaged.
    """
    path = folder / CONFIG
    try:
        content = parse_json(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        raise AspEnvError(
            f"{folder}: no run of a policy there ({CONFIG} is missing); train one with "
            "asp-env rl train"
        ) from None
    except (OSError, ValueError) as error:
        raise AspEnvError(f"{path}: damaged ({brief(error)}); train the policy again") from None
    return settings_from(content.get("settings") if isinstance(content, dict) else None, path)


def settings_from(content: Any, path: Path) -> PolicySettings:
    """Makes settings from the content of a file.

    Raises:
        AspEnvError: a field is missing or unknown.
    """
    try:
        fields = dict(content)
        environment = dict(fields.pop("environment"))
        check_fields(EnvironmentSettings, environment)
        check_fields(PolicySettings, fields)
        pixels = environment.pop("raster_px", None)
        return PolicySettings(
            environment=EnvironmentSettings(
                raster_px=None if pixels is None else (int(pixels[0]), int(pixels[1])),
                **environment,
            ),
            **fields,
        )
    except (TypeError, KeyError, ValueError) as error:
        raise AspEnvError(
            f"{path}: not the settings of a policy ({type(error).__name__}: {brief(error)}); "
            "train the policy again"
        ) from None
