"""Filters that follow one road user forward in time: the compiled part of causal histories.

Vehicles: an interacting multiple model filter (Blom and Bar-Shalom 1988) of two hypotheses,
that the vehicle stands and that it moves. The first knows [x, y, heading]; the second is an
extended Kalman filter of [x, y, heading, speed, acceleration, curvature] that moves as
`asp_env.dynamics` does: the box's centre travels at the slip angle asin(rear · curvature) to the
heading, and yaw rate = curvature · speed, so that a standing vehicle does not turn and a backing
one does so rightly. Acceleration and curvature fade exponentially and are stirred by white noise
(Singer 1970). The answer is the mean of both, weighted by their probabilities.

Vulnerable road users: a Kalman filter of constant velocity along x and along y, stirred by white
acceleration. They head where they move, as in recordings.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python. Row k of what they return depends on the rows 0 … k of what they are given.

MERGED: Histories as a tracker would know them: filtered forward only, on positions with noise.

Recorded tracks are smoothed with look-ahead, so a state of them holds about half a second of what
comes next. Here each recorded position and heading gets white noise (0.08 m, 1.5°) and is filtered
again, so that the state at a frame is made of measurements up to that frame alone.
"""

import dataclasses
import hashlib
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, SupportsIndex, no_type_check, overload

import numpy as np
from jaxtyping import Float
from numba import njit

from asp_env.data import cache
from asp_env.data.classes import VULNERABLE
from asp_env.data.recording import Recording
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import DataError
from asp_env.geometry import wrap_scalar

POSITION_SIGMA_M = 0.08
"""Standard deviation of a measured coordinate, white from frame to frame."""

HEADING_SIGMA_RAD = math.radians(1.5)

SPEED_SIGMA_MPS = 0.1
"""Of the one speed that is measured, at a track's first frame."""

SPEED_SIGMA_SHARE = 0.05
"""This share of that speed is added to its standard deviation."""

ACCELERATION_SIGMA_MPS2 = 1.0
"""A larger one follows braking sooner and shakes more."""

ACCELERATION_FADES_S = 2.0
CURVATURE_SIGMA_PER_M = 0.04
CURVATURE_FADES_S = 3.0
CALM_MPS = 5.0
"""Curvature varies less the faster one goes: its sigma is divided by 1 + (speed / this)²."""

HEADING_DRIFT = 1e-5
"""Variance that a heading gains besides, rad²/s."""

POSITION_DRIFT = 3e-4
"""Variance that a coordinate gains besides, m²/s."""

STANDS_FOR_S = 20.0
"""How long a vehicle stands, on average, before it moves."""

MOVES_FOR_S = 2.0
"""How long a slow vehicle moves before it stands; no faster one comes to a sudden stand."""

SLOW_MPS = 0.4
"""Scale of speed within which a vehicle may come to stand."""

NEVER_STANDS_MPS = 2.0
"""Above this only the hypothesis of motion is followed."""

START_SIGMA_MPS = 0.2
"""Speed of a vehicle that has just begun to move."""

WALK_NOISE = 0.15
"""Spectral density of a vulnerable road user's acceleration, m²/s³."""

TURNS_ABOVE_MPS = 0.6
"""Above this the direction of motion is a vulnerable road user's heading."""

_MAX_SIN_SLIP = 0.6
_NEVER = 1e-9


@njit(cache=True, nogil=True)
@no_type_check
def _halt(m, before):
    """Braking ends at standstill: who is to go the other way does so from the next frame on."""
    if m[3] * before < 0.0:
        m[3] = 0.0
        m[4] = 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _predict(m, p, work, rear, dt, keep_a, keep_c, noise_a, noise_c):
    """Moves state m (6,) and covariance p (6, 6) of the hypothesis of motion on by one frame."""
    way = m[3] * dt + 0.5 * m[4] * dt * dt
    sin_slip = min(max(rear * m[5], -_MAX_SIN_SLIP), _MAX_SIN_SLIP)
    cos_slip = math.sqrt(1.0 - sin_slip * sin_slip)
    course = m[2] + math.asin(sin_slip) + 0.5 * m[5] * way
    cosine, sine = math.cos(course), math.sin(course)
    bend = rear / cos_slip + 0.5 * way
    turn = 0.5 * m[5] * dt * way
    # rows of the Jacobian that differ from the identity
    x_t, x_v, x_c = -way * sine, dt * cosine - turn * sine, -way * sine * bend
    y_t, y_v, y_c = way * cosine, dt * sine + turn * cosine, way * cosine * bend
    t_v = m[5] * dt
    half = 0.5 * dt
    for j in range(6):
        v, a, c, t = p[3, j], p[4, j], p[5, j], p[2, j]
        mean_v = v + half * a
        work[0, j] = p[0, j] + x_t * t + x_v * mean_v + x_c * c
        work[1, j] = p[1, j] + y_t * t + y_v * mean_v + y_c * c
        work[2, j] = t + t_v * mean_v + way * c
        work[3, j] = v + dt * a
        work[4, j] = keep_a * a
        work[5, j] = keep_c * c
    for i in range(6):
        v, a, c, t = work[i, 3], work[i, 4], work[i, 5], work[i, 2]
        mean_v = v + half * a
        p[i, 0] = work[i, 0] + x_t * t + x_v * mean_v + x_c * c
        p[i, 1] = work[i, 1] + y_t * t + y_v * mean_v + y_c * c
        p[i, 2] = t + t_v * mean_v + way * c
        p[i, 3] = v + dt * a
        p[i, 4] = keep_a * a
        p[i, 5] = keep_c * c
    calm = 1.0 + (m[3] / CALM_MPS) ** 2
    p[0, 0] += POSITION_DRIFT * dt
    p[1, 1] += POSITION_DRIFT * dt
    p[2, 2] += HEADING_DRIFT * dt
    p[4, 4] += noise_a
    p[5, 5] += noise_c / (calm * calm)

    m[0] += way * cosine
    m[1] += way * sine
    m[2] += m[5] * way
    before = m[3]
    m[3] += m[4] * dt
    m[4] *= keep_a
    m[5] *= keep_c
    _halt(m, before)


