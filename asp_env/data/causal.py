"""Causal histories: states that are estimated from noisy measurements up to the present frame.

Recorded tracks are smoothed with look-ahead, so that a recorded state contains up to half a second
of what follows. Here white noise (0.08 m, 1.5°) is added to each recorded position and heading, and
the result is filtered forward: the state at a frame depends on measurements up to that frame only.

Vehicles: an interacting multiple model filter (Blom and Bar-Shalom 1988) with two models, standing
and moving. The state of the first is [x, y, heading]. The second is an extended Kalman filter of
[x, y, heading, speed, acceleration, curvature] whose motion is that of `asp_env.dynamics`: the
box's centre moves at the slip angle asin(rear · curvature) to the heading, and the yaw rate is
curvature · speed, so that standing vehicles do not turn. Acceleration and curvature decay
exponentially and are driven by white noise (Singer 1970). The result is the mean of both models,
weighted by their probabilities.

Vulnerable road users: a Kalman filter of constant velocity along x and y, driven by white
acceleration. Their heading is their direction of motion, as in recordings.

All kernels are in this file because numba's cache watches only the file of the kernel that is
called from Python.
"""

import dataclasses
import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, SupportsIndex, no_type_check, overload

import numpy as np
from jaxtyping import Float

from asp_env.compiled import njit
from asp_env.data import cache
from asp_env.data.classes import VULNERABLE
from asp_env.data.recording import Recording
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import wrap_scalar

VERSION = 1
"""Raise it whenever the filter or its noise gives other states for the same recording."""

POSITION_SIGMA_M = 0.08
"""Standard deviation of the noise of a measured coordinate, white over frames. Chosen by hand."""

HEADING_SIGMA_RAD = math.radians(1.5)
"""Standard deviation of the noise of a measured heading. Chosen by hand."""

SPEED_SIGMA_MPS = 0.1
"""Standard deviation of the noise of the speed at a track's first frame, the only measured speed.
Chosen by hand."""

SPEED_SIGMA_SHARE = 0.05
"""Share of that speed that is added to its standard deviation. Chosen by hand."""

ACCELERATION_SIGMA_MPS2 = 1.0
"""Standard deviation of a vehicle's acceleration. Chosen by hand: more follows braking sooner, less
gives calmer speeds."""

ACCELERATION_FADES_S = 2.0
"""Time constant of the decay of acceleration. Chosen by hand."""

CURVATURE_SIGMA_PER_M = 0.04
"""Standard deviation of the curvature of a slow vehicle's path. Chosen by hand: more follows turns
sooner, less gives calmer steering."""

CURVATURE_FADES_S = 3.0
"""Time constant of the decay of curvature. Chosen by hand."""

CALM_MPS = 5.0
"""Scale of speed above which curvature varies less: its standard deviation is divided by
1 + (speed / this)². Chosen by hand."""

HEADING_DRIFT = 1e-5
"""Variance that the heading gains in addition, rad²/s. Chosen by hand: covers errors of the
model."""

POSITION_DRIFT = 3e-4
"""Variance that a coordinate gains in addition, m²/s. Chosen by hand: covers errors of the model.
"""

STANDS_FOR_S = 20.0
"""Mean time for which a vehicle stands. Chosen by hand: more delays the detection of a start."""

MOVES_FOR_S = 2.0
"""Mean time for which a slow vehicle moves before it stands. Chosen by hand: more delays the
detection of a stop."""

SLOW_MPS = 0.4
"""Scale of the speeds from which a vehicle may come to a stand. Chosen by hand."""

NEVER_STANDS_MPS = 2.0
"""Above this speed only the model of motion is used. Chosen by hand: five times `SLOW_MPS`, where
the probability of a stop vanishes."""

START_SIGMA_MPS = 0.2
"""Standard deviation of the speed of a vehicle that starts to move. Chosen by hand."""

WALK_NOISE = 0.15
"""Spectral density of a vulnerable road user's acceleration, m²/s³. Chosen by hand."""

COURSE_ABOVE_MPS = 0.6
"""Speed above which the direction of motion is a vulnerable road user's heading. Chosen by hand:
above the speeds that noise causes in standing pedestrians."""

_MAX_SIN_SLIP = 0.6
_MIN_PROBABILITY = 1e-9


