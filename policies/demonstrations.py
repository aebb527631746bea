"""`asp-env rl demonstrations`: the driving of the logged drivers as a data set."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
import tyro
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from rich.progress import track

from asp_env.arguments import MAX_SEED, check_max_scenarios
from asp_env.console import text_console
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.source import open_data, scheme_of
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv
from asp_env.errors import AspEnvError
from asp_env.files import atomic_folder, is_vacant
from asp_env.sim.world import Ending, world_class
from policies.dataset import ID_PATTERN, RecordedEpisode, import_h5py, write_dataset

BATCH = 32
"""Number of episodes that are recorded side by side; the episodes do not depend on it."""

ENV_ID = "asp_env/Replay-v0"
_INFOS = ("tick", "progress", "collision", "at_fault", "off_road_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class Demonstrations:
    """Write the logged drivers' episodes as a data set."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:… or synthetic:…."""
    out: Path
    """Folder to write; it must not exist, or be empty. Its name
    is the id of the data set and ends with a version: left-v0."""
    observations: tuple[str, ...] = ("vectors", "state", "route")
    """Components of the observation."""
    flat: tyro.conf.FlagCreatePairsOff[bool] = False
    """Make one vector of each observation, as d3rlpy reads it."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER|FILE")] = ""
    """Tags and comparisons, such as 'left,!stopping,length>=8',
    or the scenarios.json of a run. The default is all."""
    max_scenarios: int | None = None
    """Largest number of scenarios; they are chosen at even spacing."""
    traffic: str | None = None
    """Driver of all other agents; the default is log."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds."""
    seed: int = 0
    """Seed of the first scenario's episode, which the others count up from."""

    def run(self) -> None:
        """Records all episodes and writes the folder.

        Raises:
            AspEnvError: an option or the data are invalid, or h5py is not installed.
        """
        self._check()
        env = self._make_env()
        replay = env.unwrapped
        assert isinstance(replay, ReplayEnv)
        count = len(replay.scenarios)
        kept = count if self.max_scenarios is None else min(self.max_scenarios, count)
        numbers = np.linspace(0, count - 1, kept).round().astype(int).tolist()
        endings = dict.fromkeys((kind.name for kind in Ending), 0)
        clipped = steps = 0

        def counted() -> Iterator[RecordedEpisode]:
            nonlocal clipped, steps
            recorded = self._record(numbers)
            for each in track(recorded, "driving", total=len(numbers), transient=True):
                endings[each.attributes["ending"]] += 1
                clipped += int(each.infos["clipped"].sum())
                steps += len(each.actions)
                yield each

        assert env.spec is not None
        with atomic_folder(self.out) as folder:
            write_dataset(
                folder,
                counted(),
                dataset_id=self.out.name,
                env_spec=env.spec,
                observation_space=env.observation_space,
                action_space=env.action_space,
                description=f"The logged drivers of {self.data}, scenario by scenario.",
            )
        found = ", ".join(f"{count} {name}" for name, count in endings.items() if count)
        text_console().print(
            f"wrote {self.out}: {len(numbers)} episodes ({found}), {steps} steps, {clipped} of "
            "them with clipped actions",
            soft_wrap=True,
        )

    def _check(self) -> None:
        import_h5py("asp-env rl demonstrations")
        if not ID_PATTERN.fullmatch(self.out.name):
            raise AspEnvError(
                f"--out {self.out}: the name is the id of the data set, expected letters, digits "
                f"and a version at the end, such as {self.out.name or 'demonstrations'}-v0"
            )
        if not is_vacant(self.out):
            raise AspEnvError(f"--out {self.out}: exists already; choose another or remove it")
        check_max_scenarios(self.max_scenarios)
        if not 0 <= self.seed <= MAX_SEED:
            raise AspEnvError(f"--seed {self.seed}: expected 0 to {MAX_SEED}")
        if world_class(self.data).traffic != "log":
            raise AspEnvError(
                f"{self.data}: its traffic reacts and has no logged drivers; use recordings"
            )
        open_data(self.data)

    def _options(self) -> dict[str, Any]:
        is_folder = scheme_of(self.data) is None
        return {
            "data": str(Path(self.data).absolute()) if is_folder else self.data,
            "observations": self.observations,
            "traffic": self.traffic,
            "dt_s": self.dt,
            "scenarios": self.scenarios,
        }

    def _make_env(self) -> gymnasium.Env[Any, Any]:
        env = gymnasium.make(ENV_ID, **self._options())
        return FlattenObservation(env) if self.flat else env

    def _record(self, numbers: list[int]) -> Iterator[RecordedEpisode]:
        """Records the episodes of some scenarios, in their order."""
        num_envs = min(BATCH, len(numbers))
        envs = ReplayVectorEnv(num_envs, autoreset_mode="Disabled", **self._options())
        for episode in record_episodes(envs, numbers, self.seed):
            if self.flat:
                assert isinstance(episode["observations"], dict)
                space = envs.single_observation_space
                episode["observations"] = _flatten(space, episode["observations"])
            yield RecordedEpisode(**episode)


