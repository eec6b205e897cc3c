"""Keys in the environment of a run are in no file that it writes and in no line that it says, crashes included."""

from importlib.util import find_spec

import pytest

from faults.runs import TRAIN
from forks import command

CANARY = "canary-5d41402abc4b2a76b9719d911017c592"
NAMES = ("WANDB_API_KEY", "HF_TOKEN", "AWS_SECRET_ACCESS_KEY", "OPENAI_API_KEY", "GITHUB_TOKEN", "MY_PASSWORD")
BROKEN = """
import gymnasium as gym

class Broken(gym.Wrapper):
    def step(self, action):
        self.taken = getattr(self, "taken", 0) + 1
        if self.taken > 20:
            raise RuntimeError("as it happens")
        return super().step(action)
"""
CASES = {
    # name: words, the exit code that belongs to them
    "run": ([*TRAIN, "r", "--report", "--score"], 0),
    "sweep": (["train", "ppo", "--seeds", "1,2", *TRAIN[2:], "r"], 0),
    "wandb": ([*TRAIN, "r", "--track", "wandb"], 0),
    "exception": (["train", "a2c", "--env", "CartPole-v1", "--wrappers", "broken:Broken", "--run", "r"], 1),
    "worker": (["train", "a2c", "--env", "CartPole-v1", "--wrappers", "broken:Broken", "--backend", "gymnasium-async", "--num-envs", "2", "--run", "r"], 1),
    "not finite": (["train", "a2c", "--env", "CartPole-v1", "--learning-rate", "1e38", "--run", "r"], 1),
    "misuse": (["train", "ppo", "--env", "CartPole-v1", "--lr", "1"], 2),
}  # fmt: skip


KEYS = dict.fromkeys(NAMES, CANARY) | {"WANDB_MODE": "offline", "HTTPS_PROXY": f"http://me:{CANARY}@localhost:9"}
"""what the environment of a run has, one of the keys in the address of a proxy"""


SHORT = ("exception", "misuse")


@pytest.mark.parametrize(
    "case", [case if case in SHORT else pytest.param(case, marks=pytest.mark.faults) for case in CASES]
)
def test_no_key_of_the_environment_is_written_or_said(tmp_path, case):
    words, expected = CASES[case]
    if "wandb" in words and find_spec("wandb") is None:
        pytest.skip("without wandb")
    (tmp_path / "broken.py").write_text(BROKEN)
    process = command(*words, cwd=tmp_path, **KEYS)
    said = "".join(process.communicate())
    assert process.returncode == expected, said
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert len(files) > (5 if expected == 0 else 0)
    assert CANARY not in said
    assert not [file for file in files if CANARY.encode() in file.read_bytes()]
    print(f"{case}: {len(files)} files, and what it said: 0 of {len(NAMES) + 1} keys")


def test_a_key_that_is_written_is_found(tmp_path):
    leak = "import os, pathlib; pathlib.Path('leak').write_text(str(dict(os.environ)))"
    command("--version", before=leak, cwd=tmp_path, **KEYS).wait()
    assert (tmp_path / "leak").read_text().count(CANARY) == len(NAMES) + 1
