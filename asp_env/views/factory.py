"""The registry of views, and views made by name or from a stored configuration."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from asp_env.errors import AspEnvError, unknown_name
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.mtp import MTP
from asp_env.views.vectors import VectorView
from asp_env.views.view import RasterView, SceneView


class ViewEntry(NamedTuple):
    """The class of a view and the options for which its name stands."""

    view_class: Any
    options: Mapping[str, Any] = MappingProxyType({})


VIEWS: Mapping[str, ViewEntry] = MappingProxyType(
    {
        "chauffeurnet": ViewEntry(ChauffeurNet),
        "chauffeurnet-no-trail": ViewEntry(ChauffeurNet, {"ego_trail": False}),
        "mtp": ViewEntry(MTP),
        "vectors": ViewEntry(VectorView),
        "vectors-no-trail": ViewEntry(VectorView, {"own_past": False}),
    }
)
"""The views by name. The variants without trail hide a target's own past, for ablations."""


def make_view(name: str, *, pixels: tuple[int, int] | None = None) -> SceneView:
    """Makes the view of the given name in its default extent.

    Args:
        name: one of `VIEWS`.
        pixels: height and width of its rasters; the default of the view if omitted. Not allowed
            for views that render no rasters.

    Raises:
        AspEnvError: the name is unknown (the known names are listed), the pixels would not be
            square, or the view renders no rasters.
    """
    entry = _find_entry(name)
    return entry.view_class.make(pixels, **entry.options)


def make_raster_view(name: str, *, pixels: tuple[int, int] | None = None) -> RasterView:
    """Makes the view of the given name, which must render rasters.

    Args:
        name: one of `VIEWS`.
        pixels: height and width of its rasters; the default of the view if omitted.

    Raises:
        AspEnvError: as for `make_view`, or the view renders no rasters.
    """
    view = make_view(name, pixels=pixels)
    if not isinstance(view, RasterView):
        raise AspEnvError(f"view {name!r} renders no rasters: choose chauffeurnet or mtp")
    return view


def view_from_config(config: Mapping[str, Any]) -> SceneView:
    """Makes the view that a configuration describes.

    Args:
        config: the value of `config()` of a view.

    Raises:
        AspEnvError: its name is unknown (the known names are listed), or a field is wrong.
    """
    return _find_entry(str(config.get("name"))).view_class.from_config(dict(config))


def with_history(view: SceneView, history: int) -> SceneView:
    """Makes the view that shows another number of past ticks.

    Args:
        view: a view; without an option `history` in its configuration it is returned as it is.
        history: number of past ticks, at least one. The view `mtp` shows at most 10 of them.

    Raises:
        AspEnvError: the number is not positive, or the view always shows more past ticks.
    """
    config = view.config()
    if "history" in config:
        return view_from_config({**config, "history": history})
    if view.history > history:
        raise AspEnvError(
            f"view {view.name!r} shows {view.history} past ticks, more than the history of "
            f"{history}: take a longer history or another view"
        )
    return view


def _find_entry(name: str) -> ViewEntry:
    if name not in VIEWS:
        raise unknown_name("view", name, VIEWS)
    return VIEWS[name]