@njit(cache=True, nogil=True)
@no_type_check
def _update(m, p, i, innovation, variance):
    """Takes in a measurement of component i; returns minus twice its log density."""
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
    """Lets the hypotheses exchange what they know; returns the probability of standing now.

    Args:
        m: state of motion, (6,).
        p: its covariance, (6, 6).
        still: [x, y, heading] of standing.
        spread: their variances.
        standing: probability of standing so far.
        dt: seconds between frames.
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
    """How far a measurement lies from a state in component j; headings the short way round."""
    return wrap_scalar(seen[j] - state[j]) if j == 2 else seen[j] - state[j]


@njit(cache=True, nogil=True)
@no_type_check
def _observe_standing(still, spread, seen, noise, drift):
    """Takes in a measurement under the hypothesis of standing; returns as `_update` does."""
    unlikely = 0.0
    for j in range(3):
        innovation = _apart(seen, still, j)
        spread[j] += drift[j]
        s = spread[j] + noise[j]
        still[j] += spread[j] / s * innovation
        spread[j] *= noise[j] / s
        unlikely += innovation * innovation / s + math.log(s)
    return unlikely


@njit(cache=True, nogil=True)
@no_type_check
def _turn_about(m, still):
    """The same motion of a vehicle whose other end is the front."""
    m[2] += math.pi
    still[2] += math.pi
    for i in range(3, 6):
        m[i] = -m[i]


@njit(cache=True, nogil=True)
@no_type_check
def _believe(standing, unlikely_standing, unlikely_moving):
    """The probability of standing after a measurement."""
    ratio = math.exp(min(max(0.5 * (unlikely_standing - unlikely_moving), -50.0), 50.0))
    after = standing / (standing + (1.0 - standing) * ratio)
    return min(max(after, _NEVER), 1.0 - _NEVER)


@njit(cache=True, nogil=True)
@no_type_check
def follow_vehicle(measured, speed, rear, dt, states):
    """Follows one vehicle.

    Args:
        measured: (n, 3) float64, [x m, y m, heading rad] at consecutive frames.
        speed: measured at the first frame, m/s.
        rear: distance from the box's centre to the rear axle, m.
        dt: seconds between frames.
        states: (n, 4) float32, receives [x, y, heading, speed].
    """
    noise = (POSITION_SIGMA_M**2, POSITION_SIGMA_M**2, HEADING_SIGMA_RAD**2)
    drift = (POSITION_DRIFT * dt, POSITION_DRIFT * dt, HEADING_DRIFT * dt)
    keep_a, keep_c = math.exp(-dt / ACCELERATION_FADES_S), math.exp(-dt / CURVATURE_FADES_S)
    noise_a = ACCELERATION_SIGMA_MPS2**2 * (1.0 - keep_a * keep_a)
    noise_c = CURVATURE_SIGMA_PER_M**2 * (1.0 - keep_c * keep_c)
    m, p, work = np.zeros(6), np.zeros((6, 6)), np.empty((6, 6))
    still, spread = np.empty(3), np.empty(3)
    for j in range(3):
        m[j] = still[j] = measured[0, j]
        p[j, j] = spread[j] = noise[j]
    m[3] = speed
    p[3, 3] = (SPEED_SIGMA_MPS + SPEED_SIGMA_SHARE * abs(speed)) ** 2
    p[4, 4] = ACCELERATION_SIGMA_MPS2**2
    p[5, 5] = (CURVATURE_SIGMA_PER_M / (1.0 + (speed / CALM_MPS) ** 2)) ** 2
    standing = max(0.5 * math.exp(-0.5 * (speed / SLOW_MPS) ** 2), _NEVER)
    for k in range(len(measured)):
        if k > 0:
            seen = measured[k]
            if abs(_apart(seen, m, 2)) > 0.5 * math.pi:
                _turn_about(m, still)
            slow = abs(m[3]) < NEVER_STANDS_MPS
            if slow:
                standing = _mix(m, p, still, spread, standing, dt)
            _predict(m, p, work, rear, dt, keep_a, keep_c, noise_a, noise_c)
            unlikely, before = 0.0, m[3]
            for j in range(3):
                unlikely += _update(m, p, j, _apart(seen, m, j), noise[j])
            _halt(m, before)
            if slow:
                other = _observe_standing(still, spread, seen, noise, drift)
                standing = _believe(standing, other, unlikely)
            else:
                standing = _NEVER
                for j in range(3):
                    still[j], spread[j] = m[j], p[j, j]
        for j in range(2):
            states[k, j] = m[j] + standing * (still[j] - m[j])
        states[k, 2] = wrap_scalar(m[2] + standing * _apart(still, m, 2))
        states[k, 3] = (1.0 - standing) * m[3]


@njit(cache=True, nogil=True)
@no_type_check
def follow_vulnerable(measured, speed, dt, states):
    """Follows one pedestrian, bicycle or animal; arguments as in `follow_vehicle`."""
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
        if total > TURNS_ABOVE_MPS:
            heading = math.atan2(speed_y, speed_x)
        states[k, 0], states[k, 1] = x, y
        states[k, 2], states[k, 3] = wrap_scalar(heading), total


VERSION = 1
"""Raise whenever the filter or its noise gives other states for the same recording."""


class CausalHistories(Sequence[Any]):  # not of Recording: checking its items would filter them
    """Recordings with causal states, each filtered when it is first asked for."""

    def __init__(self, recordings: Sequence[Any]) -> None:
        """Filters nothing yet.

        Args:
            recordings: as they were recorded; opened no earlier than asked for.
        """
        self._recorded = recordings
        self._filtered: dict[int, Recording] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process filters anew what is not in the cache."""
        return CausalHistories, (self._recorded,)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._recorded)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "CausalHistories": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | CausalHistories":
        """One recording with causal states, or some of them, still unfiltered."""
        if isinstance(index, slice):
            return CausalHistories(self._recorded[index])
        number = range(len(self))[index]
        if number not in self._filtered:
            recording = self._recorded[number]
            self._filtered[number] = dataclasses.replace(recording, states=_kept(recording))
        return self._filtered[number]

    def __iter__(self) -> Iterator[Recording]:
        """Filters one after the other."""
        return (self[index] for index in range(len(self)))


