"""Scenarios asked for in words, and the table that they are picked from."""

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
WORDS = st.lists(st.lists(CONDITION, min_size=1, max_size=3).map("|".join), max_size=3).map(
    ",".join
)


def fits(words: str) -> np.ndarray:
    """Which of the scenarios fit."""
    return ScenarioFilter.parse(words).holds(FOUND)


@given(words=WORDS)
def test_words_and_back(words: str) -> None:
    """What is written is what was read."""
    read = ScenarioFilter.parse(words)
    assert str(read) == words
    assert ScenarioFilter.parse(str(read)) == read


@given(one=WORDS, other=WORDS)
def test_comma_means_both(one: str, other: str) -> None:
    """Rows that fit both; no words ask for nothing."""
    both = ",".join(words for words in (one, other) if words)
    np.testing.assert_array_equal(fits(both), fits(one) & fits(other))


@given(one=CONDITION, other=CONDITION)
def test_bar_means_either(one: str, other: str) -> None:
    """Rows that fit one or the other."""
    np.testing.assert_array_equal(fits(f"{one}|{other}"), fits(one) | fits(other))


@given(tag=TAG, name=st.sampled_from([*COLUMNS]), value=NUMBER)
def test_opposites(tag: str, name: str, value: float) -> None:
    """Every row has a tag or not, and a column is at least a value or less."""
    np.testing.assert_array_equal(fits(tag), ~fits(f"!{tag}"))
    np.testing.assert_array_equal(fits(f"{name}>={value:g}"), ~fits(f"{name}<{value:g}"))
    np.testing.assert_array_equal(fits(f"{name}>{value:g}"), ~fits(f"{name}<={value:g}"))
    np.testing.assert_array_equal(fits(f"{name}={value:g}"), ~fits(f"{name}!={value:g}"))


def test_picks() -> None:
    """By tag, by column with and without its unit, by recording and location; blanks are free."""
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
    ("words", "message"),
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
def test_what_is_not_understood(words: str, message: str | None) -> None:
    """One line that says what was given and what was expected."""
    if message is None:
        assert ScenarioFilter.parse(words).clauses == ()
        return
    with pytest.raises(AspEnvError, match=message) as told:
        ScenarioFilter.parse(words)
    assert "\n" not in str(told.value)


def test_nothing_fits() -> None:
    """One line with what each condition would leave by itself."""
    lefts = int(FOUND.has("left").sum())
    expected = f"none of the {len(FOUND)} of 'made up' fits .* left {lefts}, density>500 0"
    with pytest.raises(AspEnvError, match=expected):
        FOUND.filtered("left,density>500")
    assert len(FOUND.tagged("roundabout")) == 0


def test_sorting() -> None:
    """By a column, up and down; equals keep their order both ways; nothing is lost."""
    for name in (*COLUMNS, "recording", "location"):
        up, down = FOUND.sorted_by(name), FOUND.sorted_by(name, descending=True)
        assert (np.sort(FOUND.column(name)) == up.column(name)).all()
        assert (up.column(name)[::-1] == down.column(name)).all()
        assert sorted(each.name for each in up) == sorted(each.name for each in FOUND)
        for table in (up, down):
            same = table.column(name)[1:] == table.column(name)[:-1]
            assert (np.diff(table.seed)[same] > 0).all()


def test_sampling() -> None:
    """The same seed draws the same, in order and without doubles; at most all."""
    some = FOUND.sample(4, seed=3)
    assert [*some] == [*FOUND.sample(4, seed=3)]
    assert [*some] != [*FOUND.sample(4, seed=4)]
    assert (np.diff(some.seed) > 0).all()
    assert [*FOUND.sample(1000, seed=0)] == [*FOUND]


def test_spreading() -> None:
    """From the first to the last, evenly; at most all."""
    assert FOUND.evenly_spaced(3).seed.tolist() == [0, round((len(FOUND) - 1) / 2), len(FOUND) - 1]
    assert [*FOUND.evenly_spaced(1000)] == [*FOUND]


@pytest.mark.parametrize("count", [0, -1])
def test_too_few(count: int) -> None:
    """Nothing cannot be drawn."""
    for pick in (lambda: FOUND.evenly_spaced(count), lambda: FOUND.sample(count, seed=0)):
        with pytest.raises(AspEnvError, match=f"{count} scenarios: expected at least 1"):
            pick()


def test_by_name() -> None:
    """Every scenario is found under its name; others' names are refused with what is near."""
    for each in FOUND:
        assert FOUND.by_name(each.name) == each
    with pytest.raises(AspEnvError, match=rf"unknown scenario '00-99-1': {len(FOUND)} are known"):
        FOUND.by_name("00-99-1")
    with pytest.raises(AspEnvError, match="such as none"):
        FOUND.tagged("roundabout").by_name("00-1-15")


def test_unknown_names() -> None:
    """Of tags and columns, asked of the table."""
    for ask in (FOUND.has, FOUND.tagged, FOUND.column, FOUND.sorted_by):
        with pytest.raises(AspEnvError, match=r"unknown scenario (tag|column) 'speeed'"):
            ask("speeed")
