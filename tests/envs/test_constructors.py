"""Signatures of the constructors, unknown options, and the public names."""

import ast
import dataclasses
import inspect
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import asp_env
import asp_env.envs
from asp_env.envs import ReplayOptions, UnknownOptionError
from asp_env.envs.parallel import ParallelReplayEnv

PARALLEL = [
    *("data", "classes", "ids", "max_agents", "pad_absent", "flatten", "numeric_infos"),
    "render_mode",
]
CONSTRUCTORS = {
    asp_env.ReplayEnv: ["data", "flatten", "render_mode"],
    asp_env.ReplayVectorEnv: [
        *("num_envs", "data", "autoreset_mode", "max_episode_steps", "flatten", "render_mode")
    ],
    ParallelReplayEnv: PARALLEL,
    asp_env.parallel_env: PARALLEL,
    asp_env.sb3_vec_env: ["num_envs", "data", "max_episode_steps", "flatten", "render_mode"],
}
"""The parameters before those of `ReplayOptions`."""


@pytest.mark.parametrize("constructor", CONSTRUCTORS, ids=lambda each: each.__name__)
def test_constructors_have_the_parameters_of_replay_options(constructor):
    """With the same defaults and types, as keywords."""
    parameters = inspect.signature(constructor).parameters
    fields = dataclasses.fields(ReplayOptions)
    own = CONSTRUCTORS[constructor]
    assert list(parameters) == [*own, *(field.name for field in fields)]
    for field in fields:
        parameter = parameters[field.name]
        assert parameter.kind is inspect.Parameter.KEYWORD_ONLY
        assert (parameter.default, parameter.annotation) == (field.default, field.type)
    assert parameters["data"].default == "sample:intersection"


@pytest.mark.parametrize(
    "make",
    [
        lambda **options: gymnasium.make("asp_env/Replay-v0", **options),
        lambda **options: gymnasium.make_vec(
            "asp_env/Replay-v0", 2, vectorization_mode="vector_entry_point", **options
        ),
        lambda **options: gymnasium.make_vec(
            "asp_env/HighwayIntersection-v0", 2, vectorization_mode="sync", **options
        ),
        asp_env.ReplayEnv,
        asp_env.parallel_env,
        lambda **options: asp_env.sb3_vec_env(2, **options),
    ],
    ids=["make", "make_vec", "make_vec sync", "ReplayEnv", "parallel_env", "sb3_vec_env"],
)
def test_an_unknown_option_names_the_nearest_one(make):
    """The error is a `TypeError`, as Python's own, and an `AspEnvError`."""
    message = "unexpected keyword argument 'trafic'; did you mean 'traffic'?"
    with pytest.raises(TypeError, match=message.replace("?", r"\?")) as caught:
        make(trafic="idm")
    assert isinstance(caught.value, asp_env.AspEnvError)
    assert isinstance(pickle.loads(pickle.dumps(caught.value)), UnknownOptionError)


def test_an_unknown_option_without_a_near_name_lists_the_known_ones():
    with pytest.raises(
        TypeError, match="'colour'; known: data, flatten, render_mode, observations"
    ):
        asp_env.ReplayEnv(colour=1)  # pyright: ignore[reportCallIssue]


@pytest.mark.parametrize("package", [asp_env, asp_env.envs], ids=lambda each: each.__name__)
def test_public_names_can_be_imported(package):
    assert set(package.__all__) <= {*dir(package), "ParallelReplayEnv", "ReplayVecEnv"}
    assert all(getattr(package, name) is not None for name in package.__all__)
    with pytest.raises(AttributeError, match="no attribute 'ReplayEnvironment'"):
        package.ReplayEnvironment  # noqa: B018


def test_editors_see_the_public_names():
    """The imports for type checkers in `asp_env` are those of `__getattr__`."""
    tree = ast.parse(Path(asp_env.__file__).read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = {
        str(node.module): tuple(alias.name for alias in node.names)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
    }
    assert imports == asp_env._MODULES
    assert sorted(asp_env._MODULE_OF) == sorted(asp_env.__all__)


def test_importing_the_package_makes_its_sub_modules_available():
    """`import asp_env` alone is enough for `asp_env.data` and others, as it was before."""
    code = (
        "import asp_env\n"
        "assert asp_env.data.source.open_data is asp_env.open_data\n"
        "assert asp_env.errors.AspEnvError is asp_env.AspEnvError\n"
        "assert {'data', 'errors'} <= set(dir(asp_env))\n"
        "for name in asp_env._SUBMODULES:\n"
        "    assert getattr(asp_env, name).__name__ == f'asp_env.{name}'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_package_imports_no_environment():
    """Registration needs only Gymnasium; public names are imported on first use."""
    code = (
        "import asp_env, gymnasium, sys\n"
        "assert 'asp_env/Replay-v0' in gymnasium.registry\n"
        "assert not {'numba', 'pandas', 'cv2', 'asp_env.envs'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_actions_convert_between_units():
    """5 m/s² and π/4 rad are 1; float32 stays float32."""
    physical = np.array([[5.0, -np.pi / 4], [-2.5, np.pi / 8]], dtype=np.float32)
    normalized = np.array([[1.0, -1.0], [-0.5, 0.5]], dtype=np.float32)
    np.testing.assert_array_equal(asp_env.normalize_actions(physical), normalized)
    back = asp_env.denormalize_actions(normalized)
    np.testing.assert_array_equal(back, physical)
    assert back.dtype == np.float32
