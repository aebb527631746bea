"""`asp-env completion`: each shell completes commands, groups, options and choices."""

import shutil
import subprocess
from pathlib import Path
from typing import Literal

import pytest

from asp_env.installation.completion import completion_script

BASH = """
source {script}
for line in "asp-env dr" "asp-env drive --pl" "asp-env rl com" "asp-env drive x --part val" \
            "asp-env rl compare --"; do
    COMP_WORDS=($line); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=()
    _tyro_asp_env; echo "${{COMPREPLY[@]}}"
done
"""
ZSH = """
_describe() {{ print -- ${{(P)2%%:*}} }}
for line in "asp-env dr" "asp-env drive --pl" "asp-env rl com" "asp-env drive x --part val" \
            "asp-env rl compare --"; do
    words=(${{=line}}); CURRENT=$#words; source {script}
done
"""
FISH = """
source {script}
for line in "asp-env dr" "asp-env drive --pl" "asp-env rl com" "asp-env drive x --part val" \
            "asp-env rl compare --"
    echo (complete -C $line | string split -f 1 \\t)
end
"""


@pytest.mark.parametrize(("shell", "code"), [("bash", BASH), ("zsh", ZSH), ("fish", FISH)])
def test_a_shell_completes(
    tmp_path: Path, shell: Literal["bash", "zsh", "fish"], code: str
) -> None:
    """Shells that are not installed are skipped."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    script = tmp_path / "script"
    script.write_text(completion_script(shell))
    no_settings = {"bash": ["--norc"], "zsh": ["-f"], "fish": ["--no-config"]}[shell]
    done = subprocess.run(
        [program, *no_settings, "-c", code.format(script=script)],
        capture_output=True, text=True, check=True, env={"PATH": "/usr/bin:/bin", "HOME": "/"},
    )  # fmt: skip
    command, option, grouped, choice, options = done.stdout.splitlines()
    assert (command, option, grouped, choice) == ("drive", "--planner", "compare", "validation")
    assert {"--held-out", "--learned", "--jobs"} <= set(options.split())
    assert all(word.startswith("-") for word in options.split())
