"""Features extractors of stable-baselines3 for the observations of policies.

`TrafficFeatures` reads neighbours, lines and forecasts as tokens; `RasterFeatures` reads rasters.
Both divide what they read by fixed scales, so that no statistics of observations are needed.
"""

from collections.abc import Mapping

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from asp_env.sim.observation import ROUTE_STEP_M
from asp_env.views.vectors import AGENT_FIELDS, LINE_FIELDS
from policies.observations import NEIGHBOUR_FIELDS, STATE

STATE_SCALES = {
    "speed_mps": 10.0,
    "acceleration_mps2": 3.0,
    "steering_rad": 0.3,
    "route_offset_m": 2.0,
    "route_heading_error_rad": 0.5,
    "length_m": 5.0,
    "width_m": 2.0,
}
"""Divisors of the fields of `state`. Chosen by hand."""

AGENT_SCALES = {"x": 20.0, "y": 20.0, "speed": 10.0, "length": 5.0, "width": 2.0}
"""Divisors of the fields of agents; 1 for the others. Chosen by hand."""

POSITION_SCALE_M = 20.0
OFFSET_SCALE_M = 5.0
MAX_OFFSET_M = 10.0
"""Distances from the route are cut off here. Chosen by hand."""


class TrafficFeatures(BaseFeaturesExtractor):
    """The ego's state and route, and what matters of the traffic around it.

    Each neighbour is a token of its fields now and 0.6 s ago, its forecast, and the position along
    the route and the distance from it of all these points. A token is encoded together with the
    ego's state and route. The tokens are summed up twice: by attention, with the ego as the query
    (Vaswani et al., 2017), and by the maximum of each feature. Pieces of lines are summed up by
    attention (as the polylines of VectorNet, Gao et al., 2020).
    """

    state_scale: Tensor
    agent_scale: Tensor
    line_scale: Tensor

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """Creates the network.

        Args:
            space: space of a policy's observation without rasters.
            width: number of features of tokens.
        """
        has_lines = "lines" in space.spaces
        super().__init__(space, len(STATE) + width * (4 if has_lines else 3))
        forecasts = [ForecastTokens(prefix, space) for prefix in forecast_prefixes(space)]
        self.forecasts = nn.ModuleList(forecasts)
        route = space["route"].shape
        assert route is not None
        self.register_buffer("state_scale", torch.tensor([STATE_SCALES[name] for name in STATE]))
        agent = [AGENT_SCALES.get(name, 1.0) for name in AGENT_FIELDS]
        self.register_buffer("agent_scale", torch.tensor(agent + agent))
        self.ego = _perceptron(len(STATE) + 2 * route[0], width)
        size = NEIGHBOUR_FIELDS - 1 + 6 + sum(each.size for each in forecasts)
        self.neighbour = nn.Linear(size, width)
        self.context = nn.Linear(width, width, bias=False)
        self.token = nn.Linear(width, width)
        self.attention = Attention(width)
        self.lines: nn.Module | None = None
        if has_lines:
            points = space["lines"].shape
            assert points is not None
            line = [AGENT_SCALES.get(name, 1.0) for name in LINE_FIELDS]
            self.register_buffer("line_scale", torch.tensor([*line, 1.0]))
            self.lines = _perceptron(points[1] * points[2], width)
            self.line_attention = Attention(width)

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """Returns the features (B, features)."""
        state, route = observations["state"] / self.state_scale, observations["route"]
        ego = self.ego(torch.cat([state, route.flatten(1) / POSITION_SCALE_M], dim=1))
        neighbours = observations["neighbours"]
        present = neighbours[..., -1]
        fields = neighbours[..., :-1]
        now, past = fields.chunk(2, dim=-1)
        soon = now[..., :2] + now[..., 2:4] * now[..., 4:5]
        points = torch.stack([now[..., :2], past[..., :2], soon], dim=2)
        parts = [fields / self.agent_scale, route_coordinates(points, route)]
        parts += [each(observations, route, neighbours.shape[1]) for each in self.forecasts]
        tokens = self.neighbour(torch.cat(parts, dim=-1)) + self.context(ego)[:, None]
        tokens = torch.relu(self.token(torch.relu(tokens))) * present[..., None]
        features = [state, ego, self.attention(ego, tokens, present > 0), tokens.amax(dim=1)]
        if self.lines is not None:
            lines = observations["lines"]
            exists = lines[..., -1].amax(dim=-1) > 0
            pieces = self.lines((lines / self.line_scale).flatten(2))
            features.append(self.line_attention(ego, pieces, exists))
        return torch.cat(features, dim=1)


