"""The encoder of a trained predictor, reused to read the rasters of a policy."""

from typing import Any

from torch import Tensor, nn

from asp_env.data.predictor import load_predictor
from asp_env.errors import AspEnvError
from asp_env.views import make_raster_view
from policies.settings import EnvironmentSettings


class TrainedEncoder(nn.Module):
    """A predictor's encoder of rasters, for rasters with values in [0, 1]."""

    def __init__(self, encoder: Any) -> None:
        """Takes the layers of an encoder.

        Args:
            encoder: with a `body` for rasters (B, channels, height, width), and layers `ahead`
                that follow it.
        """
        super().__init__()
        self.body, self.ahead = encoder.body, encoder.ahead

    def forward(self, rasters: Tensor) -> Tensor:
        """Returns the features (B, features)."""
        return self.ahead(self.body(rasters))


def trained_encoder(name: str, settings: EnvironmentSettings) -> TrainedEncoder:
    """The encoder of a trained predictor.

    Args:
        name: `NAME:RUN` of a predictor that reads rasters.
        settings: the environment of the policy, whose rasters must be those of the predictor.

    Raises:
        AspEnvError: the predictor has no encoder of rasters, or reads other rasters.
    """
    predictor: Any = load_predictor(name, horizon=1, dt_s=settings.dt_s)
    encoder = getattr(getattr(predictor, "network", None), "encoder", None)
    if not hasattr(encoder, "body"):
        raise AspEnvError(
            f"encoder {name}: the predictor has no encoder of rasters; name one that was trained "
            "on a view that draws rasters"
        )
    assert settings.view is not None
    view, own = predictor.view, make_raster_view(settings.view, pixels=settings.raster_px)
    if (view.name, view.shape) != (own.name, own.shape):
        raise AspEnvError(
            f"encoder {name} reads rasters {view.shape} of the view {view.name}, the policy "
            f"observes {own.shape} of {own.name}; give the same --view and --raster-px"
        )
    return TrainedEncoder(encoder)