class CausalHistories(Sequence[Any]):  # not of Recording: checking its items would filter them
    """Recordings with causal states, each opened and filtered on first access."""

    def __init__(self, recordings: Sequence[Any]) -> None:
        """Creates the sequence without filtering.

        Args:
            recordings: the recorded ones.
        """
        self._recorded = recordings
        self._filtered: dict[int, Recording] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes take states from the cache, or filter again."""
        return CausalHistories, (self._recorded,)

    def __len__(self) -> int:
        return len(self._recorded)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "CausalHistories": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | CausalHistories":
        """One recording with causal states, or an unfiltered sequence of several."""
        if isinstance(index, slice):
            return CausalHistories(self._recorded[index])
        number = range(len(self))[index]
        if number not in self._filtered:
            recording = self._recorded[number]
            self._filtered[number] = dataclasses.replace(
                recording, states=_cached_states(recording)
            )
        return self._filtered[number]

    def __iter__(self) -> Iterator[Recording]:
        return (self[index] for index in range(len(self)))


def causal_histories(recordings: Sequence[Any]) -> CausalHistories:
    """The same recordings with causal `states`; all other fields are unchanged.

    Use these for scenes, and the recorded ones for snippets, futures and labels. Filtered states
    are stored in the cache folder by the recording's content, and mapped into memory.

    Args:
        recordings: the recorded ones.
    """
    return CausalHistories(recordings)


def causal_states(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """Filters all tracks of a recording.

    The noise of a track comes from a generator seeded by the names of location and recording and by
    the track's id. The filter starts at the track's first measurement. Only there the speed is
    measured as well, with an error of 0.1 m/s + 5 %.

    Returns:
        States [x m, y m, heading rad, speed m/s], read-only. A row depends only on the rows of its
        track up to it.
    """
    states = np.empty(recording.states.shape, dtype=np.float32)
    dt_s = 1.0 / recording.frame_rate_hz
    vulnerable = np.isin(recording.classes, [int(kind) for kind in VULNERABLE])
    for track, track_id in enumerate(recording.track_ids.tolist()):
        rows = slice(int(recording.starts[track]), int(recording.starts[track + 1]))
        source = f"{recording.location}\0{recording.name}\0{track_id}".encode()
        rng = np.random.default_rng(int.from_bytes(hashlib.sha256(source).digest()[:16], "little"))
        measured, speed_mps = _measure(rng, recording.states[rows])
        if vulnerable[track]:
            filter_vulnerable(measured, speed_mps, dt_s, states[rows])
        else:
            rear_m = AXLE_SHARE_OF_LENGTH * float(recording.sizes[track, 0])
            filter_vehicle(measured, speed_mps, rear_m, dt_s, states[rows])
    states.flags.writeable = False
    return states


def _measure(
    rng: np.random.Generator, states: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """[x, y, heading] of all frames and the speed at the first frame, all with noise."""
    first_mps = float(states[0, 3])
    sigma_mps = SPEED_SIGMA_MPS + SPEED_SIGMA_SHARE * abs(first_mps)
    speed_mps = first_mps + sigma_mps * float(rng.standard_normal())
    errors = rng.standard_normal((len(states), 3))
    errors *= (POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD)
    return states[:, :3] + errors, speed_mps


def _cached_states(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """The causal states, read-only if the cache can be written, from there if they are there."""
    return cache.array_of("causal", VERSION, _digest(recording), lambda: causal_states(recording))


def _digest(recording: Recording) -> str:
    """A hash of everything that the causal states depend on."""
    digest = hashlib.sha256(
        repr((recording.location, recording.name, recording.frame_rate_hz)).encode()
    )
    for column in ("track_ids", "classes", "sizes", "starts", "states"):
        digest.update(np.ascontiguousarray(getattr(recording, column)).data)
    return digest.hexdigest()


class _Process(NamedTuple):
    """Constants of a vehicle's motion from one frame to the next."""

    rear_m: float
    """Distance from the box's centre to the rear axle."""
    dt_s: float
    keep_acceleration: float
    """Share of the acceleration that remains after a frame."""
    keep_curvature: float
    """Share of the curvature that remains after a frame."""
    acceleration_noise: float
    """Variance that the acceleration gains in a frame, m²/s⁴."""
    curvature_noise: float
    """Variance that the curvature of a slow vehicle gains in a frame, 1/m²."""


