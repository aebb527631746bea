"""Drivers of dense traffic: four temperaments that the recorded history does not reveal at once."""

import numpy as np

TEMPERAMENTS = {"courteous": 0.10, "ordinary": 0.40, "pushing": 0.45, "hesitant": 0.05}
"""Shares of the drivers. Chosen by hand.

`courteous` accepts long gaps only; `ordinary` is the driver of normal traffic with a wider range of
speeds; `pushing` enters short gaps and does not always yield to slow vehicles; `hesitant` waits for
long gaps and starts late.
"""


def dense_driver(rng: np.random.Generator) -> dict[str, float]:
    """Draws a temperament and the attributes of SUMO's vehicle type that express it.

    The attributes are those of SUMO's junction model (`jm…`), its car-following model EIDM and its
    lane-change model. All ranges are chosen by hand: they spread the accepted gaps as far as the
    vehicles on the priority road can still brake.

    Args:
        rng: draws the temperament and all attributes.

    Returns:
        Attributes by name; they replace those of normal traffic.
    """
    temperament = str(rng.choice(list(TEMPERAMENTS), p=list(TEMPERAMENTS.values())))
    match temperament:
        case "courteous":
            gap_s, impatience, ignore = rng.uniform(0.5, 1.0), rng.uniform(0.4, 0.8), 0.0
            speed, tau_s = rng.normal(0.92, 0.08), rng.uniform(1.2, 2.0)
            accel, delay_s = rng.uniform(1.2, 1.9), rng.uniform(0.0, 0.6)
        case "ordinary":
            gap_s, impatience, ignore = rng.uniform(0.0, 0.5), rng.uniform(0.7, 1.0), 0.5
            speed, tau_s = rng.normal(1.0, 0.10), rng.uniform(0.9, 1.6)
            accel, delay_s = rng.uniform(1.4, 2.2), rng.uniform(0.0, 0.4)
        case "pushing":
            gap_s, impatience, ignore = rng.uniform(0.0, 0.2), rng.uniform(0.9, 1.0), 1.0
            speed, tau_s = rng.normal(1.15, 0.10), rng.uniform(0.7, 1.1)
            accel, delay_s = rng.uniform(1.8, 2.4), 0.0
        case _:
            gap_s, impatience, ignore = rng.uniform(1.0, 2.0), rng.uniform(0.2, 0.5), 0.0
            speed, tau_s = rng.normal(0.85, 0.08), rng.uniform(1.3, 2.2)
            accel, delay_s = rng.uniform(1.0, 1.6), rng.uniform(0.5, 1.5)
    return {
        "jmTimegapMinor": gap_s,
        "impatience": impatience,
        "jmIgnoreFoeProb": ignore,
        "jmIgnoreFoeSpeed": float(rng.uniform(6.0, 12.0)),
        "speedFactor": float(np.clip(speed, 0.65, 1.35)),
        "tau": tau_s,
        "accel": accel,
        "startupDelay": delay_s,
        "lcStrategic": float(rng.uniform(0.3, 1.5)),
    }
