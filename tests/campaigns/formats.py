"""The formats of a campaign: how a tiny valid input is made, and what a full use of it is.

A use raises `AspEnvError` for an input that is refused, and `NotFinite` or any other exception for
a fault.
"""

import contextlib
import functools
import json
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from asp_env import ReplayEnv
from asp_env.console import page_console
from asp_env.data.predictor import load_predictor
from asp_env.data.recording import Recording
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.scenarios.selection import load_scenarios, save_scenarios
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data, open_readable
from asp_env.evaluation.closed_loop.episodes import EpisodeSettings, drive_episodes
from asp_env.evaluation.inspect import Inspect
from asp_env.metrics.driving.rules import RULES
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.planning.planner import load_planner
from asp_env.render.film import Film
from tests.builders import DRIVES, make_map, make_recording
from tests.data import interaction_files, levelx_files

DT_S = 0.2
HISTORY = 15
RATE_HZ = 5.0
FRAMES = 50
OBSERVATIONS = ("vectors", "actions", "state", "route", "nearest")


class NotFinite(Exception):
    """An input was accepted, and a number that follows from it is not finite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A kind of input."""

    name: str
    make: Callable[[Path], object]
    """Writes a valid input into an empty folder."""
    use: Callable[[Path], object]
    """Uses the input in a folder in full."""
    suffixes: tuple[str, ...]
    """Suffixes of the files that are changed."""
    renames: bool = False
    """Whether files may also be renamed, removed or replaced by links and folders."""


def check_finite(what: str, *arrays: Any) -> None:
    """Checks that all numbers are finite.

    Raises:
        NotFinite: one is not.
    """
    for array in arrays:
        if not np.isfinite(np.asarray(array, dtype=np.float64)).all():
            raise NotFinite(what)


def use_recordings(folder: Path) -> None:
    """Opens, drives, scores and inspects all recordings of a folder."""
    recordings = open_readable(folder)
    for recording in recordings:
        check_finite("states", recording.states)
        check_finite("sizes", recording.sizes)
        road_map = recording.road_map
        check_finite("map", road_map.lines.points, road_map.lanes.points, road_map.drivable.points)
    scenarios = list(find_scenarios(recordings, source=str(folder), dt_s=DT_S, history=HISTORY))
    if scenarios:
        _drive(recordings, scenarios[-1:])
        _step(folder)
    _inspect(folder)


def _inspect(folder: Path) -> None:
    """What `inspect` shows, without the drawing of its tables, which hold no text of files."""
    inspect, console = Inspect(data=str(folder)), page_console(160)
    recordings = open_data(folder)
    summaries, faults = inspect.examine(recordings, console)
    for each in summaries:
        check_finite("drift", *each.drifts.metres.values(), *each.drifts.euler_metres.values())
    inspect.show_notes(recordings.repairs, summaries, faults, console)


def _drive(recordings: Recordings, scenarios: list[Any]) -> None:
    rules = RULES["nuplan"]
    settings = EpisodeSettings(rules=rules, traffic="idm", horizon=15, history=HISTORY, dt_s=DT_S)
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=DT_S)
    driven = drive_episodes(recordings, scenarios, load_planner("expert"), predictor, settings)
    for name, metric in driving_metrics(driven.drives, rules).items():
        check_finite(f"metric {name}", metric.value[metric.valid])


def _step(folder: Path) -> None:
    env = ReplayEnv(data=str(folder), observations=OBSERVATIONS, traffic="idm")
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        for name, value in observation.items():
            check_finite(f"observation {name}", value)
        observation, reward, terminated, truncated, info = env.step(np.array([0.1, 0.01]))
        check_finite("reward", reward, *info.get("reward_terms", {}).values())
        if terminated or truncated:
            break
    env.close()


def make_levelx(folder: Path) -> None:
    """Two cars and a pedestrian for 10 s on a straight road."""
    levelx_files.write_recording(folder, rate_hz=RATE_HZ, num_frames=FRAMES)
    levelx_files.write_map(folder)


def make_image(folder: Path) -> None:
    """The same with a background image."""
    make_levelx(folder)
    image = np.full((300, 1200, 3), 90, dtype=np.uint8)
    cv2.imwrite(str(folder / "data" / "00_background.png"), image)


