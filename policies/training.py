"""Training of policies with stable-baselines3."""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import Tensor

from asp_env.arguments import flag, is_finite_number, shown, whole_number
from asp_env.data.predictor import Predictor
from asp_env.errors import AspEnvError, unknown_name
from asp_env.files import check_new, is_vacant
from asp_env.workers import one_thread
from policies.cloning import clone
from policies.curriculum import Curriculum, ordered
from policies.environments import PolicyObservations, make_environments
from policies.logged_steps import logged_steps
from policies.runs import (
    CHECKPOINT,
    LOG_STD,
    POLICY,
    algorithm_classes,
    check_predictor,
    flatten_state,
    policy_arguments,
    read_tensors,
    restore_optimizer,
    save_config,
    write_tensors,
)
from policies.settings import CONFIG, DEFAULTS, PolicySettings, read_settings

LOWEST_SHARE_OF_RATE = 0.05
"""Share of the learning rate at the end of the training. Chosen by hand."""

OWN_ARGUMENTS = ("policy", "env", "device", "policy_kwargs", "gamma", "learning_rate", "seed")
"""Arguments of the algorithms that are no hyperparameters."""

NO_VALUES = ("_class", "_kwargs", "_log", "_noise")
"""Ends of the names of arguments that are objects or files."""

LEAST = {"learning_starts": 0, "gradient_steps": -1}
"""Smallest values of whole numbers whose default is above 0, where it is not 1."""

CHECKPOINT_STEPS = 50_000
"""Steps between checkpoints. Chosen by hand: some tens of seconds."""

PROGRESS = "progress.csv"
"""The table of training statistics. That of the first N steps of a resumed training is
`progress-N.csv`."""

EPISODE_KEYS = ("progress", "collision", "at_fault", "off_road_m", "ending")
"""Infos of finished episodes that are logged."""

Progress = Callable[[int], None]
"""Called with the number of steps so far."""


def train_policy(
    settings: PolicySettings,
    out: Path,
    *,
    resume: bool = False,
    privileged: bool = False,
    progress: Progress | None = None,
) -> None:
    """Trains a policy and writes its run folder.

    The same settings give the same weights on the same kind of machine. A resumed training goes
    on with the weights, optimizers and reward statistics of the last checkpoint in new episodes.

    Args:
        settings: the settings of the policy.
        out: the run folder.
        resume: whether to go on with an interrupted run in `out`.
        privileged: allows forecasts of a predictor that uses the recorded future.
        progress: called before the first step, and after each step of all environments.

    Raises:
        AspEnvError: a setting is invalid, `out` holds another run, there is nothing to resume, or
            the training diverges.
    """
    done = _check_folder(settings, out, resume)
    envs = make_environments(
        settings.environment,
        settings.data,
        settings.num_envs,
        scenarios=settings.environment.scenarios,
        privileged=privileged,
    )
    if settings.curriculum is not None:  # raises an error if there is no such column
        ordered(envs.get_attr("scenarios", 0)[0], settings.curriculum)
    monitored = VecMonitor(envs, info_keywords=EPISODE_KEYS)
    normalized = VecNormalize(
        monitored, norm_obs=False, norm_reward=settings.normalize_reward, gamma=settings.gamma
    )
    algorithm = make_algorithm(settings, normalized)
    predictor = predictor_of(envs)
    if done:
        check_predictor(out, predictor)
        done = _restore(out, algorithm, normalized)
        _keep_progress(out, done)
    else:
        out.mkdir(parents=True, exist_ok=True)
        _remove_logs(out)
        space = envs.observation_space
        assert isinstance(space, spaces.Dict)
        save_config(out, settings, space, predictor, 0)
    if progress is not None:
        progress(done)
    if settings.demonstrations and not done:
        _clone_logged_drivers(settings, algorithm, privileged)
    left = 0 if settings.algorithm == "bc" else settings.steps - done
    algorithm.set_logger(configure(str(out), ["csv", "tensorboard"]))
    callbacks: list[BaseCallback] = [EpisodeStatistics(), Checkpoints(out, normalized)]
    if settings.curriculum is not None:
        callbacks.append(Curriculum(settings.curriculum, settings.steps))
    if progress is not None:
        callbacks.append(_Report(progress))
    try:
        with one_thread():
            algorithm.learn(left, callback=CallbackList(callbacks), reset_num_timesteps=not done)
    except ValueError as error:
        if "invalid values" not in str(error):  # of a distribution, in words of torch
            raise
        raise AspEnvError(
            f"{out}: the training diverged after {algorithm.num_timesteps:,} steps: its weights "
            "are not finite; train again with a smaller learning rate or other hyperparameters"
        ) from error
    finally:
        algorithm.logger.close()
    space = envs.observation_space
    assert isinstance(space, spaces.Dict)
    save_config(out, settings, space, predictor, algorithm.num_timesteps)
    write_tensors(out / POLICY, algorithm.policy.state_dict())  # last: the training has ended
    (out / CHECKPOINT).unlink(missing_ok=True)
    envs.close()