@njit(cache=True, nogil=True)
@no_type_check
def _stop_at_zero(m, before):
    """Sets speed and acceleration of state m (6,) to zero if the speed changed its sign."""
    if m[3] * before < 0.0:
        m[3] = 0.0
        m[4] = 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _predict(m, p, work, process):
    """Predicts the moving model one frame ahead.

    Args:
        m: (6,) state, updated in place.
        p: (6, 6) covariance, updated in place.
        work: (6, 6) buffer.
        process: the constants of the motion.
    """
    rear, dt = process.rear_m, process.dt_s
    keep_a, keep_c = process.keep_acceleration, process.keep_curvature
    distance = m[3] * dt + 0.5 * m[4] * dt * dt
    sin_slip = min(max(rear * m[5], -_MAX_SIN_SLIP), _MAX_SIN_SLIP)
    cos_slip = math.sqrt(1.0 - sin_slip * sin_slip)
    course = m[2] + math.asin(sin_slip) + 0.5 * m[5] * distance
    cosine, sine = math.cos(course), math.sin(course)
    bend = rear / cos_slip + 0.5 * distance
    turn = 0.5 * m[5] * dt * distance
    # Rows of the Jacobian that differ from the identity.
    x_t, x_v, x_c = -distance * sine, dt * cosine - turn * sine, -distance * sine * bend
    y_t, y_v, y_c = distance * cosine, dt * sine + turn * cosine, distance * cosine * bend
    t_v = m[5] * dt
    half = 0.5 * dt
    for j in range(6):
        v, a, c, t = p[3, j], p[4, j], p[5, j], p[2, j]
        mean_v = v + half * a
        work[0, j] = p[0, j] + x_t * t + x_v * mean_v + x_c * c
        work[1, j] = p[1, j] + y_t * t + y_v * mean_v + y_c * c
        work[2, j] = t + t_v * mean_v + distance * c
        work[3, j] = v + dt * a
        work[4, j] = keep_a * a
        work[5, j] = keep_c * c
    for i in range(6):
        v, a, c, t = work[i, 3], work[i, 4], work[i, 5], work[i, 2]
        mean_v = v + half * a
        p[i, 0] = work[i, 0] + x_t * t + x_v * mean_v + x_c * c
        p[i, 1] = work[i, 1] + y_t * t + y_v * mean_v + y_c * c
        p[i, 2] = t + t_v * mean_v + distance * c
        p[i, 3] = v + dt * a
        p[i, 4] = keep_a * a
        p[i, 5] = keep_c * c
    calm = 1.0 + (m[3] / CALM_MPS) ** 2
    p[0, 0] += POSITION_DRIFT * dt
    p[1, 1] += POSITION_DRIFT * dt
    p[2, 2] += HEADING_DRIFT * dt
    p[4, 4] += process.acceleration_noise
    p[5, 5] += process.curvature_noise / (calm * calm)

    m[0] += distance * cosine
    m[1] += distance * sine
    m[2] += m[5] * distance
    before = m[3]
    m[3] += m[4] * dt
    m[4] *= keep_a
    m[5] *= keep_c
    _stop_at_zero(m, before)


@njit(cache=True, nogil=True)
@no_type_check
def _update(m, p, i, innovation, variance):
    """Updates the moving model by a measurement of one component.

    Args:
        m: (6,) state, updated in place.
        p: (6, 6) covariance, updated in place.
        i: index of the measured component.
        innovation: the measurement less `m[i]`.
        variance: of the measurement.

    Returns:
        Minus twice the measurement's log density, up to a constant.
    """
    s = p[i, i] + variance
    scaled = innovation / s
    g0, g1, g2, g3, g4, g5 = p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5]
    gains = (g0, g1, g2, g3, g4, g5)
    for j in range(6):
        m[j] += gains[j] * scaled
        weight = gains[j] / s
        p[j, 0] -= weight * g0
        p[j, 1] -= weight * g1
        p[j, 2] -= weight * g2
        p[j, 3] -= weight * g3
        p[j, 4] -= weight * g4
        p[j, 5] -= weight * g5
    return innovation * scaled + math.log(s)


