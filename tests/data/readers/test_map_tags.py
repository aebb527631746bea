"""Values of tags of maps, as Lanelet2 reads them, and regulatory elements for speed."""

from pathlib import Path

import pytest

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.tags import boolean, sign_mps, speed_mps, two_way, vehicles_allowed
from asp_env.data.road_map import RoadMap
from tests.data.levelx_files import ORIGIN_M, osm

ORIGIN = Origin(x_m=ORIGIN_M[0], y_m=ORIGIN_M[1], longitude_deg=6.1, latitude_deg=50.5)


def road_with(folder: Path, *, tags: dict[str, str], extra: str = "", member: str = "") -> RoadMap:
    """A map of lanelet `1` without special tags, and lanelet `2` with these tags and members."""
    ways = {
        name: ([(0.0, y), (30.0, y)], {"subtype": "solid"})
        for name, y in (("a", 0.0), ("b", 3.0), ("c", 6.0))
    }
    road = {"type": "lanelet", "subtype": "road"}
    lanelets = {
        "1": ({"left": "b", "right": "a"}, road),
        "2": ({"left": "c", "right": "b"}, {**road, **tags}),
    }
    text = osm(ways, lanelets).replace("</osm>", extra + "</osm>")
    path = folder / "place.osm"
    path.write_text(text.replace("<relation id='2'>", f"<relation id='2'>{member}"))
    return read_lanelet2(path, ORIGIN)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("yes", True), ("True", True), ("1", True), (" YES ", True)),
        *(("no", False), ("FALSE", False), ("0", False), ("", None), ("-1", None), ("2", None)),
    ],
)
def test_booleans(text: str, value: bool | None) -> None:
    assert boolean(text) is value


@pytest.mark.parametrize(
    ("text", "kmh"),
    [
        *(("15kmh", 15), ("50", 50), ("50 km/h", 50), ("10 mps", 36), ("10 m/s", 36)),
        *(("30 mph", 48.28032), ("30 m/h", 48.28032), ("7.5 kph", 7.5)),
        *(("de274", 30), ("de274-60", 60), ("DE274-5", 5), ("de274.1-20", 20), ("de310", 50)),
        *(("usR2-1-35", 56.32704), ("us_r2-1_25", 40.2336), ("gb670-30", 48.28032)),
        *(("R2-1-35mph", 56.32704), ("cn60kmh", 60), ("fr_B14-50", 50)),
        *(("usR2-1", None), ("solid", None), ("de205", None), ("0", None), ("-30", None)),
        *(("", None), ("nan", None), ("inf km/h", None), ("9" * 400, None), ("361 km/h", None)),
        ("cn60parsecs", None),
    ],
)
def test_speeds_of_signs(text: str, kmh: float | None) -> None:
    """Numbers with units, and country codes; no limit is 0 or above 100 m/s."""
    assert sign_mps(text) == (None if kmh is None else pytest.approx(kmh / 3.6))


def test_a_speed_is_no_sign() -> None:
    assert speed_mps("de274-60") is None


@pytest.mark.parametrize(
    ("tags", "allowed"),
    [
        ({}, None),
        ({"participant:vehicle": "yes"}, True),
        ({"participant:vehicle:bus": "TRUE", "participant:pedestrian": "no"}, True),
        ({"participant:bicycle": "yes"}, False),
        ({"participant:vehicle": "no"}, False),
        ({"participant:vehicle": "perhaps"}, None),
        ({"participants": "yes"}, None),
    ],
)
def test_participants(tags: dict[str, str], allowed: bool | None) -> None:
    """One tag of a participant forbids all that no tag allows."""
    known = all(boolean(value) is not None for value in tags.values())
    assert vehicles_allowed(tags) == (allowed, known)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"one_way": "No"}, (True, True)),
        ({"one_way": "0"}, (True, True)),
        ({"one_way": "true", "oneway": "no"}, (False, True)),
        ({"one_way:vehicle": "false"}, (True, True)),
        ({"one_way:bicycle": "no"}, (False, True)),
        ({"oneway": "-1"}, (False, False)),
    ],
)
def test_directions(tags: dict[str, str], expected: tuple[bool, bool]) -> None:
    assert two_way(tags) == expected


