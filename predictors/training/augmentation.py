"""Augmentation: training samples as other sites, other traffic and other trackers would show them.

Every draw is a function of the seed and of how many snippets were visited before, so that it
depends neither on the batch nor on the process that makes it.

- The scene is measured again: positions, headings and speeds of all agents get errors that are
  correlated over time, of a size that is drawn for each snippet, and speeds a share of the rate at
  which the errors of positions change; actions are inferred from the result. Sizes are wrong by a
  factor for each agent. Labels are the recorded future, seen from the measured pose.
- Some other agents are missing, and some are only seen from a later tick on.
- The map is displaced and turned against the agents; lines of some kinds, single lines or all lines
  are missing.
- The sample is mirrored, which exchanges left and right.
- All lengths, sizes, speeds and accelerations are multiplied by a factor. This maps a trajectory of
  the bicycle model to another one with the same steering angles.

Only the vector view can be augmented: the last three change what it renders.

Dimensions: n snippets.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt64
from torch import Tensor

from asp_env.data.scene import Scene, infer_actions
from asp_env.errors import AspEnvError
from asp_env.geometry import from_frame, states_to_frame, wrap_angle
from asp_env.views.vectors import KINDS, LINE_FIELDS
from predictors.counter_random import mixed, nearly_normal, uniform
from predictors.models.batch import Batch, VectorTensors

_STILL_MPS = 0.5
"""Below this speed, headings wobble."""

FAST_MPS = 3.0
"""From this speed on, errors of positions have their full size. Chosen by hand: trackers hold
vehicles at standstill in place."""

REACH_TICKS = 6
"""Ticks before and after that a smoothed error depends on."""

_FIRST_KIND = LINE_FIELDS.index(KINDS[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """Ranges of the draws. Chosen by hand, wider than what drone datasets show."""

    mirrored: float = 0.05
    """Probability of a mirrored sample."""
    largest_scale: float = 1.2
    """Lengths and speeds are multiplied by up to this factor or its inverse (log-uniform)."""
    position_m: tuple[float, float] = (0.01, 0.15)
    """Standard deviation of positions along each axis, for agents that move (log-uniform)."""
    still_share: float = 0.1
    """Share of that standard deviation for agents at standstill; it grows linearly with speed."""
    smoothing_s: tuple[float, float] = (0.1, 0.5)
    """Standard deviation of the Gaussian that the errors of positions are smoothed with
    (log-uniform)."""
    heading_rad: tuple[float, float] = (0.002, 0.04)
    """Standard deviation of headings (log-uniform), besides the direction of the errors of
    positions."""
    still_heading: float = 3.0
    """Largest factor on the errors of headings at standstill."""
    speed_mps: tuple[float, float] = (0.01, 0.3)
    """Standard deviation of speeds (log-uniform), besides the rate of the errors of positions."""
    correlation_s: tuple[float, float] = (0.05, 1.5)
    """Time constant of the errors of headings and speeds (log-uniform)."""
    largest_size: float = 1.15
    """Sizes are multiplied by up to this factor or its inverse (log-uniform)."""
    absent_agents: float = 0.2
    """Largest share of other agents that are missing; the share is drawn for each snippet."""
    late_agents: float = 0.15
    """Share of other agents that are only seen from a later tick on."""
    map_offset_m: float = 0.3
    """Standard deviation of the displacement of the map along each axis."""
    map_turn_rad: float = 0.01
    """Standard deviation of the angle by which the map is turned about the target."""
    no_map: float = 0.03
    """Probability that all lines are missing."""
    no_kind: float = 0.05
    """Probability that all lines of a kind are missing, for each kind."""
    no_line: float = 0.3
    """Largest share of single lines that are missing; the share is drawn for each snippet."""


def sample_keys(seed: int, visits: np.ndarray) -> UInt64[np.ndarray, " n"]:
    """Streams of the draws of some snippets.

    Args:
        seed: Seed of the run.
        visits: (n,) number of snippets of the run before each.
    """
    return mixed(mixed(np.array([seed], dtype=np.uint64)) ^ visits.astype(np.uint64))


def one_situation_each(scene: Scene) -> Scene:
    """The scene with a situation of its own for every target, in the order of the targets."""
    of_target, slots = scene.targets.T
    names = ("states", "actions", "valid", "sizes", "classes", "ids", "tick", "map_index")
    arrays = {name: getattr(scene, name)[of_target] for name in (*names, "route", "route_valid")}
    signals = None if scene.signals is None else scene.signals.of_situations(of_target)
    targets = np.stack([np.arange(len(slots)), slots], axis=-1)
    return dataclasses.replace(scene, targets=targets, signals=signals, **arrays)


def measured_again(
    scene: Scene, keys: UInt64[np.ndarray, " n"], ranges: Augmentation, *, part: int = 0
) -> Scene:
    """The scene with errors of another tracker, and without some agents.

    Args:
        scene: N targets, each with a situation of its own.
        keys: Streams of the snippets.
        ranges: Ranges of the draws.
        part: Index of the segment at whose start the scene is; errors differ between segments.
    """
    ticks, count = scene.states.shape[2], scene.states.shape[2] + 2 * REACH_TICKS
    agents = mixed(keys[:, None] ^ mixed(scene.ids.astype(np.int64).view(np.uint64)))
    counters = np.arange(part * 4 * count, (part + 1) * 4 * count).reshape(count, 4)
    drawn = nearly_normal(mixed(agents)[..., None, None], counters).astype(np.float32)
    positions_m, rates_mps = _smooth_errors(scene, drawn[..., :2], keys, ranges)
    keep = np.exp(-scene.dt_s / _log_uniform(keys, 4, *ranges.correlation_s))[:, None, None]
    noise = np.concatenate([positions_m, drawn[:, :, :ticks, 2:]], axis=-1)
    for tick in range(1, ticks):
        fresh = np.sqrt(1 - keep**2) * noise[:, :, tick, 2:]
        noise[:, :, tick, 2:] = keep * noise[:, :, tick - 1, 2:] + fresh
    noise[..., 2] *= _log_uniform(keys, 2, *ranges.heading_rad)[:, None, None]
    noise[..., 3] *= _log_uniform(keys, 3, *ranges.speed_mps)[:, None, None]
    # Trackers that differentiate positions have errors of speed and course that belong to those.
    cos, sin = np.cos(scene.states[..., 2]), np.sin(scene.states[..., 2])
    shares = uniform(keys[:, None], np.array([7, 8]))[..., None, None]
    noise[..., 3] += (0.5 + 0.5 * shares[:, 0]) * (
        rates_mps[..., 0] * cos + rates_mps[..., 1] * sin
    )
    across_mps = rates_mps[..., 1] * cos - rates_mps[..., 0] * sin
    noise[..., 2] += shares[:, 1] * across_mps / np.maximum(np.abs(scene.states[..., 3]), FAST_MPS)
    still = np.abs(scene.states[..., 3]) < _STILL_MPS
    wobble = 1 + (ranges.still_heading - 1) * uniform(keys, np.array([5]))
    noise[..., 2] *= np.where(still, wobble[:, None, None], 1)
    valid = scene.valid & _seen(scene, keys, agents, ranges)
    states = np.where(valid[..., None], scene.states + noise, 0)
    states[..., 2] = wrap_angle(states[..., 2])
    factor = ranges.largest_size ** (2 * uniform(agents, np.array([2])) - 1)
    sizes = (scene.sizes * factor[..., None]).astype(scene.sizes.dtype)
    states = states.astype(scene.states.dtype)
    return dataclasses.replace(
        scene,
        states=states,
        valid=valid,
        sizes=sizes,
        actions=infer_actions(states, valid, sizes[..., 0], scene.dt_s),
    )


def _smooth_errors(
    scene: Scene,
    drawn: Float[np.ndarray, "n a count 2"],
    keys: UInt64[np.ndarray, " n"],
    ranges: Augmentation,
) -> tuple[Float[np.ndarray, "n a ticks 2"], Float[np.ndarray, "n a ticks 2"]]:
    """Errors of positions and the rates at which they change, from independent draws.

    Recorded tracks are smoothed, so that their errors of speed are waves of a second or two.
    """
    width_ticks = _log_uniform(keys, 1, *ranges.smoothing_s) / scene.dt_s
    at = np.arange(-REACH_TICKS, REACH_TICKS + 1)
    kernel = np.exp(-0.5 * (at / width_ticks[:, None]) ** 2)
    slope = at / width_ticks[:, None] ** 2 * kernel / scene.dt_s
    kernels = np.stack([kernel, slope], axis=-1).astype(np.float32)
    kernels /= np.linalg.norm(kernel, axis=-1)[:, None, None].astype(np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(drawn, len(at), axis=2)
    smoothed = np.einsum("natcw,nwk->knatc", windows, kernels, optimize=True)
    speed = np.abs(scene.states[..., 3]).max(axis=2)
    share = ranges.still_share + (1 - ranges.still_share) * np.minimum(speed / FAST_MPS, 1)
    sigma_m = _log_uniform(keys, 0, *ranges.position_m)[:, None] * share
    errors, rates = smoothed * sigma_m[..., None, None]
    return errors, rates


def _seen(
    scene: Scene, keys: np.ndarray, agents: np.ndarray, ranges: Augmentation
) -> Bool[np.ndarray, "n a ticks"]:
    """Which agents are seen at which ticks; the target always is."""
    ticks = scene.states.shape[2]
    share = ranges.absent_agents * uniform(keys, np.array([6]))
    present = uniform(agents, np.array([0])) >= share[:, None]
    late = uniform(agents, np.array([1])) / ranges.late_agents  # below 1 for late agents
    first = np.where(late < 1, np.floor(late * ticks), 0)
    seen = present[..., None] & (np.arange(ticks) >= first[..., None])
    seen[scene.targets[:, 0], scene.targets[:, 1]] = True
    return seen


def off_the_map(
    scene: Scene,
    about: Float[np.ndarray, "n 2"],
    keys: UInt64[np.ndarray, " n"],
    ranges: Augmentation,
) -> Scene:
    """The scene with all agents displaced and turned against the map.

    Args:
        scene: N targets, each with a situation of its own.
        about: Centres of the turns.
        keys: Streams of the snippets.
        ranges: Ranges of the draws.
    """
    offset_m = ranges.map_offset_m * nearly_normal(keys[:, None], np.array([10, 11]))
    turn = ranges.map_turn_rad * nearly_normal(keys, np.array([12]))
    moved = np.zeros((len(keys), 1, 1, 4))
    moved[..., :2], moved[..., 2] = (about + offset_m)[:, None, None], turn[:, None, None]
    origin = np.zeros((len(keys), 1, 1, 4))
    origin[..., :2] = about[:, None, None]
    local = states_to_frame(scene.states.astype(np.float64), origin)
    states = np.concatenate(
        [from_frame(local[..., :2], moved), local[..., 2:3] + moved[..., 2:3], local[..., 3:]],
        axis=-1,
    )
    states[..., 2] = wrap_angle(states[..., 2])
    states = np.where(scene.valid[..., None], states, 0).astype(scene.states.dtype)
    return dataclasses.replace(scene, states=states)


def reshaped(batch: Batch, keys: UInt64[np.ndarray, " n"], ranges: Augmentation) -> Batch:
    """The batch mirrored, scaled, and without some lines.

    Args:
        batch: Inputs with vectors, as float32.
        keys: Streams of the snippets.
        ranges: Ranges of the draws.

    Raises:
        AspEnvError: The inputs are rasters.
    """
    vectors = batch.observation
    if not isinstance(vectors, VectorTensors):
        raise AspEnvError("augmentation changes vectors, the view renders rasters: take vectors")
    sign, scale = _similarity(keys, ranges)
    one = torch.ones_like(sign)
    agents = torch.stack([scale, scale * sign, one, sign, scale, scale, scale], dim=-1)
    agents = _padded(agents, vectors.agents.shape[-1])[:, None, None]
    lines = torch.stack([scale, scale * sign, one, sign], dim=-1)
    lines = _padded(lines, vectors.lines.shape[-1])[:, None, None]
    lines_valid = vectors.lines_valid & _lines_seen(vectors.lines, keys, ranges)[..., None]
    return Batch(
        observation=VectorTensors(
            agents=vectors.agents * agents,
            agents_valid=vectors.agents_valid,
            lines=vectors.lines * lines * lines_valid[..., None],
            lines_valid=lines_valid,
        ),
        actions=batch.actions * torch.stack([scale, sign], dim=-1)[:, None],
        motion=batch.motion * torch.stack([scale, scale, sign], dim=-1),
        length_m=batch.length_m * scale,
    )


def reshaped_labels(
    states: Float[Tensor, "n t 4"], keys: UInt64[np.ndarray, " n"], ranges: Augmentation
) -> Float[Tensor, "n t 4"]:
    """The states of labels, mirrored and scaled as by `reshaped`."""
    sign, scale = _similarity(keys, ranges)
    return states * torch.stack([scale, scale * sign, sign, scale], dim=-1)[:, None]


def _similarity(keys: np.ndarray, ranges: Augmentation) -> tuple[Tensor, Tensor]:
    """The sign of the left axis and the factor on lengths of each snippet."""
    sign = np.where(uniform(keys, np.array([20])) < ranges.mirrored, -1.0, 1.0)
    scale = ranges.largest_scale ** (2 * uniform(keys, np.array([21])) - 1)
    return torch.from_numpy(sign).float(), torch.from_numpy(scale).float()


def _lines_seen(
    lines: Float[Tensor, "n lines points fields"], keys: np.ndarray, ranges: Augmentation
) -> Bool[Tensor, "n lines"]:
    kinds = lines[:, :, 0, _FIRST_KIND : _FIRST_KIND + len(KINDS)]
    counters = 30 + np.arange(len(KINDS))
    kind_seen = uniform(keys[:, None], counters) >= ranges.no_kind
    kind_seen &= (uniform(keys, np.array([22])) >= ranges.no_map)[:, None]
    share = ranges.no_line * uniform(keys, np.array([23]))
    single = uniform(mixed(keys)[:, None], np.arange(lines.shape[1])) >= share[:, None]
    of_kind = (kinds * torch.from_numpy(kind_seen)[:, None].float()).sum(dim=-1) > 0
    return of_kind & torch.from_numpy(single)


def _padded(factors: Float[Tensor, "n k"], width: int) -> Float[Tensor, "n width"]:
    return torch.nn.functional.pad(factors, (0, width - factors.shape[1]), value=1.0)


def _log_uniform(
    keys: np.ndarray, counter: int, low: float, high: float
) -> Float[np.ndarray, " n"]:
    return low * (high / low) ** uniform(keys, np.array([40 + counter]))
