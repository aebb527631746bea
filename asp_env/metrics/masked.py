"""A value never travels without its mask."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.errors import AspEnvError


@dataclass(frozen=True, slots=True, kw_only=True)
class Masked:
    """Values, and where they mean something. Invalid values are neither 0 nor 1: skip them."""

    value: Float[np.ndarray, "*shape"]
    valid: Bool[np.ndarray, "*shape"]

    def __post_init__(self) -> None:
        """Checks that the valid values are finite.

        Raises:
            AspEnvError: a valid value is NaN or infinite.
        """
        if not np.isfinite(self.value[self.valid]).all():
            raise AspEnvError("a metric gave a value that is not finite for valid input")