def check_environment(folder: Path, settings: PolicySettings, data: str, privileged: bool) -> None:
    """Checks that an environment shows a trained policy the forecasts of its own predictor.

    Args:
        folder: the run folder of the policy.
        settings: the settings of the policy, possibly with another predictor.
        data: the data to drive in.
        privileged: allows forecasts of a predictor that uses the recorded future.

    Raises:
        AspEnvError: the predictor is another one, or has other weights.
    """
    envs = make_environments(settings.environment, data, 1, scenarios="", privileged=privileged)
    check_predictor(folder, predictor_of(envs))
    envs.close()


def make_algorithm(settings: PolicySettings, envs: VecNormalize) -> BaseAlgorithm:
    """Makes the algorithm of stable-baselines3 with random weights.

    Args:
        settings: the settings of the policy.
        envs: its environments.

    Raises:
        AspEnvError: a hyperparameter is unknown.
    """
    classes = algorithm_classes(settings.algorithm)
    arguments = {**DEFAULTS[settings.algorithm], **settings.hyperparameters}
    rate = settings.learning_rate
    policy_kwargs = policy_arguments(settings)
    algorithm: Any = classes.algorithm
    _check_hyperparameters(settings, algorithm)
    try:
        return algorithm(
            classes.policy,
            envs,
            learning_rate=lambda left: rate * max(left, LOWEST_SHARE_OF_RATE),
            gamma=settings.gamma,
            seed=settings.seed,
            device="cpu",
            policy_kwargs=policy_kwargs,
            **arguments,
        )
    except (TypeError, ValueError, AssertionError) as error:
        raise AspEnvError(f"hyperparameters of {settings.algorithm}: {error}") from None
    except MemoryError as error:
        raise AspEnvError(
            f"{settings.algorithm} with {settings.num_envs} environments and hyperparameters "
            f"{arguments}: not enough memory ({error}); choose smaller numbers"
        ) from None


def _check_hyperparameters(settings: PolicySettings, algorithm: type) -> None:
    """Checks the names of hyperparameters, and that their values are like the algorithm's own.

    stable-baselines3 itself checks few of them, and some only while it trains.

    Raises:
        AspEnvError: a name or a value is invalid.
    """
    parameters = inspect.signature(algorithm).parameters
    known = {
        name: each.default
        for name, each in parameters.items()
        if name not in OWN_ARGUMENTS and not name.startswith("_") and not name.endswith(NO_VALUES)
    }
    for name, value in settings.hyperparameters.items():
        if name in ("gamma", "learning_rate", "seed"):
            raise AspEnvError(f"hyperparameter {name}: it is an option of its own, {name}")
        if name not in known:
            raise unknown_name(f"hyperparameter of {settings.algorithm}", name, known)
        default = {**known, **DEFAULTS[settings.algorithm]}[name]
        if isinstance(default, bool):
            flag(name, value)
        elif isinstance(default, int):
            whole_number(name, value, least=LEAST.get(name, 1 if default > 0 else -1))
        elif default is None and value is None:
            continue
        elif isinstance(default, float | None) and not is_finite_number(value):
            raise AspEnvError(f"{name} {shown(value)}: expected a finite number")
        elif isinstance(value, float) and not is_finite_number(value):
            raise AspEnvError(f"{name} {shown(value)}: expected a finite number, or a text")


def predictor_of(envs: PolicyObservations) -> Predictor | None:
    """The predictor whose forecasts environments show, if any."""
    predictors: Any = envs.get_attr("predictors", 0)[0]
    return predictors[0] if predictors else None


def _clone_logged_drivers(
    settings: PolicySettings, algorithm: BaseAlgorithm, privileged: bool
) -> None:
    """Trains the policy to act as the logged drivers, before anything else."""
    policy: Any = algorithm.policy
    steps = logged_steps(settings, privileged=privileged)
    with one_thread():
        clone(
            policy,
            steps.observations,
            steps.actions,
            steps.recording if len(np.unique(steps.recording)) > 1 else _thirds(len(steps.actions)),
            epochs=settings.demonstrations,
            seed=settings.seed,
        )
    if settings.algorithm == "ppo":  # cloning has lowered the deviation, PPO has to explore
        with torch.no_grad():
            policy.log_std.fill_(LOG_STD)


def _thirds(count: int) -> np.ndarray:
    """Three groups of steps one after the other, for data of a single recording."""
    return np.arange(count) * 3 // count