class ForecastTokens(nn.Module):
    """What a predictor's forecasts add to the tokens of the nearest agents.

    These are the forecast positions, each with its coordinates along the route, probabilities, age,
    and the features of the predictor's network, as far as they are observed.
    """

    def __init__(self, prefix: str, space: spaces.Dict) -> None:
        """Finds the sizes.

        Args:
            prefix: text before the names of the entries.
            space: space of the observation.
        """
        super().__init__()
        sizes = {name: box.shape[0] for name, box in space.items() if box.shape}
        self.prefix = prefix
        self.agents = sizes[f"{prefix}forecast_valid"]
        self.positions = sizes.get(f"{prefix}forecast", 0) // (2 * self.agents)
        self.parts = [
            (f"{prefix}{name}", sizes[f"{prefix}{name}"] // self.agents)
            for name in ("forecast_probabilities", "forecast_features", "forecast_age")
            if f"{prefix}{name}" in sizes
        ]
        self.size = 4 * self.positions + sum(size for _, size in self.parts)

    def forward(self, observations: Mapping[str, Tensor], route: Tensor, count: int) -> Tensor:
        """Returns (B, count, size): zeros for neighbours beyond those that are forecast."""
        batch = len(route)
        parts = []
        if self.positions:
            points = observations[f"{self.prefix}forecast"]
            points = points.reshape(batch, self.agents, self.positions, 2)
            parts += [points.flatten(2) / POSITION_SCALE_M, route_coordinates(points, route)]
        parts += [observations[name].reshape(batch, self.agents, size) for name, size in self.parts]
        tokens = torch.cat(parts, dim=-1)[:, :count]
        return nn.functional.pad(tokens, (0, 0, 0, count - tokens.shape[1]))


class Attention(nn.Module):
    """Attention of one query over tokens, with one head; zero where there is no token."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.key = nn.Linear(width, width), nn.Linear(width, width)
        self.value = nn.Linear(width, width)

    def forward(self, query: Tensor, tokens: Tensor, exists: Tensor) -> Tensor:
        """Returns (B, width).

        Args:
            query: (B, width).
            tokens: (B, N, width).
            exists: (B, N) bool.
        """
        scale = tokens.shape[-1] ** -0.5
        scores = (self.key(tokens) @ self.query(query)[..., None])[..., 0] * scale
        weights = scores.masked_fill(~exists, -1e9).softmax(dim=1) * exists
        return (weights[:, None] @ self.value(tokens))[:, 0]


class RasterFeatures(BaseFeaturesExtractor):
    """The ego's state and route, and a convolutional encoding of its raster."""

    state_scale: Tensor

    def __init__(
        self, space: spaces.Dict, width: int = 64, encoder: nn.Module | None = None
    ) -> None:
        """Creates the network.

        Args:
            space: space of a policy's observation with a raster.
            width: number of features of the encoding.
            encoder: a trained encoder of such rasters, (B, channels, height, width) in [0, 1] to
                (B, features), whose weights stay fixed; by default a new one is trained.
        """
        channels = space["raster"].shape
        route = space["route"].shape
        assert channels is not None
        assert route is not None
        super().__init__(space, len(STATE) + 2 * width)
        self.register_buffer("state_scale", torch.tensor([STATE_SCALES[name] for name in STATE]))
        self.ego = _perceptron(len(STATE) + 2 * route[0], width)
        self.is_fixed = encoder is not None
        if encoder is None:
            encoder = nn.Sequential(
                nn.AvgPool2d(2), nn.Conv2d(channels[0], 16, 4, stride=2), nn.ReLU(),
                nn.Conv2d(16, 32, 4, stride=2), nn.ReLU(),
                nn.Conv2d(32, 32, 3, stride=2), nn.ReLU(), nn.Flatten(),
            )  # fmt: skip
        self.encoder = encoder.requires_grad_(not self.is_fixed)
        with torch.no_grad():
            encoded = self.encoder(torch.zeros(1, *channels)).shape[1]
        self.head = nn.Sequential(nn.Linear(encoded, width), nn.ReLU())

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """Returns the features (B, features)."""
        state, route = observations["state"] / self.state_scale, observations["route"]
        ego = self.ego(torch.cat([state, route.flatten(1) / POSITION_SCALE_M], dim=1))
        if self.is_fixed:
            with torch.no_grad():
                encoded = self.encoder(observations["raster"])
        else:
            encoded = self.encoder(observations["raster"])
        return torch.cat([state, ego, self.head(encoded)], dim=1)


def forecast_prefixes(space: spaces.Dict) -> list[str]:
    """The prefixes of the forecasts in an observation, in alphabetical order."""
    ending = "forecast_valid"
    return sorted(name.removesuffix(ending) for name in space.spaces if name.endswith(ending))


def route_coordinates(points: Tensor, route: Tensor) -> Tensor:
    """Coordinates of points along the route, of the nearest point of the route.

    Args:
        points: (B, N, P, 2) in the ego's frame, m.
        route: (B, R, 2) points of the route at distances of `ROUTE_STEP_M`.

    Returns:
        (B, N, 2 · P): for each point, the distance along the route over 20 m and the distance from
        the route over 5 m, cut off at 10 m.
    """
    batch, count = points.shape[:2]
    flat = points.reshape(batch, -1, 2)
    square = (
        flat.square().sum(-1)[..., None]
        - 2.0 * flat @ route.transpose(1, 2)
        + route.square().sum(-1)[:, None]
    )
    nearest, index = square.min(dim=-1)
    along = (index + 1) * (ROUTE_STEP_M / POSITION_SCALE_M)
    offset = nearest.clamp(min=1e-6).sqrt().clamp(max=MAX_OFFSET_M) / OFFSET_SCALE_M
    return torch.stack([along, offset], dim=-1).reshape(batch, count, -1)


def _perceptron(size: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width))
