"""Damaged run folders of policies are refused in one line."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from asp_env.errors import AspEnvError
from policies.runs import load_policy


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    """A copy of the run that all tests share."""
    return Path(shutil.copytree(run, tmp_path / "run"))


def change(run: Path, part: str, **fields: Any) -> None:
    """Changes fields of a part of `config.json`."""
    path = run / "config.json"
    content = json.loads(path.read_text())
    content[part] |= fields
    path.write_text(json.dumps(content))


def test_a_changed_weight_is_found(copy: Path) -> None:
    """Its checksum is another; files of earlier versions have none."""
    path = copy / "policy.safetensors"
    weights = load_file(path)
    name = "action_net.bias"
    save_file({**weights, name: weights[name] + np.float32(0.5)}, path)
    with pytest.raises(AspEnvError, match=r"policy\.safetensors: damaged \(its checksum differs"):
        load_policy(copy)
    weights.pop("checksum")
    save_file(weights, path)
    load_policy(copy)


@pytest.mark.parametrize(
    ("part", "fields", "message"),
    [
        ("settings", {"width": 16.5}, "width is 16.5, expected a whole number"),
        ("settings", {"width": 10**6}, "width 1000000: expected at most 4,096"),
        ("settings", {"gamma": float("nan")}, "gamma is nan, expected a number"),
        ("observation", {"state": {"shape": [10**9], "dtype": "float32"}}, "damaged"),
        ("observation", {"state": {"shape": [3], "dtype": "float32"}}, "damaged|does not fit"),
        ("observation", {"neighbours": {"shape": [4], "dtype": "float32"}}, "damaged|does not fit"),
    ],
)
def test_a_changed_configuration_is_refused(
    part: str, fields: dict[str, Any], message: str, copy: Path
) -> None:
    change(copy, part, **fields)
    with pytest.raises(AspEnvError, match=message) as caught:
        load_policy(copy)
    assert "\n" not in str(caught.value)
