"""Completion, in the shells themselves."""

import shutil
import subprocess

import pytest

from lemniscate.cli import main

BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_lemniscate
printf '%s\\n' "${COMPREPLY[@]}"
"""

CASES = [
    (["lemniscate", "tr"], ["train"]),
    (["lemniscate", "train", "p"], ["ppo", "pqn"]),
    (["lemniscate", "train", "ppo", "--minibatch"], ["--minibatch-size"]),
    (["lemniscate", "train", "sac", "--tau"], ["--tau"]),
    (["lemniscate", "train", "sac", "--clip"], []),
    (["lemniscate", "train", "ppo", "--env", "LunarLander-"], ["LunarLander-v3"]),
    (["lemniscate", "train", "ppo", "--activation", "t"], ["tanh"]),
    (["lemniscate", "doctor", "Pendul"], ["Pendulum-v1"]),
    (["lemniscate", "check", "Pendul"], ["Pendulum-v1"]),
    (["lemniscate", "evaluate", "--epi"], ["--episodes"]),
    (["lemniscate", "push", "--pri"], ["--private"]),
    (["lemniscate", "completion", "z"], ["zsh"]),
]


@pytest.fixture(scope="module")
def scripts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("completion")
    for shell in ("bash", "zsh", "fish"):
        with pytest.MonkeyPatch.context() as patch, (folder / shell).open("w") as file:
            patch.setattr("sys.stdout", file)
            assert main(["completion", shell]) == 0
    return folder


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not installed")
@pytest.mark.parametrize(("words", "expected"), CASES)
def test_bash_completes(scripts, words, expected):
    done = subprocess.run(["bash", "-c", BASH, "-", scripts / "bash", *words], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.split() == expected


@pytest.mark.skipif(not shutil.which("fish"), reason="fish is not installed")
@pytest.mark.parametrize(("words", "expected"), CASES)
def test_fish_completes(scripts, words, expected):
    asked = f"source {scripts / 'fish'}; complete -C '{' '.join(words)}'"
    done = subprocess.run(["fish", "--no-config", "-c", asked], capture_output=True, text=True)
    assert done.stderr == ""
    assert [line.partition("\t")[0] for line in done.stdout.splitlines()] == expected


@pytest.mark.skipif(not shutil.which("zsh"), reason="zsh is not installed")
def test_zsh_reads_its_script(scripts):
    asked = 'source "$1"; echo $_comps[lemniscate]'
    done = subprocess.run(["zsh", "-f", "-c", asked, "-", scripts / "zsh"], capture_output=True, text=True)
    assert "_bash_complete" in done.stdout


def test_another_shell_is_refused(capsys):
    assert main(["completion", "tcsh"]) == 2
    assert "'tcsh'" in capsys.readouterr().err
