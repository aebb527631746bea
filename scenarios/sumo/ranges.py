"""The ranges from which `--traffic varied` draws: sites, demand, drivers, maps and trackers.

Real recordings differ in all of these. The ranges are wide on purpose: a predictor that is trained
on varied traffic meets at a real site something between what it has seen (domain randomisation).
"""

from dataclasses import dataclass, field

from scenarios.sumo.sites import Control

Range = tuple[float, float]
"""Lowest and highest value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteRanges:
    """Geometry of a location. Chosen by hand: what town maps show, from lane to main road."""

    half_size_m: Range = (44.0, 72.0)
    """Half the width of the image; its height is 0.75 to 1 of that."""
    arms: tuple[int, ...] = (3, 3, 4, 4, 4, 5)
    """Numbers of arms, all equally probable."""
    skew_rad: float = 0.61
    """Largest deviation of an arm's direction from even spacing or a T: 35 degrees."""
    least_gap_rad: float = 0.87
    """Smallest angle between neighbouring arms of an intersection: 50 degrees."""
    bend_per_m: Range = (0.0, 0.04)
    """Largest curvature of an arm."""
    bend_turn_rad: Range = (0.0, 1.2)
    """Angle by which a bend turns the arm."""
    bend_from_m: Range = (8.0, 50.0)
    """Distance from the centre, or from the end of the bend before, at which a bend begins."""
    second_bend: float = 0.4
    """Share of arms with a bend to the other side after the first one."""
    lane_m: Range = (2.8, 5.5)
    """Lane width of a location."""
    lane_differs_m: float = 0.3
    """Largest deviation of an arm's lanes from it."""
    median: float = 0.35
    """Share of arms with a gap between the directions."""
    median_m: Range = (0.4, 4.0)
    corner_m: Range = (4.0, 15.0)
    """Radius of an intersection's corners."""
    limits_kmh: tuple[float, ...] = (10, 20, 30, 30, 40, 50, 50, 50, 60, 60)
    """Speed limits of a location, all equally probable."""
    limit_differs_kmh: float = 20.0
    """Largest deviation of an arm's limit; all limits lie within those above."""
    one_way: float = 0.12
    """Share of arms that only enter or only leave, of those that are not needed for both."""
    two_lanes: float = 0.25
    """Share of arms of an intersection with two lanes in a direction."""
    pocket: float = 0.5
    """Share of arms with two entering lanes whose left one is for left turns only."""
    crossing: Range = (0.0, 0.9)
    """Share of arms with a zebra crossing, at a location."""
    controls: tuple[tuple[Control, float], ...] = (
        ("priority", 0.4),
        ("right_before_left", 0.15),
        ("traffic_light", 0.45),
    )
    """Rules of the right of way with their shares; signals are not part of the recording."""
    split_m: Range = (22.0, 34.0)
    """Distance of crossings from the centre of an intersection."""
    ring_radius_m: Range = (7.0, 30.0)
    """Radius of the middle of a ring's lanes; small ones are more frequent than large ones."""
    ring_lane_m: Range = (4.4, 6.5)
    """Width of the lane of a ring; of each of two lanes at most 5.3 m."""
    two_ring_lanes: float = 0.35
    """Share of two-lane rings among those of at least `wide_radius_m`."""
    wide_radius_m: float = 17.0
    ring_acceleration_mps2: Range = (1.5, 3.0)
    """Lateral acceleration at the ring's speed limit."""
    entry_tilt_rad: Range = (0.0, 0.45)
    """Angle of an entry from the radius towards the direction of travel in the ring."""
    mouth_m: Range = (1.2, 4.0)
    """Half the distance between entry and exit of an arm, at the ring."""
    swing_m: Range = (0.2, 1.2)
    """Additional width of the lanes near the ring."""
    approach_m: Range = (14.0, 24.0)
    """Distance of crossings from the ring."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficRanges:
    """Demand and drivers of a location.

    Chosen by hand: from almost empty to jams, and no class is rare at every location.
    """

    vehicles_per_hour: Range = (500.0, 2200.0)
    """Drawn on a logarithmic scale."""
    no_pedestrians: float = 0.25
    """Share of locations without pedestrians."""
    pedestrians_per_hour: Range = (20.0, 400.0)
    share_spread: float = 0.9
    """Standard deviation of the logarithm by which the share of each class differs."""
    left_odds: Range = (0.6, 2.0)
    """Odds of a left turn, relative to those in normal traffic."""
    dense_drivers: float = 0.45
    """Share of locations with the drivers of dense traffic, some of which do not yield."""
    speed_mean: Range = (0.85, 1.1)
    """Mean desired speed of a location, relative to the limit."""
    speed_spread: Range = (0.05, 0.2)
    """Standard deviation of the desired speed within a location."""
    speed_factor: Range = (0.5, 1.3)
    """Bounds of the desired speed, relative to the limit."""
    slow: Range = (0.0, 0.04)
    """Share of vehicles that are slow everywhere, as tractors and vehicles looking for a place."""
    slow_mps: Range = (2.0, 6.0)
    bicycle_mps: Range = (2.5, 7.5)
    accel_factor: Range = (0.8, 1.6)
    """Factor on the accelerations of a location."""
    stops: Range = (0.0, 0.12)
    """Share of vehicles that stop on their lane: a passenger, a parcel, a place that gets free."""
    stop_s: Range = (3.0, 45.0)
    offset_m: float = 0.7
    """Largest deviation from the middle of the lane, as far as the lane is wide enough."""
    beside_m: float = 0.3
    """Distance between a vehicle that is off the middle and the border of the lane."""
    wander_m: Range = (0.0, 0.2)
    """Amplitude of slow deviations along the way."""
    wander_length_m: Range = (25.0, 90.0)
    """Wave length of these deviations."""
    rounding: Range = (0.7, 1.7)
    """Factor on the length over which a path is smoothed: how far a driver cuts corners."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRanges:
    """Styles of maps. Chosen by hand: maps of public data sets differ in all of these."""

    offset_m: float = 1.0
    """Largest offset of the map from the tracks."""
    rotation_rad: float = 0.0175
    """Largest rotation of the map about the middle of the image: 1 degree."""
    exact: float = 0.35
    """Share of maps without offset and rotation."""
    no_markings: float = 0.25
    """Share of maps whose lane markings are virtual lines."""
    no_curbs: float = 0.25
    """Share of maps whose curbs are virtual lines."""
    some_missing: float = 0.3
    """Share of maps with random lines made virtual."""
    missing: Range = (0.05, 0.5)
    """Share of lines that are made virtual in these maps."""
    solid: float = 0.3
    """Share of maps whose dashed lines are solid."""
    shared_lanes: float = 0.25
    """Share of maps that show both directions of a road as one wide lane without a centre line."""
    shared: float = 0.7
    """Share of roads to which this applies, in these maps."""
    two_way_lanes: float = 0.15
    """Share of maps in which no lane is one-way."""
    no_limits: float = 0.4
    """Share of maps without speed limits."""
    one_limit: float = 0.2
    """Share of maps with the same limit on all lanes."""
    no_walkways: float = 0.5
    """Share of maps without walkways."""
    no_crosswalks: float = 0.3
    """Share of maps without zebra crossings."""
    no_areas: float = 0.4
    """Share of maps without parking areas."""
    long_lanes: float = 0.35
    """Share of maps in which consecutive lanelets are joined."""
    short_lanes: float = 0.35
    """Share of maps in which lanelets are cut into short ones."""
    piece_m: Range = (5.0, 25.0)
    """Length of these short lanelets."""
    spacing_m: Range = (1.0, 8.0)
    """Distance between the points of a line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerRanges:
    """Frame rates and measurement errors of a recording.

    Chosen by hand: from a drone in still air to cameras on poles. Small errors are more frequent
    than large ones.
    """

    frame_rates_hz: tuple[int, ...] = (10, 15, 20, 25, 30)
    """Multiples of 5 Hz, so that 0.2 s are whole frames."""
    position_m: Range = (0.02, 0.25)
    """Standard deviation of the error of each coordinate, on a logarithmic scale."""
    slow_share: Range = (0.3, 0.95)
    """Share of its variance that varies slowly; the rest is independent in each frame."""
    correlation_s: Range = (0.5, 2.0)
    """Correlation time of the slowly varying part."""
    heading_rad: Range = (0.0087, 0.087)
    """Standard deviation of the error of the heading, 0.5 to 5 degrees, on a logarithmic scale."""
    standstill: Range = (0.0, 0.5)
    """Rate at which errors change at standstill, relative to that of a moving agent: a detector
    that sees the same picture repeats its error."""
    moves_mps: float = 2.0
    """Speed from which on errors change at the full rate."""
    wobble: float = 0.35
    """Share of recordings whose headings wobble at standstill."""
    wobble_rad: Range = (0.03, 0.35)
    """Standard deviation of the wobble."""
    window_s: Range = (0.0, 1.0)
    """Window of the smoothing filter of positions and headings."""
    velocity_window_s: Range = (0.4, 1.0)
    """Window over which velocities are derived; at least the filter's."""
    gaps_per_minute: Range = (0.0, 2.0)
    """Rate of drop-outs of a track."""
    gap_s: Range = (0.2, 1.2)
    cut: float = 0.3
    """Share of drop-outs after which the track goes on under another id; in the others positions
    are interpolated."""
    size_factor: Range = (0.85, 1.15)
    """Factor on the size of a track."""
    wrong_class: Range = (0.0, 0.08)
    """Share of bicycles and motorcycles that are taken for each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """All ranges of varied traffic."""

    site: SiteRanges = field(default_factory=SiteRanges)
    traffic: TrafficRanges = field(default_factory=TrafficRanges)
    map: MapRanges = field(default_factory=MapRanges)
    tracker: TrackerRanges = field(default_factory=TrackerRanges)


RANGES = Ranges()
"""The ranges in use."""
