"""Views: scenes as arrays for a network, as rasters or as vectors."""

from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.draw import fill_box, fill_segment
from asp_env.views.factory import (
    ViewPlug,
    ViewVariant,
    make_raster_view,
    make_view,
    raster_view_names,
    view_from_config,
    view_names,
    with_history,
)
from asp_env.views.mtp import MTP
from asp_env.views.raster import PlacedScene, Viewport, place_targets, raster_memory
from asp_env.views.vectors import (
    AGENT_FIELDS,
    LINE_FIELDS,
    VectorBounds,
    Vectors,
    VectorShape,
    VectorView,
)
from asp_env.views.view import BinaryView, RasterView, RenderInput, SceneView

__all__ = [
    "AGENT_FIELDS",
    "LINE_FIELDS",
    "MTP",
    "BinaryView",
    "ChauffeurNet",
    "PlacedScene",
    "RasterView",
    "RenderInput",
    "SceneView",
    "VectorBounds",
    "VectorShape",
    "VectorView",
    "Vectors",
    "ViewPlug",
    "ViewVariant",
    "Viewport",
    "fill_box",
    "fill_segment",
    "make_raster_view",
    "make_view",
    "place_targets",
    "raster_memory",
    "raster_view_names",
    "view_from_config",
    "view_names",
    "with_history",
]
