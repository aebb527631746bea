"""The result type of all metrics: values with a mask."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.errors import AspEnvError


@dataclass(frozen=True, slots=True, kw_only=True)
class Masked:
    """Values and a mask of where they are defined. Invalid values must not enter any average."""

    value: Float[np.ndarray, "*shape"]
    valid: Bool[np.ndarray, "*shape"]

    def __post_init__(self) -> None:
        """Checks that the valid values are finite.

        Raises:
            AspEnvError: a valid value is NaN or infinite.
        """
        if not np.isfinite(self.value[self.valid]).all():
            raise AspEnvError("a metric gave a value that is not finite for valid input")
