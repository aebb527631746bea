"""Classes of agents and their names in files."""

import pytest

from asp_env.data.classes import ALIASES, FOOTPRINTS_M, PREDICTED, AgentClass, parse_class
from asp_env.errors import DataError


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("car", AgentClass.CAR),
        ("Car", AgentClass.CAR),
        (" VAN ", AgentClass.VAN),
        ("truck_bus", AgentClass.TRUCK_BUS),
        ("trailer", AgentClass.TRAILER),
        ("Pedestrian/Bicycle", AgentClass.BICYCLE),
        ("motorbike", AgentClass.MOTORCYCLE),
        ("person", AgentClass.PEDESTRIAN),
        ("unknown", AgentClass.OTHER),
    ],
)
def test_names_in_files(name: str, kind: AgentClass) -> None:
    assert parse_class(name) is kind


def test_lower_case_class_names_are_known() -> None:
    assert all(ALIASES[kind.name.lower()] is kind for kind in AgentClass)


def test_unknown_class_lists_the_known_names() -> None:
    with pytest.raises(DataError) as caught:
        parse_class("hovercraft")
    (line,) = str(caught.value).splitlines()
    assert line.startswith("unknown class 'hovercraft': known are animal, bicycle, bike, bus, ")


def test_stored_numbers_never_change() -> None:
    assert [kind.name for kind in sorted(AgentClass)] == [
        *("CAR", "VAN", "TRUCK", "BUS", "TRUCK_BUS", "TRAILER", "MOTORCYCLE", "BICYCLE"),
        *("PEDESTRIAN", "ANIMAL", "OTHER"),
    ]
    assert sorted(AgentClass) == list(range(11))


def test_default_footprints() -> None:
    """Every class has one, at least as long as wide; a bus is longer than a car."""
    assert FOOTPRINTS_M.shape == (11, 2)
    assert (FOOTPRINTS_M > 0).all()
    assert (FOOTPRINTS_M[:, 0] >= FOOTPRINTS_M[:, 1]).all()
    assert FOOTPRINTS_M[AgentClass.BUS, 0] > FOOTPRINTS_M[AgentClass.CAR, 0]


def test_predicted_classes() -> None:
    left_out = set(AgentClass) - PREDICTED
    assert left_out == {
        *(AgentClass.BICYCLE, AgentClass.PEDESTRIAN, AgentClass.ANIMAL, AgentClass.TRAILER)
    }
