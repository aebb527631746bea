"""Views that show more or fewer past ticks than by default."""

import json
from typing import Any

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.views import MTP, VectorView, make_view, view_from_config, view_names, with_history
from asp_env.views.chauffeurnet import SNAPSHOT_TICKS, snapshot_ticks
from tests.views.scenes import COARSE, make_scene, standing, traffic


@pytest.mark.parametrize("name", view_names())
@pytest.mark.parametrize("history", [5, 10, 30])
def test_views_with_another_history_are_stored(name: str, history: int) -> None:
    """By their configuration; `mtp` shows at most 10 ticks."""
    view = with_history(make_view(name), history)
    assert view.name == name
    assert view.history == (min(history, 10) if name == "mtp" else history)
    assert view_from_config(json.loads(json.dumps(view.config()))) == view


@pytest.mark.parametrize("name", view_names())
def test_configurations_without_a_history_have_the_default(name: str) -> None:
    view = make_view(name)
    older = {key: value for key, value in view.config().items() if key != "history"}
    assert view_from_config(older) == view
    with pytest.raises(AspEnvError, match=r"0 past ticks|history is 0"):
        with_history(view, 0)


def test_snapshots_are_at_equal_intervals() -> None:
    """Nine ticks, rounded; those of 15 ticks are the default's."""
    assert snapshot_ticks(15) == SNAPSHOT_TICKS
    assert snapshot_ticks(30) == (0, 4, 8, 11, 15, 19, 22, 26, 30)
    assert snapshot_ticks(5) == (0, 1, 1, 2, 2, 3, 4, 4, 5)


@pytest.mark.parametrize("state", range(16))
def test_agents_are_drawn_at_the_ticks_of_a_short_history(state: int) -> None:
    """Of 5 past ticks, state 10 of 16 is the oldest; it has channel 0, state 11 has 1 and 2."""
    valid = np.zeros((1, 2, 16), dtype=bool)
    valid[0, 0, -1] = valid[0, 1, state] = True
    scene = make_scene(standing([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)]), valid=valid)
    raster: Any = with_history(COARSE, 5).render(scene)
    drawn = np.flatnonzero(raster[0, 3:].any(axis=(1, 2))).tolist()
    channels = {10: [0], 11: [1, 2], 12: [3, 4], 13: [5], 14: [6, 7], 15: [8]}
    assert drawn == channels.get(state, [])


def test_vectors_of_a_short_history_are_the_last_ticks() -> None:
    """The last 8 of 16 states, and the same lines."""
    scene = make_scene(traffic(0), targets=[(0, 0), (0, 1)])
    whole, short = (VectorView(history=history).render(scene) for history in (15, 7))
    np.testing.assert_array_equal(short.agents, whole.agents[:, :, -8:])
    np.testing.assert_array_equal(short.agents_valid, whole.agents_valid[:, :, -8:])
    np.testing.assert_array_equal(short.lines, whole.lines)


def test_short_fade_omits_the_oldest_boxes() -> None:
    """Four past ticks: the raster of a scene in which earlier states were not observed."""
    states = traffic(0)
    valid = np.ones(states.shape[:3], dtype=bool)
    valid[:, :, :-5] = False
    view: Any = MTP.make((90, 90))
    expected = view.render(make_scene(states, valid=valid))
    short: Any = with_history(view, 4).render(make_scene(states))
    np.testing.assert_array_equal(short, expected)
