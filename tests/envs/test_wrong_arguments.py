"""Wrong types and values of arguments, all over the public functions."""

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.envs.wrong_arguments import GROUPS


@pytest.fixture(scope="module")
def answers(crossing: str) -> dict[str, Any]:
    """The answers to all calls, from a process without checks of types."""
    command = [sys.executable, "-m", "tests.envs.wrong_arguments", crossing]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    return json.loads(result.stdout)


@pytest.mark.parametrize("group", GROUPS)
def test_wrong_arguments_are_refused_in_one_line(answers: dict[str, Any], group: str) -> None:
    """Each raises `AspEnvError`, or what Python's or Gymnasium's conventions demand."""
    assert answers[group]["calls"] >= 15
    assert answers[group]["faults"] == []