@njit(cache=True, nogil=True)
@no_type_check
def _mix(m, p, still, spread, standing, dt):
    """Mixes the two models by the probabilities of starts and stops.

    Args:
        m: (6,) state of the moving model, updated in place.
        p: (6, 6) its covariance, updated in place.
        still: (3,) [x, y, heading] of the standing model, updated in place.
        spread: (3,) its variances, updated in place.
        standing: probability of the standing model before.
        dt: seconds between frames.

    Returns:
        The probability of the standing model before the next measurement.
    """
    to_move = dt / (STANDS_FOR_S + dt)
    to_stand = dt / (MOVES_FOR_S + dt) * math.exp(-0.5 * (m[3] / SLOW_MPS) ** 2)
    stays = (1.0 - to_move) * standing
    stops = to_stand * (1.0 - standing)
    starts = to_move * standing
    goes = (1.0 - to_stand) * (1.0 - standing)
    halted = stops / (stays + stops)
    started = starts / (starts + goes)
    apart = np.empty(5)
    for j in range(3):
        apart[j] = still[j] - m[j]
    apart[3], apart[4] = -m[3], -m[4]
    for j in range(3):
        between = halted * (1.0 - halted) * apart[j] * apart[j]
        spread[j] = (1.0 - halted) * spread[j] + halted * p[j, j] + between
        still[j] -= halted * apart[j]
    for i in range(6):
        for j in range(6):
            p[i, j] *= 1.0 - started
    for i in range(5):
        for j in range(5):
            p[i, j] += started * (1.0 - started) * apart[i] * apart[j]
        m[i] += started * apart[i]
    for j in range(3):
        p[j, j] += started * spread[j]
    p[3, 3] += started * START_SIGMA_MPS**2
    p[4, 4] += started * ACCELERATION_SIGMA_MPS2**2
    p[5, 5] += started * CURVATURE_SIGMA_PER_M**2
    return stays + stops


@njit(cache=True, nogil=True)
@no_type_check
def _apart(seen, state, j):
    """Difference of a measurement and a state in component j, wrapped for the heading."""
    return wrap_scalar(seen[j] - state[j]) if j == 2 else seen[j] - state[j]


@njit(cache=True, nogil=True)
@no_type_check
def _update_standing(still, spread, seen, noise, drift):
    """Updates the standing model by a measurement.

    Args:
        still: (3,) [x, y, heading], updated in place.
        spread: (3,) variances, updated in place.
        seen: (3,) measured [x, y, heading].
        noise: three variances of the measurement.
        drift: three variances that the state gains in a frame.

    Returns:
        Minus twice the measurement's log density, up to a constant.
    """
    cost = 0.0
    for j in range(3):
        innovation = _apart(seen, still, j)
        spread[j] += drift[j]
        s = spread[j] + noise[j]
        still[j] += spread[j] / s * innovation
        spread[j] *= noise[j] / s
        cost += innovation * innovation / s + math.log(s)
    return cost


@njit(cache=True, nogil=True)
@no_type_check
def _swap_front(m, still):
    """Describes the same motion with the vehicle's other end as its front."""
    m[2] += math.pi
    still[2] += math.pi
    for i in range(3, 6):
        m[i] = -m[i]


@njit(cache=True, nogil=True)
@no_type_check
def _posterior(standing, cost_standing, cost_moving):
    """The probability of the standing model after a measurement.

    Args:
        standing: the probability before.
        cost_standing: minus twice the log density under the standing model.
        cost_moving: the same under the moving model.
    """
    ratio = math.exp(min(max(0.5 * (cost_standing - cost_moving), -50.0), 50.0))
    after = standing / (standing + (1.0 - standing) * ratio)
    return min(max(after, _MIN_PROBABILITY), 1.0 - _MIN_PROBABILITY)