def record_episodes(
    envs: ReplayVectorEnv, numbers: list[int], seed: int
) -> Iterator[dict[str, Any]]:
    """Records the logged drivers of some scenarios.

    Args:
        envs: an environment with autoreset mode `Disabled`.
        numbers: numbers of the scenarios.
        seed: seed of the first scenario's episode; that of scenario i is seed + i.

    Yields:
        The fields of `RecordedEpisode` in the order of the scenarios.

    Raises:
        AspEnvError: the world has no logged drivers.
    """
    finished: dict[int, dict[str, Any]] = {}
    waiting = iter(numbers)
    running: list[_Recorder | None] = [None] * envs.num_envs
    restart, at = np.ones(envs.num_envs, dtype=bool), 0
    while at < len(numbers):
        if restart.any():
            for b in np.flatnonzero(restart).tolist():
                number = next(waiting, None)
                running[b] = None if number is None else _Recorder(number, seed + number)
            # A row without a scenario left repeats the last one, unrecorded.
            chosen = [numbers[-1] if each is None else each.number for each in running]
            options = {"scenario": chosen, "reset_mask": restart}
            observations, infos = envs.reset(seed=[seed + i for i in chosen], options=options)
            for b, recorder in enumerate(running):
                if recorder is not None and restart[b]:
                    recorder.see(observations, infos, b)
        actions, clipped = envs.logged_actions(), envs.logged_actions_clipped()
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        restart = terminated | truncated
        for b, recorder in enumerate(running):
            if recorder is None:
                continue
            recorder.act(
                action=actions[b],
                clipped=bool(clipped[b]),
                reward=float(rewards[b]),
                terminated=bool(terminated[b]),
                truncated=bool(truncated[b]),
            )
            recorder.see(observations, infos, b)
            if restart[b]:
                finished[recorder.number] = recorder.episode(envs, infos["ending"][b])
        while at < len(numbers) and numbers[at] in finished:
            yield finished.pop(numbers[at])
            at += 1


class _Recorder:
    """Collects one episode tick by tick."""

    def __init__(self, number: int, seed: int) -> None:
        self.number = number
        self._seed = seed
        self._observations: list[dict[str, np.ndarray]] = []
        self._infos: list[dict[str, Any]] = []
        self._steps: list[dict[str, Any]] = []

    def see(self, observations: Any, infos: dict[str, Any], row: int) -> None:
        self._observations.append({name: each[row].copy() for name, each in observations.items()})
        self._infos.append({name: infos[name][row] for name in _INFOS})

    def act(self, **step: Any) -> None:
        self._steps.append(step)

    def episode(self, envs: ReplayVectorEnv, ending: str) -> dict[str, Any]:
        scenario, steps = envs.scenarios[self.number], _stacked(self._steps)
        clipped = np.append(steps["clipped"], False)  # no action follows the last observation
        return {
            "observations": _stacked(self._observations),
            "actions": steps["action"],
            "rewards": steps["reward"],
            "terminations": steps["terminated"],
            "truncations": steps["truncated"],
            "infos": {"clipped": clipped} | _stacked(self._infos),
            "seed": self._seed,
            "options": {"scenario": self.number},
            "attributes": {
                "scenario": scenario.name,
                "recording": scenario.recording_name,
                "ending": ending,
            },
        }


def _stacked(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _flatten(space: spaces.Space[Any], observations: dict[str, np.ndarray]) -> np.ndarray:
    """Flattens observations (T, …) like `gymnasium.wrappers.FlattenObservation`."""
    assert isinstance(space, spaces.Dict)
    flat = [observations[name].reshape(len(observations[name]), -1) for name in space]
    return np.concatenate(flat, axis=1).astype(spaces.flatten_space(space).dtype)