def use_image(folder: Path) -> None:
    """Draws the first scenario over its image."""
    env = ReplayEnv(data=str(folder), observations=("state",), render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    env.close()


def _rows(track: int, start: tuple[float, ...], first: int = 0) -> pd.DataFrame:
    states = interaction_files.drive(start, [(8, 0.1, 0)], 10.0)
    return interaction_files.rows(track, states, first_frame=first)


def _vehicles() -> pd.DataFrame:
    return pd.concat(
        [
            _rows(1, (5, -21.75, 0, 8)),
            _rows(2, (110, -18.25, np.pi, 9)),
            _rows(7, (20, -21.75, 0, 0), 5),
        ]
    )


def make_interaction(folder: Path) -> None:
    """Three cars and a pedestrian."""
    interaction_files.write_recording(
        folder,
        vehicles=_vehicles(),
        pedestrians=interaction_files.walk("P1", (30, -10), (0.5, 0.0), 20),
    )
    interaction_files.write_map(folder)


def make_cases(folder: Path) -> None:
    """Two cases of three cars."""
    tables = [_vehicles().assign(case_id=float(case)) for case in (1, 2)]
    (folder / "train").mkdir()
    table = pd.concat(tables).round(3)
    table.to_csv(folder / "train" / f"{interaction_files.PLACE}_train.csv", index=False)
    interaction_files.write_map(folder)


def make_geo_trax(folder: Path) -> None:
    """Three vehicles at 29.97 Hz for 3 s, and one at a third of it for 9 s."""
    rows = []
    for track, speed, count in ((1, 8.0, 90), (2, 9.0, 90), (3, 6.0, 270)):
        time = np.arange(count) / 29.97
        stamps = pd.to_datetime(1_665_165_133 + time, unit="s").round("ms")
        table = {
            "Vehicle_ID": track,
            "Timestamp": stamps.strftime("%Y-%m-%d %H:%M:%S.%f").str[:-3],
            "Frame_Number": np.arange(count),
            "Ortho_X": 0.0,
            "Local_X": (200_000 + speed * time).round(3),
            "Local_Y": 550_000.0 + 4 * track,
            "Vehicle_Class": track % 3,
            "Vehicle_Length": 4.5,
            "Vehicle_Width": 1.8,
        }
        rows.append(pd.DataFrame(table))
    pd.concat(rows).to_csv(folder / "2022-10-07_A_PM1.csv", index=False)


def make_sind(folder: Path) -> None:
    """Three vehicles, a pedestrian, two lights with a stop line, and a map."""
    place = folder / "Xi'an" / "8_2_1"
    place.mkdir(parents=True)
    table = _vehicles().rename(columns={"psi_rad": "yaw_rad"}).round(3)
    table.to_csv(place / "Veh_smoothed_tracks.csv", index=False)
    walk = interaction_files.walk("1", (30, -10), (0.5, 0.0), 20).assign(agent_type="pedestrian")
    walk.to_csv(place / "Ped_smoothed_tracks.csv", index=False)
    lights = {"RawFrameID": [0, 30], "timestamp(ms)": [0, 3000], "Traffic light 1": [0, 1]}
    pd.DataFrame({**lights, "Traffic light 2": [1, 3]}).to_csv(
        place / "Traffic_Lights.csv", index=False
    )
    (place / "stop_lines.csv").write_text("signal,x1,y1,x2,y2\n1,50,-23.5,50,-20\n")
    text = levelx_files.two_lane_road(interaction_files.attributes_in_degrees())
    (place.parent / "map.osm").write_text(text)


@functools.cache
def _recording() -> Recording:
    return make_recording(duration_s=10.0, drives=DRIVES[:4], frame_rate_hz=RATE_HZ)


@functools.cache
def _scene() -> Scene:
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=DT_S, horizon_s=3.0)
    return gather_scene(recordings, index.select(np.arange(0, len(index), 40)))


def make_checkpoint(folder: Path) -> None:
    """A tiny network of vectors with statistics of its features."""
    from tests.predictors.tiny import save_distance, save_random

    shutil.rmtree(folder)
    save_random(folder, "ffw-asp", "vectors")
    save_distance(folder)


def make_old_checkpoint(folder: Path) -> None:
    """The same without a hash of its weights, as in runs of earlier versions."""
    make_checkpoint(folder)
    path = folder / "config.json"
    config = json.loads(path.read_text())
    del config["weights_sha256"]
    path.write_text(json.dumps(config))


def use_checkpoint(folder: Path) -> None:
    """Loads the run with its guard and forecasts a scene."""
    import torch

    torch.set_num_threads(1)
    predictor = load_predictor(f"guarded:ffw-asp:{folder}", horizon=15, dt_s=DT_S)
    forecast = predictor.predict(_scene())
    check_finite("forecast", forecast.states, forecast.log_probs)