def _check_folder(settings: PolicySettings, out: Path, resume: bool) -> bool:
    """Whether there is something to resume.

    Raises:
        AspEnvError: the folder does not fit.
    """
    if not resume:
        if not is_vacant(out):
            raise AspEnvError(
                f"{out} exists and is not an empty folder; choose another, or go on with --resume"
            )
        if not out.exists():
            check_new(out)
        return False
    if (out / POLICY).exists():
        (out / CHECKPOINT).unlink(missing_ok=True)
        raise AspEnvError(f"{out}: the training has ended; there is nothing to resume")
    if not (out / CONFIG).exists():
        raise AspEnvError(f"{out}: no run to resume; train without --resume")
    before = read_settings(out)
    if before != settings:
        names = [
            name
            for name in PolicySettings.__dataclass_fields__
            if getattr(before, name) != getattr(settings, name)
        ]
        raise AspEnvError(
            f"{out}: the interrupted run has other settings ({', '.join(names)}); resume with the "
            "same, or choose another folder"
        )
    return (out / CHECKPOINT).exists()


def _remove_logs(out: Path) -> None:
    """Removes the statistics of a training that was interrupted before its first checkpoint."""
    for path in (*out.glob("progress*.csv"), *out.glob("events.out.tfevents.*")):
        path.unlink()


def _keep_progress(out: Path, done: int) -> None:
    """Renames the table of statistics, since stable-baselines3 starts a new one."""
    table = out / PROGRESS
    if table.exists():
        table.rename(out / f"{table.stem}-{done}{table.suffix}")


class EpisodeStatistics(BaseCallback):
    """Logs what became of the episodes of each rollout: success, collisions, progress, comfort."""

    def __init__(self) -> None:
        super().__init__()
        self._ended: list[Mapping[str, Any]] = []
        self._comfort: list[float] = []

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self._comfort.append(float(np.mean([info["reward_terms"]["comfort"] for info in infos])))
        self._ended += [infos[b] for b in np.flatnonzero(self.locals["dones"]).tolist()]
        return True

    def _on_rollout_end(self) -> None:
        if self._ended:
            endings = [info["ending"] for info in self._ended]
            means = {
                "success": [name == "GOAL" for name in endings],
                "at_fault_collision": [name == "COLLISION" for name in endings],
                "off_road": [name == "OFF_ROAD" for name in endings],
                "progress": [info["progress"] for info in self._ended],
                "comfort": self._comfort,
            }
            for name, values in means.items():
                self.logger.record(f"episodes/{name}", float(np.mean(values)))
        self._ended, self._comfort = [], []


class Checkpoints(BaseCallback):
    """Writes a checkpoint every `CHECKPOINT_STEPS` steps."""

    def __init__(self, out: Path, envs: VecNormalize) -> None:
        """Holds the run folder and the statistics of the rewards."""
        super().__init__()
        self._out, self._envs, self._next = out, envs, CHECKPOINT_STEPS

    def _on_training_start(self) -> None:
        self._next = self.num_timesteps + CHECKPOINT_STEPS

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._next:
            self._next += CHECKPOINT_STEPS
            write_tensors(self._out / CHECKPOINT, checkpoint_of(self.model, self._envs))


class _Report(BaseCallback):
    """Reports the number of steps."""

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self._progress = progress

    def _on_step(self) -> bool:
        self._progress(self.num_timesteps)
        return True


def checkpoint_of(algorithm: BaseAlgorithm, envs: VecNormalize) -> dict[str, Tensor]:
    """Weights, optimizers and statistics of an algorithm under way, by flat names.

    Args:
        algorithm: the algorithm.
        envs: its environments.
    """
    rewards = envs.ret_rms
    numbers = [algorithm.num_timesteps, rewards.mean, rewards.var, rewards.count]
    tensors = {"numbers": torch.tensor([float(number) for number in numbers], dtype=torch.float64)}
    for name, state in algorithm.get_parameters().items():
        tensors |= flatten_state(state, name)
    return tensors


def _restore(out: Path, algorithm: BaseAlgorithm, envs: VecNormalize) -> int:
    """Restores a checkpoint; returns its number of steps."""
    tensors = read_tensors(out / CHECKPOINT)
    steps, mean, variance, count = tensors["numbers"].tolist()
    rewards: Any = envs.ret_rms
    rewards.mean, rewards.var, rewards.count = np.float64(mean), variance, count
    algorithm.num_timesteps = int(steps)
    for name in algorithm.get_parameters():
        owner: Any = algorithm
        for part in name.split("."):
            owner = getattr(owner, part)
        if isinstance(owner, torch.optim.Optimizer):
            restore_optimizer(owner, tensors, name)
        else:
            start = f"{name}/"
            own = {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}
            owner.load_state_dict(own)
    return int(steps)
