"""Views by name, from the registry (entry points `asp_env.views`) or a stored configuration."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.vectors import VectorView
from asp_env.views.view import RasterView, SceneView


@runtime_checkable
class ViewPlug(Protocol):
    """The object that an entry point of the group `asp_env.views` names, usually a class of views.

    The `name` of its views is that of the entry point, so that a stored view is found again.
    """

    def make(self, pixels: tuple[int, int] | None = None) -> SceneView:
        """Makes the view in its default extent.

        Args:
            pixels: height and width of its rasters; the default of the view if omitted. Always
                omitted for views that render no rasters.

        Raises:
            AspEnvError: the view cannot be made in this size.
        """
        ...

    def from_config(self, config: dict[str, Any]) -> SceneView:
        """Makes the view that a stored configuration describes.

        Args:
            config: the value of `config()` of the view.

        Raises:
            AspEnvError: a field is wrong.
        """
        ...


class ViewVariant(NamedTuple):
    """A plug that makes a class of views with other options than the class's own defaults."""

    view_class: Any
    options: Mapping[str, Any]

    def make(self, pixels: tuple[int, int] | None = None) -> SceneView:
        """Makes the view in its default extent; see `ViewPlug.make`."""
        return self.view_class.make(pixels, **self.options)

    def from_config(self, config: dict[str, Any]) -> SceneView:
        """Makes the view that a stored configuration describes; see `ViewPlug.from_config`."""
        return self.view_class.from_config(config)


CHAUFFEURNET_NO_TRAIL = ViewVariant(ChauffeurNet, MappingProxyType({"ego_trail": False}))
"""`chauffeurnet-no-trail`: hides a target's own past, for ablations."""

VECTORS_NO_TRAIL = ViewVariant(VectorView, MappingProxyType({"own_past": False}))
"""`vectors-no-trail`: hides a target's own past, for ablations."""


def view_names() -> tuple[str, ...]:
    """The names of all registered views, in alphabetical order."""
    return registry.names("views")


def raster_view_names() -> tuple[str, ...]:
    """The names of the registered views that render rasters, without those that cannot be made."""
    return tuple(name for name in view_names() if _renders_rasters(name))


def make_view(name: str, *, pixels: tuple[int, int] | None = None) -> SceneView:
    """Makes the view of the given name in its default extent.

    Args:
        name: one of `view_names()`.
        pixels: height and width of its rasters; the default of the view if omitted. Not allowed
            for views that render no rasters.

    Raises:
        AspEnvError: the name is unknown (the known names are listed), the registered object is no
            view, the pixels would not be square, or the view renders no rasters.
    """
    return _checked(name, _find_plug(name).make(pixels))


def make_raster_view(name: str, *, pixels: tuple[int, int] | None = None) -> RasterView:
    """Makes the view of the given name, which must render rasters.

    Args:
        name: one of `raster_view_names()`.
        pixels: height and width of its rasters; the default of the view if omitted.

    Raises:
        AspEnvError: as for `make_view`, or the view renders no rasters.
    """
    view = make_view(name, pixels=pixels)
    if not isinstance(view, RasterView):
        raise AspEnvError(
            f"view {name!r} renders no rasters: choose one of {', '.join(raster_view_names())}"
        )
    return view


def view_from_config(config: Mapping[str, Any]) -> SceneView:
    """Makes the view that a configuration describes.

    Args:
        config: the value of `config()` of a view.

    Raises:
        AspEnvError: its name is unknown (the known names are listed), the registered object is no
            view, or a field is wrong.
    """
    name = str(config.get("name"))
    return _checked(name, _find_plug(name).from_config(dict(config)))


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


def _renders_rasters(name: str) -> bool:
    try:
        return isinstance(make_view(name), RasterView)
    except AspEnvError:
        return False


def _find_plug(name: str) -> ViewPlug:
    plug = registry.find("views", name)
    if not isinstance(plug, ViewPlug):
        raise AspEnvError(
            f"view {name!r}: the registered object {plug!r} has no make(pixels) and "
            "from_config(config), which make the view: see docs/views.md"
        )
    return plug


def _checked(name: str, view: Any) -> SceneView:
    """Returns the view if it is one and has the name under which it is registered."""
    if not isinstance(view, SceneView):
        raise AspEnvError(
            f"view {name!r}: {type(view).__name__} lacks a part of SceneView (name, shape, "
            "history, config, render): see docs/views.md"
        )
    if view.name != name:
        raise AspEnvError(
            f"view {name!r} has the name {view.name!r}, under which a stored run would not find "
            "it: give both the same name"
        )
    return view