def make_policy(folder: Path) -> None:
    """A policy with random weights."""
    import torch

    from policies.environments import make_environments
    from policies.runs import (
        POLICY,
        action_space,
        algorithm_classes,
        policy_arguments,
        save_config,
        write_tensors,
    )
    from policies.settings import EnvironmentSettings, PolicySettings

    settings = PolicySettings(environment=EnvironmentSettings(neighbours=2), width=8)
    envs = make_environments(settings.environment, "sample:intersection", 1, scenarios="")
    space = envs.observation_space
    torch.manual_seed(0)
    policy = algorithm_classes("ppo").policy(
        observation_space=space,
        action_space=action_space(),
        lr_schedule=lambda _: 0.0,
        **policy_arguments(settings),
    )
    save_config(folder, settings, space, None, 0)  # pyright: ignore[reportArgumentType]
    write_tensors(folder / POLICY, policy.state_dict())


def use_policy(folder: Path) -> None:
    """Loads the policy as a planner and acts."""
    import torch

    torch.set_num_threads(1)
    from policies.runs import check_predictor

    planner: Any = load_planner(f"sb3:{folder}")
    trained = planner._trained
    shown = {name: np.zeros((2, *box.shape), box.dtype) for name, box in trained.space.items()}
    check_finite("actions", trained.act(shown))
    check_predictor(folder, None)


