"""The commands, as a person types them."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.algos import find
from lemniscate.cli import algorithms, give_way, main, parse
from lemniscate.envs import registry
from lemniscate.errors import UserError
from lemniscate.presets import Preset
from lemniscate.run.fields import read

TINY = [
    str(part)
    for name, value in tiny_fields("CartPole-v1").items()
    if name in {"num_envs", "num_steps", "total_steps", "epochs", "minibatch_size", "evaluate_episodes"}
    for part in (f"--{name.replace('_', '-')}", value)
]

ALGORITHMS = ("reinforce", "a2c", "trpo", "ppo", "reppo", "pqn", "shac", "ddpg", "td3", "sac")


class Broken(gym.Env):
    """Ten steps; the reward is NaN while `broken`."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    broken = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(2, np.float32), np.nan if self.broken else 1.0, self.t == 10, False, {}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "run"
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run", str(path), *TINY]) == 0
    return path


def test_evaluate_prints_one_json_object_on_standard_output(run, capsys):
    assert main(["evaluate", str(run), "--episodes", "3", "--seed", "5", "--json"]) == 0
    out, _ = capsys.readouterr()
    scores = json.loads(out)
    assert {"env_id", "episodes", "mean_return", "std_return", "returns", "lengths"} <= set(scores)
    assert scores["env_id"] == "CartPole-v1"
    assert len(scores["returns"]) == 3


