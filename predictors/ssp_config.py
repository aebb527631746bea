"""What decides an SSP-ASP: `predictors.ssp_asp` tells what its parts are."""

from dataclasses import dataclass

from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from predictors.network import NetworkConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class SSPASPConfig(NetworkConfig):
    """What decides the network and its loss; the defaults are the paper's."""

    gru_width: int = 512
    gru_layers: int = 2
    skip: bool = False
    """Whether the features, the present speed and the past actions also reach γ's output."""
    hidden: int = 0
    """Width of a hidden layer before γ's output; 0 for none, as in the paper."""
    integrator: Integrator = "euler"
    normalise: bool = False
    """Whether features are normalised where they are made, before all that reads them."""
    stop_gradient: bool = False
    """Whether the encoded features of the segment to come are a fixed target for ψ."""
    ema: float = 0.0
    """How slowly a second encoder follows φ to make that target instead, such as 0.99; 0: none."""
    encoded_branch: bool = True
    """Whether γ also learns on encoded features of the segment to come."""
    scheduled: bool = False
    """Whether, in training, ever more later segments follow the most probable mode of the one
    before in place of the one matched to the label."""
    kept: int = 0
    """Of all modes, how many a forecast keeps: those that most of the others run near, apart from
    each other, as the mean and with the probability of what is near. 0 keeps every mode, or in a
    beam the most probable chains."""
    spread_mps: float = 0.4
    """How near that is, for each second ahead: the standard deviation in `chaining.merge`."""
    action_weight: float = 1.0
    """w1, of the reconstruction of actions."""
    feature_weight: float = 1.0
    """w2, of the mismatch of features."""
    regression_weight: float = 1.0
    """w3."""
    classification_weight: float = 1.0
    """w4."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive, `kept` is negative, or `ema` is not in [0, 1).
        """
        self.check_positive("features", "modes", "gru_width", "gru_layers")
        if self.kept < 0 or not self.spread_mps > 0:
            raise AspEnvError(
                f"network: kept is {self.kept} and spread_mps {self.spread_mps}, expected 0 or "
                "more and a positive number"
            )
        if self.hidden < 0 or not 0 <= self.ema < 1:
            raise AspEnvError(
                f"network: hidden is {self.hidden} and ema {self.ema}, expected 0 or more and "
                "within [0, 1)"
            )
