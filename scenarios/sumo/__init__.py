"""Traffic of SUMO in the inD layout: any number of intersections and roundabouts.

Sites are drawn by seed (`sites`), built by netconvert and filled with agents that all differ
(`demand`), whose motion SUMO simulates (`network`). The positions that SUMO reports become the
motion of vehicles with two axles (`motion`), which are written as seen by a camera above the
location (`place`, `dataset`).
"""

from scenarios.sumo.dataset import open_source, synthesize

__all__ = ["open_source", "synthesize"]