def element(number: int, *members: str, **tags: str) -> str:
    """A regulatory element for speed."""
    all_tags = {"type": "regulatory_element", "subtype": "speed_limit"} | tags
    text = "".join(f"<tag k='{key}' v='{value}' />" for key, value in all_tags.items())
    return f"<relation id='{number}'>{''.join(members)}{text}</relation>"


def refer(kind: str, number: str, role: str) -> str:
    """A member of a relation."""
    return f"<member type='{kind}' ref='{number}' role='{role}' />"


@pytest.mark.parametrize(
    ("tags", "extra", "kmh"),
    [
        ({}, element(9, sign_type="15kmh"), 15),
        ({"speed_limit": "50"}, element(9, sign_type="de274-30"), 30),
        ({}, element(9, refer("way", "a", "refers"), sign_type="20 mph"), 32.18688),
        ({}, element(9, refer("way", "s", "refers")), 70),
        ({"speed_limit": "50"}, element(9, sign_type="30", dynamic="Yes"), 50),
        ({"maxspeed": "36 km/h"}, element(9, sign_type="fast"), 36),
        ({"speed_limit": "walk", "maxspeed": "36"}, "", 36),
        ({"speed_limit:vehicle": "36", "speed_limit": "50"}, "", 36),
    ],
)
def test_speed_limits(tmp_path: Path, tags: dict[str, str], extra: str, kmh: float) -> None:
    """A regulatory element has priority over tags; that of a sign is the sign's subtype."""
    sign = "<way id='s'><nd ref='1' /><nd ref='2' /><tag k='subtype' v='de274-70' /></way>"
    road = road_with(
        tmp_path, tags=tags, extra=sign + extra, member=refer("relation", "9", "regulatory_element")
    )
    assert road.limited.tolist() == [False, True]
    assert road.limits_mps[1] == pytest.approx(kmh / 3.6)


def test_a_fallback_has_lower_priority(tmp_path: Path) -> None:
    extra = element(8, sign_type="80", fallback="true") + element(9, sign_type="36")
    members = [refer("relation", number, "regulatory_element") for number in "89"]
    road = road_with(tmp_path, tags={}, extra=extra, member="".join(members))
    assert road.limits_mps[1] == pytest.approx(10.0)


def test_an_element_may_refer_to_the_lanelet(tmp_path: Path) -> None:
    extra = element(9, refer("relation", "1", "refers"), sign_type="36")
    road = road_with(tmp_path, tags={}, extra=extra)
    assert (road.limited.tolist(), road.limits_mps[0]) == ([True, False], pytest.approx(10.0))
    assert road.repairs == ()


@pytest.mark.parametrize(
    ("tags", "extra", "repair"),
    [
        ({"one_way": "maybe"}, "", "1 lanelets with an unknown value of one_way are one-way: 2"),
        ({"participant:vehicle": "maybe"}, "", "1 lanelets with an unknown value of a participant"),
        ({"maxspeed": "walk"}, "", "1 lanelets with the unknown speed limit 'walk', which is not"),
        ({}, element(9, sign_type="x"), "1 regulatory elements for speed left out, since they ha"),
        ({}, element(9, sign_type="5", dynamic="1"), "1 regulatory elements for speed left out, s"),
        ({}, element(9, sign_type="50"), "1 regulatory elements for speed left out, since they b"),
        ({"participant:bicycle": "yes"}, "", "1 lanelets of subtype 'road' left out, since no par"),
        ({"subtype": "walkway", "participant:vehicle": "1"}, "", "1 lanelets of subtype 'walkway'"),
        ({"subtype": "shoulder"}, "", "1 lanelets of unlisted subtypes (shoulder) left out, since"),
    ],
)
def test_what_is_not_understood_is_reported(
    tmp_path: Path, tags: dict[str, str], extra: str, repair: str
) -> None:
    (found,) = road_with(tmp_path, tags=tags, extra=extra).repairs
    assert found.startswith(repair)


def test_no_limit_is_no_fault(tmp_path: Path) -> None:
    road = road_with(tmp_path, tags={"maxspeed": "none"})
    assert (road.limited.any(), road.repairs) == (False, ())


def test_participants_have_priority_over_subtypes(tmp_path: Path) -> None:
    for tags, lanes in (
        ({"participant:bicycle": "yes"}, 1),
        ({"subtype": "walkway", "participant:vehicle:taxi": "yes"}, 2),
    ):
        assert len(road_with(tmp_path, tags=tags).lanes) == lanes
