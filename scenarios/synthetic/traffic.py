"""One recording's road users: demand, simulation, motion, and what the picture shows of it."""

import numpy as np
from jaxtyping import Float

from scenarios.noise import measure
from scenarios.synthetic.demand import RoadUser, demand
from scenarios.synthetic.motion import FRAME_RATE_HZ, Motion, reconstruct
from scenarios.synthetic.overlaps import overlapping
from scenarios.synthetic.place import Place
from scenarios.synthetic.sumo import Movements, simulate
from scenarios.tables import Track

WARM_UP_S = 80.0
"""Before the recording begins, so that the place is full when it does."""
_AFTER_S = 4.0
_FEWEST_FRAMES = 25
_EDGE_M = 1.0
_MOST_ATTEMPTS = 12


def record(
    rng: np.random.Generator, place: Place, *, num_frames: int
) -> tuple[dict[str, Motion], dict[str, RoadUser]]:
    """Simulates traffic at a place in which nobody touches anybody.

    SUMO's vehicles follow their lanes with the front bumper; the boxes that roll after may still
    touch. Then the later of the two stays at home and the same traffic is simulated again, which
    changes nothing before its departure.

    Returns:
        All motions in the recording's frame, by name, and the road users by name.
    """
    seconds = WARM_UP_S + num_frames / FRAME_RATE_HZ + _AFTER_S
    wanted = demand(rng, place.site, seconds)
    seed = int(rng.integers(1, 2**31 - 1))
    motions: dict[str, Motion] = {}
    late: set[str] = set()
    for _ in range(_MOST_ATTEMPTS):
        moved = simulate(place.folder, wanted.routes, seconds=seconds, seed=seed)
        motions = _motions(moved, place, wanted.users)
        departs = {name: depart for depart, name, _ in wanted.entries}
        late = {
            max(pair, key=lambda name: (departs[name], name))
            for pair in overlapping(motions, wanted.users)
        }
        if not late:
            break
        wanted = wanted.without(late)
    else:  # never seen; whoever still touches somebody is left out of the picture
        motions = {name: motion for name, motion in motions.items() if name not in late}
    return motions, wanted.users


def _motions(moved: Movements, place: Place, users: dict[str, RoadUser]) -> dict[str, Motion]:
    motions: dict[str, Motion] = {}
    for number, name in enumerate(moved.names):
        rows = slice(moved.starts[number], moved.starts[number + 1])
        motion = reconstruct(
            moved.times_s[rows],
            moved.points[rows] + place.shift_m,
            kind=users[name].kind,
            length_m=users[name].length_m,
        )
        if motion is not None:
            motions[name] = motion
    return motions


def tracks_in_view(
    place: Place,
    motions: dict[str, Motion],
    users: dict[str, RoadUser],
    *,
    num_frames: int,
    noise: np.random.Generator | None = None,
) -> list[Track]:
    """What a camera above the place sees of the motions, by first appearance.

    Args:
        place: where.
        motions: of all road users, by name; frame 0 is the start of the simulation.
        users: class and size of the same names.
        num_frames: how long the recording is.
        noise: draws measurement errors; without it the truth is seen.
    """
    tracks: list[tuple[int, str, Track]] = []
    for name in sorted(motions):
        motion, user = motions[name], users[name]
        window = _seen(motion, place, num_frames)
        if window is None:
            continue
        xy, heading = motion.xy, motion.heading_rad
        if noise is not None:
            xy, heading = measure(noise, xy, heading)
        track = make_track(user, xy, heading, motion.first_frame, window)
        tracks.append((track.first_frame, name, track))
    tracks.sort(key=lambda entry: entry[:2])
    return [track for _, _, track in tracks]


def make_track(
    user: RoadUser,
    xy: Float[np.ndarray, "frames 2"],
    heading_rad: Float[np.ndarray, " frames"],
    first_frame: int,
    window: slice,
) -> Track:
    """Derives velocities and accelerations, then keeps the rows of `window`."""
    velocity = np.gradient(xy, 1.0 / FRAME_RATE_HZ, axis=0)
    acceleration = np.gradient(velocity, 1.0 / FRAME_RATE_HZ, axis=0)
    return Track(
        kind=user.kind,
        length_m=user.length_m,
        width_m=user.width_m,
        first_frame=first_frame + window.start - round(WARM_UP_S * FRAME_RATE_HZ),
        xy=xy[window],
        heading_rad=heading_rad[window],
        velocity_mps=velocity[window],
        acceleration_mps2=acceleration[window],
    )


def _seen(motion: Motion, place: Place, num_frames: int) -> slice | None:
    """The longest time without a gap in which a road user is in the picture."""
    frames = motion.first_frame + np.arange(len(motion.xy)) - round(WARM_UP_S * FRAME_RATE_HZ)
    half = np.array(place.site.half_size_m) - _EDGE_M
    seen = np.all(np.abs(motion.xy - place.shift_m) < half, axis=1)
    seen &= (frames >= 0) & (frames < num_frames)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
    if not len(edges):
        return None
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    if ends[longest] - begins[longest] < _FEWEST_FRAMES:
        return None
    return slice(int(begins[longest]), int(ends[longest]))


def parked_cars(rng: np.random.Generator, place: Place, num_frames: int) -> list[Track]:
    """Cars that stand in the parking places from the first frame to the last."""
    tracks = []
    still = np.zeros((num_frames, 2))
    for lot in place.parking:
        along, deep = lot[1] - lot[0], lot[3] - lot[0]
        stalls = max(1, round(float(np.hypot(*along)) / 2.6))
        taken = rng.random(stalls) < 0.7
        taken[rng.integers(stalls)] = True
        for stall in np.flatnonzero(taken):
            middle = lot[0] + (stall + 0.5) / stalls * along + 0.5 * deep
            heading = float(np.arctan2(deep[1], deep[0])) + np.pi * float(rng.integers(2))
            heading += float(rng.normal(0.0, 0.02))
            tracks.append(
                Track(
                    kind="car",
                    length_m=round(float(rng.uniform(3.9, 4.8)), 2),
                    width_m=round(float(rng.uniform(1.7, 1.9)), 2),
                    first_frame=0,
                    xy=np.tile(middle, (num_frames, 1)),
                    heading_rad=np.full(num_frames, heading),
                    velocity_mps=still,
                    acceleration_mps2=still,
                )
            )
    return tracks