@njit(cache=True, nogil=True)
@no_type_check
def filter_vehicle(measured, speed, rear, dt, states):
    """Filters the track of one vehicle.

    Args:
        measured: (n, 3) float64, [x m, y m, heading rad] at consecutive frames.
        speed: measured at the first frame, m/s.
        rear: distance from the box's centre to the rear axle, m.
        dt: seconds between frames.
        states: (n, 4) float32, receives [x m, y m, heading rad, speed m/s].
    """
    noise = (POSITION_SIGMA_M**2, POSITION_SIGMA_M**2, HEADING_SIGMA_RAD**2)
    drift = (POSITION_DRIFT * dt, POSITION_DRIFT * dt, HEADING_DRIFT * dt)
    keep_a, keep_c = math.exp(-dt / ACCELERATION_FADES_S), math.exp(-dt / CURVATURE_FADES_S)
    noise_a = ACCELERATION_SIGMA_MPS2**2 * (1.0 - keep_a * keep_a)
    noise_c = CURVATURE_SIGMA_PER_M**2 * (1.0 - keep_c * keep_c)
    process = _Process(rear, dt, keep_a, keep_c, noise_a, noise_c)
    m, p, work = np.zeros(6), np.zeros((6, 6)), np.empty((6, 6))
    still, spread = np.empty(3), np.empty(3)
    for j in range(3):
        m[j] = still[j] = measured[0, j]
        p[j, j] = spread[j] = noise[j]
    m[3] = speed
    p[3, 3] = (SPEED_SIGMA_MPS + SPEED_SIGMA_SHARE * abs(speed)) ** 2
    p[4, 4] = ACCELERATION_SIGMA_MPS2**2
    p[5, 5] = (CURVATURE_SIGMA_PER_M / (1.0 + (speed / CALM_MPS) ** 2)) ** 2
    standing = max(0.5 * math.exp(-0.5 * (speed / SLOW_MPS) ** 2), _MIN_PROBABILITY)
    for k in range(len(measured)):
        if k > 0:
            seen = measured[k]
            if abs(_apart(seen, m, 2)) > 0.5 * math.pi:
                _swap_front(m, still)
            slow = abs(m[3]) < NEVER_STANDS_MPS
            if slow:
                standing = _mix(m, p, still, spread, standing, dt)
            _predict(m, p, work, process)
            cost, before = 0.0, m[3]
            for j in range(3):
                cost += _update(m, p, j, _apart(seen, m, j), noise[j])
            _stop_at_zero(m, before)
            if slow:
                cost_standing = _update_standing(still, spread, seen, noise, drift)
                standing = _posterior(standing, cost_standing, cost)
            else:
                standing = _MIN_PROBABILITY
                for j in range(3):
                    still[j], spread[j] = m[j], p[j, j]
        for j in range(2):
            states[k, j] = m[j] + standing * (still[j] - m[j])
        states[k, 2] = wrap_scalar(m[2] + standing * _apart(still, m, 2))
        states[k, 3] = (1.0 - standing) * m[3]


@njit(cache=True, nogil=True)
@no_type_check
def filter_vulnerable(measured, speed, dt, states):
    """Filters the track of one vulnerable road user.

    Args:
        measured: (n, 3) float64, [x m, y m, heading rad] at consecutive frames.
        speed: measured at the first frame, m/s.
        dt: seconds between frames.
        states: (n, 4) float32, receives [x m, y m, heading rad, speed m/s].
    """
    x, y, heading = measured[0]
    speed_x, speed_y = speed * math.cos(heading), speed * math.sin(heading)
    noise = POSITION_SIGMA_M**2
    p_xx, p_xv = noise, 0.0
    p_vv = (SPEED_SIGMA_MPS + SPEED_SIGMA_SHARE * abs(speed)) ** 2
    for k in range(len(measured)):
        if k > 0:
            x += speed_x * dt
            y += speed_y * dt
            p_xx += dt * (2.0 * p_xv + dt * p_vv) + WALK_NOISE * dt**3 / 3.0
            p_xv += dt * p_vv + WALK_NOISE * dt**2 / 2.0
            p_vv += WALK_NOISE * dt
            gain_x, gain_v = p_xx / (p_xx + noise), p_xv / (p_xx + noise)
            apart_x, apart_y = measured[k, 0] - x, measured[k, 1] - y
            x += gain_x * apart_x
            y += gain_x * apart_y
            speed_x += gain_v * apart_x
            speed_y += gain_v * apart_y
            p_vv -= gain_v * p_xv
            p_xv -= gain_v * p_xx
            p_xx -= gain_x * p_xx
        total = math.sqrt(speed_x * speed_x + speed_y * speed_y)
        if total > COURSE_ABOVE_MPS:
            heading = math.atan2(speed_y, speed_x)
        states[k, 0], states[k, 1] = x, y
        states[k, 2], states[k, 3] = wrap_scalar(heading), total
