"""Environments that need the packages of the extra `rl`: made here, imported when they are."""

from typing import TYPE_CHECKING, Any

from asp_env.errors import MissingExtraError

if TYPE_CHECKING:
    from asp_env.envs.parallel import ParallelReplayEnv
    from asp_env.envs.sb3 import ReplayVecEnv


def parallel_env(data: str = "sample:intersection", **arguments: Any) -> "ParallelReplayEnv":
    """A PettingZoo parallel environment in which the vehicles of a recording are agents.

    Args:
        data: DATA.
        **arguments: of `asp_env.envs.parallel.ParallelReplayEnv`.

    Raises:
        AspEnvError: an argument is not understood, or no scenario is left.
        MissingExtraError: PettingZoo is not installed.
    """
    try:
        from asp_env.envs.parallel import ParallelReplayEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", "asp_env.parallel_env") from error
    return ParallelReplayEnv(data, **arguments)


def sb3_vec_env(num_envs: int, data: str = "sample:intersection", **options: Any) -> "ReplayVecEnv":
    """Environments side by side for stable-baselines3, in one world of arrays.

    Args:
        num_envs: how many.
        data: DATA.
        **options: of `asp_env/Replay-v0`.

    Raises:
        AspEnvError: an argument is not understood, or the data hold no scenario.
        MissingExtraError: stable-baselines3 is not installed.
    """
    try:
        from asp_env.envs.sb3 import ReplayVecEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", "asp_env.sb3_vec_env") from error
    from asp_env.envs.vector import ReplayVectorEnv

    return ReplayVecEnv(ReplayVectorEnv(num_envs, data, autoreset_mode="SameStep", **options))