def test_what_a_person_reads_goes_to_standard_error(run, capsys):
    assert main(["evaluate", str(run), "--episodes", "3"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "over 3 episodes" in err


def test_fields_reach_the_config(run):
    config = json.loads((run / "config.json").read_text())["config"]
    assert config["num_envs"] == 4
    assert config["total_steps"] == 256


def test_environment_arguments_and_wrappers_reach_training_and_evaluation(tmp_path, capsys):
    path, wrapper = tmp_path / "run", "gymnasium.wrappers:TimeLimit(max_episode_steps=7)"
    world = ["--env", "CartPole-v1", "--env-args", '{"sutton_barto_reward": true}', "--wrappers", wrapper]
    assert main(["train", "ppo", *world, "--run", str(path), *TINY]) == 0
    config = json.loads((path / "config.json").read_text())["config"]
    assert config["env_kwargs"] == {"sutton_barto_reward": True}
    assert config["wrappers"] == [wrapper]
    returns = []
    for kwargs in ([], ["--env-args", '{"sutton_barto_reward": false}']):
        capsys.readouterr()
        assert main(["evaluate", str(path), "--episodes", "3", "--json", *kwargs]) == 0
        returns.append(json.loads(capsys.readouterr().out)["returns"])
    assert returns == [[0, 0, 0], [7, 7, 7]]


def test_arguments_of_a_preset_that_are_left_out_are_named(tmp_path, capsys):
    config = lem.config_for("ppo", "CartPole-v1", preset="default", env_kwargs={"max_episode_steps": 20})
    Preset("own", config, "a test", "2026").write(tmp_path / "own.json", "ppo")
    train = ["train", "ppo", "--env", "CartPole-v1", "--preset", str(tmp_path / "own.json"), *TINY]
    assert main([*train, "--env-args", "{}", "--run", str(tmp_path / "a")]) == 0
    assert '{"max_episode_steps": 20} is left out.' in capsys.readouterr().err
    assert main([*train, "--env-args", '{"max_episode_steps": 20}', "--run", str(tmp_path / "b")]) == 0
    assert "is left out" not in capsys.readouterr().err


def test_train_with_a_report_leaves_pictures(tmp_path, capsys):
    path = tmp_path / "r"
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run", str(path), "--report", *TINY]) == 0
    assert (path / "plots" / "learning_curve.png").stat().st_size > 5000
    assert "over 100 episodes of CartPole-v1" in capsys.readouterr().err


def test_the_score_is_said_and_is_that_of_the_page(tmp_path, capsys):
    path = tmp_path / "r"
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run", str(path), "--report", "--score", *TINY]) == 0
    said = capsys.readouterr().err
    final = json.loads((path / "final.json").read_text())
    assert f"Final return {final['mean_return']:.1f} over 100 episodes." in said
    assert said.count("Evaluating") == 1
    assert f"{final['mean_return']:,.1f} ± {final['std_return']:,.1f}" in (path / "plots" / "report.html").read_text()


def test_plot_of_several_runs(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(run), str(run)]) == 0
    assert (tmp_path / "plots" / "learning_curve.png").exists()


def test_envs_lists_backend_and_preset(capsys):
    assert main(["envs", "figure"]) == 0
    err = capsys.readouterr().err
    assert "DroneFigureEightTrajectory-v0" in err
    assert "crazyflow" in err
    assert "figure-eight" in err


def test_envs_is_a_page_of_families(capsys):
    assert main(["envs"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) <= 40
    counts = [int(found[1]) for line in lines if (found := re.match(r"[\w. ]{28} +(\d+)  \S", line))]
    assert sum(counts) == len(registry.known_ids())
    assert main(["envs", "classic_control"]) == 0
    assert "CartPole-v1" in (listed := capsys.readouterr().err)
    assert "LunarLander" not in listed


@pytest.mark.parametrize(
    ("written", "here"),
    [
        ("LunarLander-v2", "LunarLander-v3"),
        ("HalfCheetah-v3", "HalfCheetah-v5"),
        ("HalfCheetah-v2", "HalfCheetah-v5"),
        ("CartPole", "CartPole-v1"),
        ("cartpole", "CartPole-v1"),
        ("Pendulum-v0", "Pendulum-v1"),
        ("PongNoFrameskip-v4", "EnvPool/Pong-v5"),
        ("ALE/Pong-v5", "EnvPool/Pong-v5"),
        ("Breakout-ramDeterministic-v4", "EnvPool/Breakout-v5"),
        ("dm_control/cartpole-balance-v0", "EnvPool/CartpoleBalance-v1"),
        ("walker_walk", "EnvPool/WalkerWalk-v1"),
        ("MiniGrid-Empty-5x5-v0", "EnvPool/MiniGrid-Empty-5x5-v0"),
        ("FetchReach-v2", "FetchReach-v4"),
    ],
)
def test_names_of_other_versions_and_libraries_get_the_name_here(written, here):
    if here.startswith("EnvPool"):
        pytest.importorskip("envpool")
    with pytest.raises(UserError, match=f"^There is no environment '{written}': did you mean {here}\\?$"):
        registry.backend_for(written)


def test_without_envpool_what_it_has_is_named(monkeypatch):
    monkeypatch.setattr(registry, "is_installed", lambda package: False)
    monkeypatch.setattr(registry, "known_ids", lambda: list(gym.registry))
    for written in ("PongNoFrameskip-v4", "ALE/Pong-v5", "Nothing-v0"):
        with pytest.raises(UserError, match=r"Atari.*envpool is not installed"):
            registry.backend_for(written)


@pytest.mark.parametrize(
    "words",
    [
        ["--hidden", "32", "16"],
        ["--hidden", "32,16"],
        ["--hidden=[32, 16]"],
        ["--hidden", "[32, 16]"],
        ["--hidden", "[32,", "16]"],
        ["--hidden", "(32, 16)"],
    ],
)
def test_several_values_are_read_as_every_program_writes_them(words):
    given = parse(["train", "ppo", "--env", "CartPole-v1", *words])
    assert given.fields["hidden"] == (32, 16)


def test_names_are_read_as_python_writes_several():
    given = parse(["train", "ppo", "--env", "x", "--wrappers", "['a:b', \"c:d(x=[1, 2], y='z')\"]", "--hidden=[]"])
    assert given.fields["wrappers"] == ("a:b", "c:d(x=[1, 2], y='z')")
    assert given.fields["hidden"] == ()


@pytest.mark.long
def test_the_home_folder_is_meant_wherever_a_path_is_taken(run, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run=~/a", *TINY]) == 0
    small = {"total_steps": 256, "num_envs": 4, "num_steps": 64, "minibatch_size": 64, "progress": False}
    lem.train("ppo", env="CartPole-v1", run="~/b", warm_start="~/a", **small)
    assert lem.load("~/b").path == tmp_path / "b"
    assert lem.resume("~/b", progress=False).path == tmp_path / "b"
    for command in ("evaluate --episodes 1", "watch --video=~/video.gif", "plot", "doctor"):
        assert main([*command.split(), "~/b"]) == 0
    lem.save(lem.load("~/b"), "~/policy")
    assert (tmp_path / "video.gif").exists()
    assert (tmp_path / "policy").is_dir()
    assert not any(tmp_path.glob("*~*"))


def test_a_run_goes_on_to_more_steps_and_one_of_its_checkpoints_is_named(tmp_path, capsys):
    words = ["--run", str(tmp_path / "r"), "--checkpoint-every", "64", "--keep-checkpoints", "10"]
    assert main(["train", "ppo", "--env", "CartPole-v1", *TINY, *words]) == 0
    assert main(["resume", str(tmp_path / "r"), "--total-steps", "320"]) == 0
    assert lem.load(tmp_path / "r").step == 320
    returns = {}
    for step in (None, 64):
        capsys.readouterr()
        named = [] if step is None else ["--checkpoint", str(step)]
        assert main(["evaluate", str(tmp_path / "r"), "--episodes", "8", "--json", *named]) == 0
        returns[step] = json.loads(capsys.readouterr().out)["returns"]
        assert returns[step] == lem.evaluate(tmp_path / "r", episodes=8, checkpoint=step).returns
    assert returns[None] != returns[64]
    assert main(["evaluate", str(tmp_path / "r"), "--checkpoint", "best"]) == 2
    assert "has no checkpoint best; those at steps: 64, 128, 192, 256, 320" in capsys.readouterr().err


def test_stochastic_means_the_same_in_evaluate_and_watch(run, capsys):
    returns = []
    for words in ([], ["--stochastic"]):
        assert main(["evaluate", str(run), "--episodes", "8", "--json", *words]) == 0
        returns.append(json.loads(capsys.readouterr().out)["returns"])
    assert returns[0] != returns[1]
    given = [parse(["watch", "r", *words]) for words in ([], ["--stochastic"], ["--sample"])]
    assert [one.deterministic for one in given] == [True, False, False]


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--help"],
        ["train", "--help"],
        ["train", "ppo,sac", "--help"],
        ["evaluate", "--help"],
        ["--version"],
        ["trian"],
        ["train", "pp"],
        ["train", "--env", "CartPole-v1", "ppo"],
        ["evaluate", "nowhere", "--episods", "3"],
    ],
)
def test_help_and_a_mistyped_name_import_nothing_heavy(words):
    look = "import sys; from lemniscate.cli import main; main(sys.argv[1:]); print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", look, *words], capture_output=True, text=True, check=True)
    loaded = set(ended.stdout.splitlines()[-1].split())
    assert "lemniscate.cli" in loaded
    assert not loaded & {"torch", "numpy", "gymnasium", "matplotlib"}
    assert not loaded & {"lemniscate.cli.fields", "lemniscate.cli.commands"}