@functools.cache
def _driven() -> Recordings:
    """Recordings on disk that stay unchanged."""
    import atexit
    import tempfile

    folder = Path(tempfile.mkdtemp(prefix="campaign-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    make_levelx(folder)
    return open_data(folder)


def make_scenarios_file(folder: Path) -> None:
    """All scenarios of a recording."""
    recordings = _driven()
    found = find_scenarios(recordings, source=recordings.source, dt_s=DT_S, history=HISTORY)
    save_scenarios(folder / "scenarios.json", found, recordings)


def use_scenarios_file(folder: Path) -> None:
    """Reads the list and drives the first two of them."""
    recordings = _driven()
    found = load_scenarios(folder / "scenarios.json", recordings, dt_s=DT_S, history=HISTORY)
    if len(found):
        _drive(recordings, list(found)[:2])


def make_rollout(folder: Path) -> None:
    """An episode of 2 s."""
    from tests.data.test_rollout import make_rollout as rollout

    rollout().save(folder / "0.npz")


def use_rollout(folder: Path) -> None:
    """Reads the episode and draws its begin and its end."""
    rollout = Rollout.load(folder / "0.npz")
    film = Film(rollout=rollout, road_map=make_map(), background=None, title=rollout.scenario.name)
    assert len(film.times_s(10.0)) < 100_000
    for time_s in (0.0, film.duration_s):
        film.frame(time_s, size_px=(64, 48), extent_m=60.0)
    film.frame(0.0, size_px=(64, 48), extent_m=None)


def make_hidden(folder: Path) -> None:
    """highway-env's traffic of 20 s."""
    from scenarios.highway.dataset import synthesize

    folder.rmdir()
    synthesize(folder, site="intersection", recordings=1, minutes=1 / 3, seed=1)


def use_hidden(folder: Path) -> None:
    """Continues two episodes for some ticks."""
    from scenarios.highway.world import HighwayWorld

    source = f"highway:{folder}"
    recordings = open_data(source)
    world = HighwayWorld(recordings, num_episodes=1, dt_s=DT_S, history=5)
    scenarios = find_scenarios(recordings, source=source, dt_s=DT_S, history=5)
    world.reset([scenarios[0]], [np.random.default_rng(0)])
    actions = np.zeros((*world.episodes.ids.shape, 2), dtype=np.float32)
    controlled = np.zeros(world.episodes.ids.shape, dtype=bool)
    controlled[:, 0] = True
    for _ in range(5):
        world.step(actions, controlled)
    check_finite("states", world.episodes.states[world.episodes.valid])


def make_report(folder: Path) -> None:
    """A table of metrics and a manifest."""
    from asp_env.evaluation.results import Row, write_metrics

    rows = [
        Row(data="d", predictor="constant-velocity", horizon_s=3.0, metric=metric, value=1.5, n=9)
        for metric in ("FDE", "L2@1s")
    ]
    rows += [
        Row(data="d", predictor=name, planner="idm", traffic="log", metric=metric, value=0.5, n=9)
        for name in ("oracle", "constant-velocity")
        for metric in ("score", "TTC", "score less constant-velocity")
    ]
    write_metrics(folder, rows)
    manifest = {
        "command": "drive",
        "data": "d",
        "privileged": ["oracle"],
        "versions": {"numpy": "2"},
    }
    (folder / "manifest.json").write_text(json.dumps({**manifest, "seed": 0, "recordings": ["00"]}))


def use_report(folder: Path) -> None:
    """Writes the page."""
    from asp_env.evaluation.report import write_report

    write_report(folder, title="a run").unlink()


def make_suite(folder: Path) -> None:
    """The statement of how the traffic of a suite was made."""
    made = {"data_hash": "0" * 64, "versions": {"numpy": "2.0.0", "asp-env": "0.1.0"}}
    (folder / "suite.json").write_text(json.dumps(made))


def use_suite(folder: Path) -> None:
    """Opens a suite whose traffic differs from the frozen one, which is a warning."""
    from scenarios.suites.suite import HASH_DIGITS, SUITES, frozen_facts, open_source

    frozen = str(frozen_facts(SUITES["intersection-v1"])["data_hash"])
    place = folder.parent / "cache" / "suites" / f"intersection-v1-{frozen[:HASH_DIGITS]}"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(folder, place)
    with _cache_in(folder.parent / "cache"), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        open_source("intersection-v1")


@contextlib.contextmanager
def _cache_in(folder: Path) -> Any:
    before = os.environ.get("ASP_ENV_CACHE")
    os.environ["ASP_ENV_CACHE"] = str(folder)
    try:
        yield
    finally:
        os.environ.pop("ASP_ENV_CACHE")
        if before is not None:
            os.environ["ASP_ENV_CACHE"] = before


def make_cache(folder: Path) -> None:
    """Everything that is cached of a recording."""
    with _cache_in(folder):
        _expected(open_data(_driven().source)[0])


def use_cache(folder: Path) -> None:
    """Opens the recording: whatever the cache holds, it is as the files say."""
    with _cache_in(folder):
        found = _expected(open_data(_driven().source)[0])
    for name, array in _expected(_driven()[0]).items():
        if not np.array_equal(found[name], array):
            raise NotFinite(f"{name} from the cache")


def _expected(recording: Recording) -> Mapping[str, np.ndarray]:
    names = ("states", "sizes", "classes", "track_ids", "starts", "first_frames")
    lines = recording.road_map.lines.points
    return {"lines": lines, **{name: getattr(recording, name) for name in names}}


FORMATS: Mapping[str, Format] = {
    each.name: each
    for each in (
        Format(
            name="levelx", make=make_levelx, use=use_recordings, suffixes=(".csv",), renames=True
        ),
        Format(name="lanelet2", make=make_levelx, use=use_recordings, suffixes=(".osm",)),
        Format(
            name="interaction",
            make=make_interaction,
            use=use_recordings,
            suffixes=(".csv", ".osm"),
            renames=True,
        ),
        Format(
            name="interaction-cases",
            make=make_cases,
            use=use_recordings,
            suffixes=(".csv",),
            renames=True,
        ),
        Format(
            name="geo-trax",
            make=make_geo_trax,
            use=use_recordings,
            suffixes=(".csv",),
            renames=True,
        ),
        Format(
            name="sind", make=make_sind, use=use_recordings, suffixes=(".csv", ".osm"), renames=True
        ),
        Format(name="image", make=make_image, use=use_image, suffixes=(".png",)),
        Format(
            name="checkpoint",
            make=make_checkpoint,
            use=use_checkpoint,
            suffixes=(".json", ".safetensors"),
        ),
        Format(
            name="old-checkpoint",
            make=make_old_checkpoint,
            use=use_checkpoint,
            suffixes=(".json", ".safetensors"),
        ),
        Format(name="policy", make=make_policy, use=use_policy, suffixes=(".json", ".safetensors")),
        Format(
            name="scenarios", make=make_scenarios_file, use=use_scenarios_file, suffixes=(".json",)
        ),
        Format(name="rollout", make=make_rollout, use=use_rollout, suffixes=(".npz",)),
        Format(name="hidden", make=make_hidden, use=use_hidden, suffixes=(".npz",)),
        Format(name="report", make=make_report, use=use_report, suffixes=(".json", ".csv")),
        Format(name="suite", make=make_suite, use=use_suite, suffixes=(".json",)),
        Format(name="cache", make=make_cache, use=use_cache, suffixes=(".bin",)),
    )
}
