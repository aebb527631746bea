"""A module that cannot be imported."""

raise RuntimeError("licence expired")
