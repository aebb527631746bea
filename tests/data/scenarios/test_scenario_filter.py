"""The filter language, and selection from the table of scenarios."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.scenarios.scenario import ScenarioFilter, ScenarioSet, find_scenarios
from asp_env.data.scenarios.tags import COLUMNS, TAGS
from asp_env.errors import AspEnvError
from tests.builders import make_recording

FOUND: ScenarioSet = find_scenarios(
    [make_recording(name=f"0{i}", location=str(i // 2), seed=i, duration_s=40) for i in range(3)],
    source="made up",
    dt_s=0.2,
    history=15,
)

TAG = st.sampled_from(TAGS)
NUMBER = st.floats(-1e3, 1e3).map(lambda value: float(f"{value:g}"))
COMPARISON = st.builds(
    lambda name, operator, value: f"{name}{operator}{value:g}",
    st.sampled_from([*COLUMNS]),
    st.sampled_from([">=", "<=", ">", "<", "=", "!="]),
    NUMBER,
)
CONDITION = st.one_of(TAG, TAG.map("!{}".format), COMPARISON)
TEXT = st.lists(st.lists(CONDITION, min_size=1, max_size=3).map("|".join), max_size=3).map(",".join)


def matches(text: str) -> np.ndarray:
    """Mask of the scenarios that match a filter."""
    return ScenarioFilter.parse(text).matches(FOUND)


@given(text=TEXT)
def test_filters_round_trip(text: str) -> None:
    parsed = ScenarioFilter.parse(text)
    assert str(parsed) == text
    assert ScenarioFilter.parse(str(parsed)) == parsed


@given(one=TEXT, other=TEXT)
def test_comma_is_a_conjunction(one: str, other: str) -> None:
    """The empty filter matches everything."""
    both = ",".join(text for text in (one, other) if text)
    np.testing.assert_array_equal(matches(both), matches(one) & matches(other))


@given(one=CONDITION, other=CONDITION)
def test_bar_is_a_disjunction(one: str, other: str) -> None:
    np.testing.assert_array_equal(matches(f"{one}|{other}"), matches(one) | matches(other))


@given(tag=TAG, name=st.sampled_from([*COLUMNS]), value=NUMBER)
def test_opposite_conditions_match_the_complement(tag: str, name: str, value: float) -> None:
    for one, other in ((">=", "<"), (">", "<="), ("=", "!=")):
        np.testing.assert_array_equal(
            matches(f"{name}{one}{value:g}"), ~matches(f"{name}{other}{value:g}")
        )
    np.testing.assert_array_equal(matches(tag), ~matches(f"!{tag}"))


def test_filtered_scenarios() -> None:
    """By tag, by column with and without its unit, by recording and location, with spaces."""
    left = FOUND.filtered("left")
    assert 0 < len(left) < len(FOUND)
    assert all("left" in each.tags for each in left)
    assert [*left] == [each for each in FOUND if "left" in each.tags] == [*FOUND.tagged("left")]
    assert [*FOUND.filtered("length>=15")] == [each for each in FOUND if each.length == 75]
    assert [*FOUND.filtered(" length_s >= 15 ")] == [*FOUND.filtered("length>=15")]
    assert {each.recording_name for each in FOUND.filtered("recording=01")} == {"01"}
    assert {each.recording_name for each in FOUND.filtered("location!=1")} == {"00", "01"}
    assert [*FOUND.filtered("")] == [*FOUND]
    assert [*FOUND.filtered(ScenarioFilter.parse("!left"))] == [*FOUND.filtered("!left")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lft", r"unknown scenario tag 'lft' \(did you mean 'left'\?\): known are crossing-vru, "),
        ("!lft", "unknown scenario tag 'lft'"),
        ("lenght>3", r"column 'lenght' \(did you mean 'length_s'\?\): known are agents, density, "),
        ("left>3", "unknown scenario column 'left'"),
        ("left,", "a condition is empty"),
        ("", None),
        (",", "a condition is empty"),
        ("left|", "a condition is empty"),
        ("!", "a condition is empty"),
        ("length>=x", "length_s>=x: expected a number"),
        ("length>nan", "length_s>nan: expected a number"),
        ("length>", "length_s>: expected a number"),
        ("3<length<5", "'3<length<5' is not understood"),
        ("length=>3", "'length=>3' is not understood"),
        ("recording>3", "expected recording=NAME or recording!=NAME"),
        ("recording=", "expected recording=NAME"),
    ],
)
def test_errors_of_the_parser(text: str, message: str | None) -> None:
    """One line; the empty text is no error."""
    if message is None:
        assert ScenarioFilter.parse(text).clauses == ()
        return
    with pytest.raises(AspEnvError, match=message) as caught:
        ScenarioFilter.parse(text)
    assert "\n" not in str(caught.value)


def test_no_scenario_matches() -> None:
    """The message has the number of scenarios that each condition alone matches."""
    lefts = int(FOUND.has("left").sum())
    expected = f"none of the {len(FOUND)} of 'made up' fits .* left {lefts}, density>500 0"
    with pytest.raises(AspEnvError, match=expected):
        FOUND.filtered("left,density>500")
    assert len(FOUND.tagged("roundabout")) == 0


def test_sorting() -> None:
    """In both directions; the sort is stable and keeps all scenarios."""
    for name in (*COLUMNS, "recording", "location"):
        up, down = FOUND.sorted_by(name), FOUND.sorted_by(name, descending=True)
        assert (np.sort(FOUND.column(name)) == up.column(name)).all()
        assert (up.column(name)[::-1] == down.column(name)).all()
        assert sorted(each.name for each in up) == sorted(each.name for each in FOUND)
        for table in (up, down):
            same = table.column(name)[1:] == table.column(name)[:-1]
            assert (np.diff(table.seed)[same] > 0).all()


def test_sampling() -> None:
    """Reproducible by seed, in order, without duplicates, and at most all scenarios."""
    some = FOUND.sample(4, seed=3)
    assert [*some] == [*FOUND.sample(4, seed=3)]
    assert [*some] != [*FOUND.sample(4, seed=4)]
    assert (np.diff(some.seed) > 0).all()
    assert [*FOUND.sample(1000, seed=0)] == [*FOUND]


def test_evenly_spaced_scenarios() -> None:
    """From the first to the last, at most all."""
    assert FOUND.evenly_spaced(3).seed.tolist() == [0, round((len(FOUND) - 1) / 2), len(FOUND) - 1]
    assert [*FOUND.evenly_spaced(1000)] == [*FOUND]


@pytest.mark.parametrize("count", [0, -1])
def test_count_must_be_positive(count: int) -> None:
    for pick in (lambda: FOUND.evenly_spaced(count), lambda: FOUND.sample(count, seed=0)):
        with pytest.raises(AspEnvError, match=f"{count} scenarios: expected at least 1"):
            pick()


def test_by_name() -> None:
    """An unknown name is rejected with similar names."""
    for each in FOUND:
        assert FOUND.by_name(each.name) == each
    with pytest.raises(AspEnvError, match=rf"unknown scenario '00-99-1': {len(FOUND)} are known"):
        FOUND.by_name("00-99-1")
    with pytest.raises(AspEnvError, match="such as none"):
        FOUND.tagged("roundabout").by_name("00-1-15")


def test_unknown_tags_and_columns() -> None:
    for method in (FOUND.has, FOUND.tagged, FOUND.column, FOUND.sorted_by):
        with pytest.raises(AspEnvError, match=r"unknown scenario (tag|column) 'speeed'"):
            method("speeed")
