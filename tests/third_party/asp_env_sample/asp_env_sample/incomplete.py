"""A predictor that fails when it is made, and one that lacks most of what a predictor has."""

from typing import Any


class Incomplete:
    """Has only a name."""

    name = "sample-incomplete"

    @classmethod
    def from_name(cls, argument: str, **_: Any) -> "Incomplete":
        """Fails with the argument `fail`."""
        if argument == "fail":
            raise KeyError("weights")
        return cls()