def causal_histories(recordings: Sequence[Any]) -> CausalHistories:
    """The same recordings with `states` as a causal tracker knows them; all else is unchanged.

    Make scenes of these, and snippets, futures and labels of the recorded ones. What was filtered
    is kept in the cache folder, by content, and mapped into memory from then on.
    """
    return CausalHistories(recordings)


def causal_states(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """The states of all rows, each made of its track's rows up to it.

    The noise is drawn from a generator of each track's own, seeded by the location's and the
    recording's name and the track's id. A track begins with its first measurement; its speed is
    measured there and nowhere else, with an error of 0.1 m/s + 5 %: who comes into view has been
    seen to move.
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
            follow_vulnerable(measured, speed_mps, dt_s, states[rows])
        else:
            rear_m = AXLE_SHARE_OF_LENGTH * float(recording.sizes[track, 0])
            follow_vehicle(measured, speed_mps, rear_m, dt_s, states[rows])
    states.flags.writeable = False
    return states


def _measure(
    rng: np.random.Generator, states: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Positions and headings with noise, and the speed at the first frame."""
    first_mps = float(states[0, 3])
    sigma_mps = SPEED_SIGMA_MPS + SPEED_SIGMA_SHARE * abs(first_mps)
    speed_mps = first_mps + sigma_mps * float(rng.standard_normal())
    errors = rng.standard_normal((len(states), 3))
    errors *= (POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD)
    return states[:, :3] + errors, speed_mps


def _kept(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """The causal states, read-only, from the cache if it has them; otherwise it gets them.

    Where the cache cannot be written to, they are filtered anew each time, and a warning says so.
    """
    content = _digest(recording)
    stamp = [["causal", VERSION, content]]
    try:
        path = cache.cache_folder() / f"causal-{content[:20]}.bin"
    except DataError as error:
        warnings.warn(f"nothing is kept for next time: {error}", stacklevel=2)
        return causal_states(recording)
    if (found := cache.load(path, stamp)) is not None:
        return found[1]["states"]
    states = causal_states(recording)
    try:
        cache.save(path, stamp, {}, {"states": states})
    except OSError as error:
        warnings.warn(f"nothing is kept for next time: {path}: {error.strerror}", stacklevel=2)
    found = cache.load(path, stamp)
    return states if found is None else found[1]["states"]


def _digest(recording: Recording) -> str:
    """A hash of all that the causal states are made of."""
    digest = hashlib.sha256(
        repr((recording.location, recording.name, recording.frame_rate_hz)).encode()
    )
    for column in ("track_ids", "classes", "sizes", "starts", "states"):
        digest.update(np.ascontiguousarray(getattr(recording, column)).data)
    return digest.hexdigest()
