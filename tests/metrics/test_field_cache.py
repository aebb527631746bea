"""The cache of distance fields."""

import dataclasses

import pytest

from asp_env.metrics import drivable
from tests.builders import make_recording

PLACES_OF_A_SUITE = 72


def test_the_places_of_a_suite_have_their_fields_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    road_map = make_recording().road_map
    maps = [dataclasses.replace(road_map, name=str(i)) for i in range(PLACES_OF_A_SUITE)]
    field, made = drivable.drivable_field(road_map), []
    monkeypatch.setattr(drivable._fields, "_make", lambda each: made.append(each) or field)
    for _ in range(2):
        for each in maps:
            drivable.drivable_field(each)
    assert len(made) == PLACES_OF_A_SUITE