def test_help_is_written_in_any_locale():
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = [sys.executable, "-m", "lemniscate", "train", "--help"]
    ended = subprocess.run(words, capture_output=True, text=True, env=plain)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--FIELD VALUE \\u2026" in ended.stdout


def test_importing_the_package_imports_nothing_heavy_and_shows_its_names():
    look = "import sys, lemniscate as lem; print('torch' in sys.modules, *dir(lem)); lem.train; print('torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    before, after = ended.stdout.splitlines()
    assert before.split()[0] == "False"
    assert {*lem.__all__, "maths"} <= set(before.split())
    assert after == "True"


def test_every_public_name_is_found():
    assert all(getattr(lem, name).__name__ == name for name in lem.__all__)
    assert lem.__all__ == sorted(name for names in lem.MODULES.values() for name in names)
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        lem.trian  # noqa: B018


def test_bare_is_help_and_help_names_every_command(capsys):
    assert main([]) == 0
    bare = capsys.readouterr().out
    assert main(["--help"]) == 0
    assert capsys.readouterr().out == bare
    for command in ("train", "resume", "evaluate", "watch", "plot", "push", "envs", "doctor"):
        assert f"\n    {command} " in bare


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("lemniscate 0.")


@pytest.mark.parametrize("columns", [80, 120])
def test_help_of_train_lists_the_algorithms(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main(["train", "--help"]) == 0
    out = capsys.readouterr().out
    assert tuple(algorithms()) == ALGORITHMS
    assert "  ppo         Proximal Policy Optimization" in out
    assert len(out.splitlines()) < 30


@pytest.mark.parametrize("columns", ["", "80"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_help_of_an_algorithm_is_its_own_fields_on_two_pages(algorithm, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert main(["train", algorithm, "--help"]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= 120
    assert ("--clip FLOAT" in out) == (algorithm == "ppo")
    assert ("--tau FLOAT" in out) == (algorithm in ("ddpg", "td3", "sac"))
    titles = [line for line in out.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert titles == ["options:", "run:", "environment:", "algorithm:", "networks:", "logging and checkpoints:"]
    flags = set(re.findall(r"--[a-z0-9-]+", out.replace("[no-]", "")))
    fields = {name for name in find(algorithm).Config.names() if name not in ("env", "env_kwargs")}
    assert {f"--{name.replace('_', '-')}" for name in fields} <= flags


def test_help_of_a_field_is_its_type_docstring_choices_and_default(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert main(["train", "ppo", "--help"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "--epochs INT " in out
    assert "--hidden INT … widths" in out
    assert " [64 64] " in out
    assert "{tanh, relu, elu, silu} [tanh]" in out
    assert "--target-kl FLOAT|none" in out


@pytest.mark.parametrize(
    ("words", "fields"),
    [
        (["--total-steps", "1e6"], {"total_steps": 1e6}),
        (["--total_steps=1_000_000"], {"total_steps": 1_000_000}),
        (["--initial-log-std", "-5e-1"], {"initial_log_std": -0.5}),
        (["--hidden", "32", "16", "--clip", "0.3"], {"hidden": (32, 16), "clip": 0.3}),
        (["--hidden", "32,16"], {"hidden": (32, 16)}),
        (["--hidden", "none"], {"hidden": ()}),
        (["--target-kl", "none"], {"target_kl": None}),
        (["--no-normalize-advantage", "--scale-rewards"], {"normalize_advantage": False, "scale_rewards": True}),
        (["--activation", "relu"], {"activation": "relu"}),
    ],
)
def test_values_are_read_as_their_fields_want_them(words, fields):
    assert parse(["train", "ppo", *words]).fields == fields


def test_wrappers_are_parted_at_commas_outside_of_brackets():
    texts = ["gymnasium.wrappers:TimeLimit(max_episode_steps=5,x=[1,2]),own:f", "own:g"]
    expected = ("gymnasium.wrappers:TimeLimit(max_episode_steps=5,x=[1,2])", "own:f", "own:g")
    assert read("wrappers", tuple[str, ...], texts) == expected


def test_a_dictionary_is_json():
    assert read("env_kwargs", dict[str, object], '{"gravity": -5}') == {"gravity": -5}
    for text in ("gravity=-5", "[1]"):
        with pytest.raises(lem.UserError, match="--env-args must be a JSON object, such as"):
            read("env_kwargs", dict[str, object], text)


OWN = '''"""An algorithm of one's own."""

from dataclasses import dataclass

from lemniscate.algos.ppo import Config as PPO


@dataclass(frozen=True, kw_only=True)
class Config(PPO):
    """PPO's, and one more."""

    courage: float = 0.25
    """how bold the policy is"""


def train(config, run):
    """Nothing is learned here."""
'''


def test_an_algorithm_of_ones_own_has_its_fields_in_its_help(tmp_path, monkeypatch, capsys):
    (tmp_path / "bold.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["train", "bold", "--help"]) == 0
    out = capsys.readouterr().out
    assert "--courage FLOAT              how bold the policy is [0.25]" in out
    assert "--clip FLOAT" in out
    assert parse(["train", "bold", "--courage", "1"]).fields == {"courage": 1}


def test_an_algorithm_is_named_by_its_module_and_its_own_name_too(tmp_path, monkeypatch):
    (tmp_path / "several.py").write_text("from lemniscate.algos import a2c")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["train", "several:a2c", "--env", "CartPole-v1", "--total-steps", "64"]) == 0
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name == "CartPole-v1-several_a2c-1"
    assert lem.load(run).step == 256


@pytest.mark.parametrize("env", [["--env", "CartPole-v1"], ["--env=CartPole-v1"]])
def test_who_names_no_algorithm_gets_the_recommended_one_and_is_told_why(tmp_path, capsys, env):
    run = tmp_path / "run"
    assert main(["train", *env, "--run", str(run), "--total-steps", "64", "--evaluate-every", "0"]) == 0
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith("No algorithm is named: ppo takes every kind of actions")
    assert second.startswith("ppo on 8 × CartPole-v1")
    assert json.loads((run / "config.json").read_text())["algorithm"] == "ppo"


@pytest.mark.parametrize(("words", "same"), [(["help"], ["--help"]), (["help", "plot"], ["plot", "--help"])])
def test_help_is_a_word_too(words, same, capsys):
    said = []
    for arguments in (words, same):
        assert main(arguments) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] != ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "--env-args", "{}"], "Which algorithm? lemniscate train ALGORITHM …"),
        (["trian"], "There is no command 'trian': did you mean train?"),
        (["evaluat"], "There is no command 'evaluat': did you mean evaluate?"),
        (["sweep"], "There is no command 'sweep': there is train, tune, resume, evaluate, watch, "),
        (["help", "evaluat"], "There is no command 'evaluat': did you mean evaluate?"),
        (["--verion"], "The following arguments are required: COMMAND"),
        (["train"], "Which algorithm? lemniscate train ALGORITHM …, with one of reinforce, a2c, trpo, ppo"),
        (["train", "pp", "--env", "CartPole-v1"], "There is no algorithm 'pp': did you mean ppo or reppo?"),
        (["train", "PPO", "--env", "CartPole-v1"], "There is no algorithm 'PPO': did you mean ppo?"),
        (["train", "ppo,sacc", "--seeds", "1-2"], "There is no algorithm 'sacc': did you mean sac"),
        (["train", "--seed", "3", "ppo"], "The algorithm comes first, then its fields: lemniscate train ppo"),
        (["train", "CartPole-v1", "ppo"], "The algorithm comes first, then its fields: lemniscate train ppo"),
        (["train", "ppo", "sac", "--seeds", "1-2"], "Several algorithms are one word: lemniscate train ppo,sac --seeds"),
        (["train", "ppo,", "sac"], "Several algorithms are one word: lemniscate train ppo,sac --seeds 1-5"),
        (["train", "ppo", "--env", "mine"], "There is no environment 'mine': one of your own is named as module:Class."),
        (["train", "nowhere.to"], "There is no algorithm 'nowhere.to'"),
        (["train", "json"], "json is not an algorithm: it has no Config and no train."),
        (["train", "ppo"], "Which environment?"),
        (["train", "ppo", "--env", "CartPol-v1"], "There is no environment 'CartPol-v1': did you mean CartPole-v1"),
        (["train", "ppo", "--env"], "Argument --env: expected one argument"),
        (["train", "ppo", "CartPole-v1"], "Unknown argument 'CartPole-v1'"),
        (["train", "ppo", "--env", "CartPole-v1", "--preset", "corse"], "There is no preset 'corse': did you mean course"),
        (["train", "ppo", "--env", "CartPole-v1", "--gama", "1"], "There is no field '--gama': did you mean --gamma"),
        (["train", "ppo", "--env", "CartPole-v1", "-seed", "3"], "There is no field '-seed': did you mean --seed"),
        (["train", "mine:algo", "--env", "CartPole-v1"], "mine:algo cannot be found: there is no module mine here"),
        (["train", "ppo", "--lr", "1"], "There is no --lr: here it is --learning-rate."),
        (["train", "sac", "--lr", "1"], "There is no --lr: here it is --actor-learning-rate or --critic-learning-rate."),
        (["train", "ppo", "--batch-size=32"], "There is no --batch-size: here it is --minibatch-size."),
        (["train", "ppo", "--env", "x", "--qqqq", "1"], "There is no field '--qqqq': `lemniscate train ALGO --help` lists them."),
        (["train", "ppo,sac", "--polyak", "1"], "ppo: There is no field '--polyak'"),
        (["train", "sac", "--polyak", "1"], "There is no --polyak: here it is --tau (theirs: 1 − tau)."),
        (["train", "ppo", "--total_timesteps", "1"], "There is no --total-timesteps: here it is --total-steps."),
        (["train", "ppo", "--logdir", "x"], "There is no --logdir: here it is --run."),
        (["train", "ppo", "--env", "CartPole-v1", "--gamma", "x"], "gamma must be a number from 0 to 1, not 'x'."),
        (["train", "ppo", "--env", "CartPole-v1", "--gamma", "3"], "gamma must be a number from 0 to 1, not 3."),
        (["train", "ppo", "--env", "CartPole-v1", "--epochs", "1.5"], "epochs must be a whole number from 1 to 10,000, not 1.5."),
        (["train", "ppo", "--env", "CartPole-v1", "--hidden", "8,x"], "hidden must be a whole number from 1 to 1,000,000, not 'x'."),
        (["train", "ppo", "--env", "CartPole-v1", "--clip-value", "0"], "clip_value must be a number above 0, or a schedule 'FIRST>LAST' of two such numbers or None, not 0."),
        (["train", "ppo", "--env", "CartPole-v1", "--minibatch-size", "1"], "normalize_advantage needs batches of 2"),
        (["train", "ppo", "--env", "CartPole-v1", "--activation", "x"], "activation must be one of tanh, relu, elu, silu, not 'x'"),
        (["train", "ppo", "--env", "CartPole-v1", "--backend", "envpol"], "There is no backend 'envpol'"),
        (["train", "ppo", "--env", "test_cli:Nothing"], "test_cli:Nothing cannot be found: test_cli has no Nothing."),
        (["train", "ppo,sac", "--env", "CartPole-v1"], "Algorithms are compared over several seeds: add --seeds 1-5."),
        (["train", "ppo", "--seeds", "1-2", "--processes", "2"], "--processes is for one run, and not for a sweep"),
        (["train", "ppo", "--seeds", "1-2", "--storage", "d"], "--storage is for one run, and not for a sweep"),
        (["tune", "ppo", "--search", "clip=0.1|0.2", "--storage", "d"], "--storage is for one run, and not for a search"),
        (["train", "ppo", "--seeds", "1-2", "--seed", "3"], "Several runs have several seeds: --seeds 1-5, not --seed."),
        (["evaluate", "nowhere"], "nowhere is not a run directory: it does not exist."),
        (["evaluate", "nowhere", "--episods", "3"], "There is no option '--episods': did you mean --episodes?"),
        (["train", "./mine.py", "--env", "CartPole-v1"], "There is no algorithm './mine.py'"),
        (["train", "ppo", "--env", ""], "There is no environment ''"),
        (["train", "ppo", "--env", "CartPole-v1", "--preset", ""], "There is no preset ''"),
        (["train", "ppo", "--scale-rewards", "false"], "a switch has no value: --flag or --no-flag."),
        (["envs", "nowhere"], "There is no environment 'nowhere'"),
        (["evaluate", "nowhere", "--env-args", "x"], "--env-args must be a JSON object"),
        (["evaluate", "nowhere", "again"], "Unknown argument 'again'"),
        (["resume", "nowhere"], "nowhere is not a run directory"),
        (["check", "CartPole-v1", "--backend", "foo"], "There is no backend 'foo'"),
        (["watch"], "Watch what? lemniscate watch RUN; before training, lemniscate watch --random --env ID."),
        (["watch", "--env", "CartPole-v1"], "Watch what?"),
        (["watch", "--random", "--env", "CartPole-v1"], "There is no display for a window; record a video instead"),
        (["check", "test_cli:Broken", "--env-args", "x"], "--env-args must be a JSON object"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_and_exit_code_2(capsys, monkeypatch, arguments, said):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert len(err.strip().splitlines()) == 1


def test_the_film_of_an_evaluation_shows_the_episodes_whose_figures_are_printed(run, capsys, tmp_path):
    evaluation = ["evaluate", str(run), "--episodes", "3", "--json", "--video", str(tmp_path / "video.gif")]
    assert main(evaluation) == 0
    lengths = json.loads(capsys.readouterr().out)["lengths"]
    assert len(lengths) == 3
    with Image.open(tmp_path / "video.gif") as video:  # equal frames are merged into longer ones
        seconds = sum(video.seek(i) or video.info["duration"] for i in range(video.n_frames)) / 1000
    assert seconds == pytest.approx((sum(lengths) + 3) / 50)


class Sometimes(Broken):
    """Has a measure that it never gives."""

    def step(self, action):
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, {"is_success": np.nan}


def test_a_measure_without_rows_is_null(tmp_path, capsys):
    assert main(["train", "ppo", "--env", "test_cli:Sometimes", *TINY, "--run", str(tmp_path / "run")]) == 0
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "2", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert scores["is_success"] is None


def test_a_random_policy_needs_no_run(capsys, tmp_path):
    words = ["watch", "--random", "--env", "CartPole-v1", "--episodes", "3", "--video", str(tmp_path / "video.gif")]
    assert main(words) == 0
    said = capsys.readouterr().err.splitlines()
    lengths = [int(line.rpartition(" ")[2]) for line in said[:3]]
    assert said[:3] == [f"Episode {i + 1}: return {n:.1f}, length {n}" for i, n in enumerate(lengths)]
    assert said[3].startswith(f"{np.mean(lengths):.1f} ± {np.std(lengths):.1f} return over 3 episodes of CartPole-v1")
    assert said[4] == f"Recorded in {tmp_path / 'video.gif'}."


def test_check_is_a_list_and_a_verdict(capsys):
    wrapper = "gymnasium.wrappers:TimeLimit(max_episode_steps=7)"
    assert main(["check", "CartPole-v1", "--env-args", '{"sutton_barto_reward": true}', "--wrappers", wrapper]) == 0
    said = capsys.readouterr().err.splitlines()
    assert {line[:2] for line in said[:-1]} <= {"✓ ", "! ", "  "}
    assert "Served by gymnasium" in said[0]
    assert said[-1].startswith("CartPole-v1 is suitable for training")
    assert main(["check", "test_cli:number"]) == 2
    assert "test_cli:number cannot be made: it makes an int, not a gymnasium.Env" in capsys.readouterr().err


def number():
    return 3


def test_an_episode_is_filmed(run, capsys):
    video = run / "videos" / "episode.gif"
    assert main(["watch", str(run), "--video", str(video)]) == 0
    assert video.stat().st_size > 5000


@pytest.mark.filterwarnings("ignore:.*NaN value")
def test_a_nan_is_told_with_what_it_means_for_the_run(tmp_path, capsys, monkeypatch):
    train = ["train", "ppo", "--env", "test_cli:Broken", *TINY, "--run"]
    assert main([*train, str(tmp_path / "whole")]) == 0
    monkeypatch.setattr(Broken, "broken", True)
    assert main([*train, str(tmp_path / "broken")]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("The reward of environment 0 is nan")
    assert said.endswith(" Training stopped; the last checkpoint is as it was.")
    assert main(["evaluate", str(tmp_path / "whole")]) == 1
    assert "Training stopped" not in capsys.readouterr().err.splitlines()[-1]


def test_a_seed_below_zero_is_a_sentence(run, capsys):
    for command in ("watch", "evaluate"):
        assert main([command, str(run), "--seed", "-1"]) == 2
        assert "seed must be a whole number at least 0, not -1." in capsys.readouterr().err


def test_numbers_are_read_as_in_training(run, capsys):
    assert main(["evaluate", str(run), "--episodes", "2e0", "--seed", "1_0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2
    assert main(["evaluate", str(run), "--episodes", "x"]) == 2
    assert "episodes must be a whole number from 1 to 1,000,000, not 'x'." in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_a_sentence(run, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert main(["watch", str(run), "--video", str(tmp_path / "file" / "video.gif")]) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'file' / 'video.gif'} cannot be written: {tmp_path / 'file'} is a file." in said


def test_a_film_that_cannot_be_written_is_a_sentence(run, capsys):
    assert main(["watch", str(run), "--video", str(run / "video.avi")]) == 2
    assert "must end in .gif, .webp or .mp4" in capsys.readouterr().err


CHEETAH, DRONE = (["train", "ppo", "--env", name] for name in ("HalfCheetah-v5", "DroneFigureEightTrajectory-v0"))


@pytest.mark.parametrize(
    ("words", "busy", "set_to"),
    [
        (CHEETAH, 0.0, "20000"),
        (CHEETAH, 60.0, "100"),
        (DRONE, 0.0, None),
        (DRONE, 60.0, "100"),
        (["resume", "x"], 0.0, None),
    ],
)
def test_threads_wait_briefly_and_hardly_where_the_cores_are_busy(words, busy, set_to, monkeypatch):
    monkeypatch.setenv("GOMP_SPINCOUNT", "of a moment")  # so that it is taken away afterwards
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setattr("psutil.cpu_percent", lambda interval, percpu: [100.0, busy, busy])
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {1, 2})
    give_way(words)
    assert os.environ.get("GOMP_SPINCOUNT") == set_to


def test_what_ends_in_a_moment_does_not_count_as_busy(monkeypatch):
    monkeypatch.setenv("GOMP_SPINCOUNT", "of a moment")
    monkeypatch.delenv("GOMP_SPINCOUNT")
    looks = iter([[90.0, 90.0], [80.0, 60.0], [5.0, 10.0]])
    monkeypatch.setattr("psutil.cpu_percent", lambda interval, percpu: next(looks))
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 1})
    give_way(CHEETAH)
    assert os.environ["GOMP_SPINCOUNT"] == "20000"


def test_what_a_user_says_of_waiting_threads_stays(monkeypatch):
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    monkeypatch.setattr("psutil.cpu_percent", lambda interval, percpu: [100.0] * 512)
    give_way(CHEETAH)
    assert os.environ["GOMP_SPINCOUNT"] == "7"


def test_the_cores_are_looked_at_before_torch_is_imported():
    code = "import psutil; psutil.cpu_percent = lambda interval, percpu: [100] * 512; from lemniscate.cli import main; import os, sys"
    code += "; main(['train', 'ppo', '--nonsense']); print(os.environ['GOMP_SPINCOUNT'], 'torch' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["100", "True"]


def test_a_name_that_is_too_long_is_said_to_be_that(capsys):
    for command in ("evaluate", "resume", "plot"):
        assert main([command, "a" * 300]) == 2
        said = capsys.readouterr().err
        assert "has a name of more than 255 bytes" in said
        assert "at_home" not in said


def test_a_backend_of_ones_own_takes_arguments_of_the_environment(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")
    sizes = ["--num-envs", "4", "--num-steps", "16", "--minibatch-size", "64", "--total-steps", "64"]
    words = ["train", "ppo", "--env", "Glide-v0", "--backend", "own_simulator:Glide", "--env-args", '{"x": 1}', *sizes]
    assert main([*words, "--run", str(tmp_path / "run")]) == 0, capsys.readouterr().err
