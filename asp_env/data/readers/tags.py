"""Values of tags of Lanelet2 maps: booleans, participants, speeds and traffic signs.

They are read as by Lanelet2's `Attribute` and `TrafficRules`, and in any case of letters.
"""

import re
from collections.abc import Mapping

BOOLEANS: Mapping[str, bool] = {
    "yes": True,
    "true": True,
    "1": True,
    "no": False,
    "false": False,
    "0": False,
}
"""Texts that Lanelet2 reads as a boolean."""

SPEED_UNITS: Mapping[str, float] = {
    "": 1 / 3.6,
    **dict.fromkeys(("km/h", "kmh", "kph", "kmph"), 1 / 3.6),
    **dict.fromkeys(("m/s", "mps"), 1.0),
    **dict.fromkeys(("mph", "mi/h", "m/h"), 0.44704),
}
"""Units of speeds in m/s. A number without a unit is in km/h, in Lanelet2 as in OSM."""

SIGNS_KMH: Mapping[str, float] = {"de274": 30.0, "de274.1": 30.0, "de310": 50.0}
"""Speeds of German signs without a number, km/h. The first and the last are Lanelet2's; 274.1 is
the sign of a zone, 30 km/h unless the sign states another speed (VwV-StVO)."""

MPH_COUNTRIES = frozenset({"us", "gb", "uk"})
"""Country codes at the start of signs whose numbers are in mph."""

MAX_LIMIT_MPS = 100.0
"""No speed limit is higher. Chosen by hand."""

VEHICLE = "participant:vehicle"
"""The tag that allows or forbids vehicles; with `:car`, `:bus` and so on for some of them only."""

_SPEED = re.compile(r"(\d{1,6}(?:\.\d{1,6})?)\s*([a-z/]*)")
_SIGN_WITH_UNIT = re.compile(r"[a-z][a-z0-9._-]*?[a-z_-](\d{1,3})\s*([a-z/]+)")
_SIGN_OF_COUNTRY = re.compile(r"([a-z]{2})[a-z0-9._-]*[-_](\d{1,2}[05]|5)")


def boolean(text: str) -> bool | None:
    """A boolean: `yes`, `no`, `true`, `false`, `1` or `0` in any case; None for another text."""
    return BOOLEANS.get(text.strip().lower())


def speed_mps(text: str) -> float | None:
    """A speed such as `50 km/h` or `30 mph`; None if the text is not a speed above 0."""
    match = _SPEED.fullmatch(text.strip().lower())
    if match is None or match[2] not in SPEED_UNITS:
        return None
    return _limit(float(match[1]) * SPEED_UNITS[match[2]])


def sign_mps(text: str) -> float | None:
    """The speed limit of a traffic sign, or None if it is unknown.

    Args:
        text: a speed, as for `speed_mps`; a sign that ends in a number with a unit (`cn60kmh`,
            `R2-1-35mph`); or a country code and the sign's number there, with the speed at the end
            (`de274-60`, `usR2-1-35`; in mph in the USA and the United Kingdom).
    """
    sign = text.strip().lower()
    if (speed := speed_mps(sign)) is not None:
        return speed
    if sign in SIGNS_KMH:
        return SIGNS_KMH[sign] * SPEED_UNITS["km/h"]
    if match := _SIGN_WITH_UNIT.fullmatch(sign):
        return _limit(float(match[1]) * SPEED_UNITS.get(match[2], 0.0))
    if match := _SIGN_OF_COUNTRY.fullmatch(sign):
        unit = "mph" if match[1] in MPH_COUNTRIES else "km/h"
        return _limit(float(match[2]) * SPEED_UNITS[unit])
    return None


def vehicles_allowed(tags: Mapping[str, str]) -> tuple[bool | None, bool]:
    """Whether the participants of a lanelet include any vehicles.

    As in Lanelet2, one tag of a participant forbids all that no tag allows.

    Returns:
        The answer, None if no tag names a participant or none has a boolean value; and whether all
        such tags have one.
    """
    values = {
        key: boolean(value)
        for key, value in tags.items()
        if key == "participant" or key.startswith("participant:")
    }
    known = {key: value for key, value in values.items() if value is not None}
    are_all_known = len(known) == len(values)
    if not known:
        return None, are_all_known
    return any(allowed for key, allowed in known.items() if _covers_vehicles(key)), are_all_known


def two_way(tags: Mapping[str, str]) -> tuple[bool, bool]:
    """Whether vehicles may drive along a lanelet in both directions.

    `one_way` (Lanelet2) has priority over `one_way:vehicle` and its subclasses, and these over
    `oneway` (OSM).

    Returns:
        The answer, no without a tag, and whether the tag was understood.
    """
    of_vehicles = sorted(key for key in tags if f"{key}:".startswith("one_way:vehicle:"))
    for key in ("one_way", *of_vehicles, "oneway"):
        if key in tags:
            value = boolean(tags[key])
            return value is False, value is not None
    return False, True


def limit_texts(tags: Mapping[str, str]) -> list[str]:
    """The texts of a lanelet's speed tags, in order of priority.

    `speed_limit:vehicle` and its subclasses, `speed_limit` (Lanelet2) and `maxspeed` (OSM).
    """
    of_vehicles = sorted(key for key in tags if f"{key}:".startswith("speed_limit:vehicle:"))
    return [tags[key] for key in (*of_vehicles, "speed_limit", "maxspeed") if key in tags]


def _covers_vehicles(key: str) -> bool:
    return key in ("participant", VEHICLE) or key.startswith(f"{VEHICLE}:")


def _limit(speed: float) -> float | None:
    return speed if 0.0 < speed <= MAX_LIMIT_MPS else None
