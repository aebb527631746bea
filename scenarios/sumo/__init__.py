"""Traffic from SUMO in the inD layout: intersections and roundabouts, as many as wanted.

The roads are drawn by seed (`junctions`, `roundabouts`), built by netconvert, filled with drivers
that all differ (`demand`) and simulated (`sumo`). What SUMO reports is turned into the motion of
vehicles with two axles (`motion`) and written as a camera above the place would have seen it.
"""

from scenarios.sumo.dataset import open_source, synthesize

__all__ = ["open_source", "synthesize"]
