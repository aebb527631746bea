"""What an agent is shown: pictures, vectors, action history, state and route, in any choice."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.observed import ActionsPart, PicturePart, RoutePart, Spaces, StatePart, VectorsPart
from asp_env.sim.sight import Sight
from asp_env.sim.world import Events
from asp_env.views import VIEWS, PictureView, make_picture_view
from asp_env.views.vectors import VectorView

PICTURES = tuple(name for name in VIEWS if not name.startswith("vectors"))
"""Views that can be asked for by name, beside the raster."""

KNOWN = ("raster", "vectors", "actions", "state", "route", *PICTURES)

Observation = dict[str, Shaped[np.ndarray, "t ..."]]
"""One array per part, with those who see first."""


@runtime_checkable
class Part(Protocol):
    """One kind of observation, which fills one or several parts of the whole."""

    @property
    def history(self) -> int:
        """Past ticks that it needs."""
        ...

    @property
    def spaces(self) -> Spaces:
        """The space of each part, for one target."""
        ...

    def write(self, sight: Sight, events: Events, out: Observation) -> None:
        """What each target sees, into the parts' arrays of `out`."""
        ...


class Observer:
    """Turns what is seen into observations; draws nothing that is not asked for."""

    def __init__(self, names: Sequence[str], raster: PictureView, history: int) -> None:
        """An observer of the named kinds of observation.

        Args:
            names: some of `KNOWN`.
            raster: what draws the part `raster`.
            history: past ticks of what will be seen.

        Raises:
            AspEnvError: a name is unknown or given twice, there is none, or the history is shorter
                than one of them needs.
        """
        if isinstance(names, str) or not len(names):
            given = f"observations {names!r}" if names else "no observation given"
            raise AspEnvError(f"{given}: expected some of {', '.join(KNOWN)}")
        self._parts: list[Part] = []
        for name in names:
            if name not in KNOWN:
                raise unknown_name("observation", name, KNOWN)
            part = _make(name, raster, history)
            if part.history > history:
                raise AspEnvError(
                    f"observation {name!r} needs {part.history} past ticks, there are {history}: "
                    "choose a shorter time step"
                )
            self._parts.append(part)
        if len(set(names)) < len(names):
            raise AspEnvError(f"observations {', '.join(names)}: name each once")
        boxes = {name: box for part in self._parts for name, box in part.spaces.items()}
        self.space = spaces.Dict(list(boxes.items()))
        self._shapes = {name: (box.shape, box.dtype) for name, box in boxes.items()}

    def memory(self, count: int) -> Observation:
        """Fresh memory for what `count` targets see."""
        return {
            name: np.empty((count, *shape), dtype=dtype)
            for name, (shape, dtype) in self._shapes.items()
        }

    def observe(self, sight: Sight, events: Events, out: Observation | None = None) -> Observation:
        """What each target sees.

        Args:
            sight: of all targets.
            events: of the same targets, row by row.
            out: from `memory`, to write into; its former content does not matter. Fresh memory
                where it is not given.
        """
        out = self.memory(len(sight.targets)) if out is None else out
        for part in self._parts:
            part.write(sight, events, out)
        return out


def _make(name: str, raster: PictureView, history: int) -> Part:
    if name == "raster":
        return PicturePart(name, raster)
    if name == "vectors":
        return VectorsPart(VectorView())
    if name == "actions":
        return ActionsPart(history)
    if name == "state":
        return StatePart()
    if name == "route":
        return RoutePart()
    return PicturePart(name, make_picture_view(name))
