"""Checkpoints of one's own: whole ones pass, what is missing is named."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.wrappers.utils import RunningMeanStd

from course_findings import Solutions, passes_from_a_file, says
from lemniscate import course

ALL = Solutions()
is_right, is_wrong = ALL.is_right, ALL.is_wrong


def rms(envs):
    while not hasattr(envs, "obs_rms"):
        envs = envs.env
    return envs.obs_rms


def to_cpu(value):
    if isinstance(value, dict):
        return {name: to_cpu(part) for name, part in value.items()}
    return value.cpu() if isinstance(value, torch.Tensor) else value


def content(agent, optimizer, train_envs):
    return {
        "model_state_dict": to_cpu(agent.state_dict()),
        "optim_state_dict": to_cpu(optimizer.state_dict()),
        "obs_mean": torch.as_tensor(rms(train_envs).mean),
        "obs_var": torch.as_tensor(rms(train_envs).var),
        "obs_count": float(rms(train_envs).count),
    }


def saver(change=lambda saved, agent, optimizer, envs: saved):
    def save_model(agent, optimizer, train_envs, path, save=True):
        torch.save(change(content(agent, optimizer, train_envs), agent, optimizer, train_envs), path)

    return save_model


def without(*names):
    return lambda saved, *_: {name: part for name, part in saved.items() if name not in names}


def with_(**parts):
    return lambda saved, *given: {**saved, **{name: part(*given) for name, part in parts.items()}}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without("model_state_dict"), "agent.state_dict() is missing"),
        (without("optim_state_dict"), "optimizer.state_dict() is missing"),
        (without("obs_mean"), "the mean of the observations is not in the file"),
        (without("obs_var"), "the variance of the observations is not in the file"),
        (with_(obs_var=lambda agent, optimizer, envs: torch.as_tensor(rms(envs).var).sqrt()), "the standard deviation"),
        (with_(model_state_dict=lambda agent, *_: agent), "pickled whole"),
        (with_(optim_state_dict=lambda agent, *_: torch.optim.AdamW(agent.parameters()).state_dict()), "moments"),
        (lambda saved, *_: list(saved.values()), "the file holds a list"),
    ],
)
def test_a_checkpoint_has_all_that_a_later_run_needs(change, words):
    says(saver(change), "save_model", words)


def test_a_whole_checkpoint_passes_and_what_may_surprise_is_noted():
    assert str(course.check(saver(), "save_model")) == "✓ save_model: right."
    assert "obs_rms.count" in course.check(saver(without("obs_count")), "save_model").sentence
    arrays = with_(obs_mean=lambda *given: rms(given[2]).mean, obs_var=lambda *given: rms(given[2]).var)
    noted = course.check(saver(arrays), "save_model")
    assert noted
    assert "weights_only=False" in noted.sentence


def nested(saved, agent, optimizer, envs):
    """Dictionaries in dictionaries."""
    networks = {"agent": saved["model_state_dict"], "optimizer": saved["optim_state_dict"]}
    return {"networks": networks, "norm": {"mean": saved["obs_mean"], "var": saved["obs_var"], "n": saved["obs_count"]}}


def test_a_checkpoint_may_have_dictionaries_in_it_or_the_statistics_as_they_are():
    assert str(course.check(saver(nested), "save_model")) == "✓ save_model: right."
    whole = saver(with_(obs_mean=lambda *given: rms(given[2]), obs_var=lambda *_: 0, obs_count=lambda *_: 0))
    assert "weights_only=False" in course.check(whole, "save_model").sentence
    assert "obs_rms.count" not in course.check(whole, "save_model").sentence


def test_tensors_of_a_checkpoint_that_were_not_moved_to_the_cpu_are_noted():
    def nothing(agent, optimizer, train_envs, path):
        statistics = rms(train_envs)
        saved = {"model_state_dict": agent.state_dict(), "optim_state_dict": optimizer.state_dict()}
        torch.save({**saved, "mean": torch.as_tensor(statistics.mean), "var": torch.as_tensor(statistics.var)}, path)

    def the_agent_alone(agent, optimizer, train_envs, path):
        statistics = rms(train_envs)
        saved = {"model_state_dict": to_cpu(agent.state_dict()), "optim_state_dict": optimizer.state_dict()}
        torch.save({**saved, "mean": torch.as_tensor(statistics.mean), "var": torch.as_tensor(statistics.var)}, path)

    for save_model in (nothing, the_agent_alone):
        finding = course.check(save_model, "save_model")
        assert finding
        assert "Note: not every tensor of agent and optimizer was moved by .cpu()" in finding.sentence


def loader(*leave_out, scale=1.0):
    def load_model(agent, optimizer, train_envs, path):
        saved = torch.load(path, weights_only=True, map_location="cpu")
        if "agent" not in leave_out:
            agent.load_state_dict(saved["model_state_dict"])
        if "optimizer" not in leave_out:
            optimizer.load_state_dict(saved["optim_state_dict"])
        statistics = rms(train_envs)
        if "statistics" not in leave_out:
            statistics.mean, statistics.var = saved["obs_mean"].numpy(), saved["obs_var"].numpy() ** scale
        if "count" not in leave_out:
            statistics.count = saved["obs_count"]

    return load_model


def test_what_was_saved_is_loaded():
    assert str(course.check(loader(), "load_model")) == "✓ load_model: right."
    says(loader("count"), "load_model", "(obs_rms.count) is not the file's: training that goes on would forget")
    says(loader("agent"), "load_model", "agent.load_state_dict is missing")
    says(loader("optimizer"), "load_model", "load_state_dict is missing")
    says(loader("statistics"), "load_model", "the mean of the environments is not the file's")
    says(loader(scale=0.5), "load_model", "it is the standard deviation")


# --- in other styles ---

for change in (nested, without("obs_count")):
    is_right("save_model")(saver(change))


@is_right("save_model")
def save_lists(model, opt, env, filename):
    statistics = {
        "mean": env.env.obs_rms.mean.tolist(),
        "var": env.env.obs_rms.var.tolist(),
        "n": env.env.obs_rms.count,
    }
    torch.save({"net": model.state_dict(), "opt": opt.state_dict(), "statistics": statistics}, filename)


@is_right("save_model")
def save_bare(agent, optimizer, train_envs, path):
    """For a `Path`."""
    path.parent.mkdir(exist_ok=True, parents=True)
    torch.save({"a": agent.state_dict(), "o": optimizer.state_dict(), "rms": train_envs.env.obs_rms, "epoch": 3}, path)


@is_right("save_model")
def save_parts(netz, verfahren, welten, pfad):
    """Networks apart, the standard deviation by its name."""
    weights = {"actor": netz["actor"].state_dict(), "critic": netz["critic"].state_dict()}
    statistics = {"obs_mean": rms(welten).mean, "obs_std": np.sqrt(rms(welten).var), "n": np.int64(rms(welten).count)}
    with open(pfad, "wb") as file:  # noqa: PTH123  (the path is a text)
        torch.save({**weights, "optim": verfahren.state_dict(), **statistics}, file)


@is_right("save_model")
def save_deep(*given):
    """For two wrappers around the normalizer; weights of a wrapped module; a tuple."""
    agent, optimizer, train_envs, path = given
    statistics = train_envs.env.env.obs_rms
    weights = {f"module.{name}": weight.cpu().clone() for name, weight in agent.state_dict().items()}
    numbers = statistics.mean, statistics.var, statistics.count
    torch.save({"state": {"model": weights, "optimizer": optimizer.state_dict()}, "normalizer": numbers}, path)


@is_right("save_model")
def save_if_asked(agent, optimizer, train_envs, path, save):
    if save:
        saver()(agent, optimizer, train_envs, path)


@is_wrong("save_model", "there is no file")
def save_unasked(agent, optimizer, train_envs, path, save=False):
    save_if_asked(agent, optimizer, train_envs, path, save)


@is_right("save_model")
def save_one_tensor(agent, optimizer, train_envs, path):
    saved, statistics = content(agent, optimizer, train_envs), rms(train_envs)
    numbers = torch.as_tensor(np.stack([statistics.mean, statistics.var]))
    torch.save({**without("obs_mean", "obs_var")(saved), "obs_mean_and_var": numbers}, path)


class Trainer:
    """Methods that call each other."""

    def __init__(self, config):
        self.load = config["load"]

    def content(self, *given):
        return content(*given)

    def save_model(self, agent, optimizer, train_envs, path):
        torch.save(self.content(agent, optimizer, train_envs), path)

    def load_model(self, agent, optimizer, train_envs, path):
        loader()(agent, optimizer, train_envs, path)


is_right("save_model")(Trainer.save_model)
is_right("load_model")(Trainer.load_model)


for words, change in {
    "critic.weight is not in the file": with_(model_state_dict=lambda a, *_: {"actor": a["actor"].state_dict()}),
    "not those of the agent": lambda saved, agent, *_: (
        saved | {"model_state_dict": {k: 0 * v for k, v in agent.state_dict().items()}}
    ),
    "the weights are not in": with_(model_state_dict=lambda agent, *_: list(agent.parameters())),
    "the optimizer is not in": with_(optim_state_dict=lambda agent, optimizer, envs: optimizer.state_dict()["state"]),
    "pickled whole": lambda saved, agent, *_: agent,
    "holds a Tensor": lambda saved, agent, *_: agent["actor"].weight.detach(),
    "obs_var in the file is the mean": with_(
        obs_mean=lambda *given: torch.as_tensor(rms(given[2]).var),
        obs_var=lambda *given: torch.as_tensor(rms(given[2]).mean),
    ),
    "the mean of the obs": with_(obs_mean=lambda agent, optimizer, envs: envs.reset()[0].mean(0)),
    "of the observations is not": with_(obs_mean=lambda *_: "0.1", obs_var=lambda *_: None),
    "it raised AttributeError": with_(obs_mean=lambda agent, optimizer, envs: envs.unwrapped.obs_rms.mean),
    "object has no attribute 'obs_rms'": with_(obs_mean=lambda agent, optimizer, envs: envs.obs_rms.mean),
    "it raised SystemExit": lambda *_: exit(),
}.items():
    is_wrong("save_model", words)(saver(change))
is_wrong("save_model", "there is no file")(lambda agent, optimizer, train_envs, path: torch.save({}, f"{path}.pth"))
is_wrong("save_model", "cannot read the file")(lambda agent, optimizer, train_envs, path: Path(path).touch())


@is_right("load_model")
def load_in_place(path, agent, optimizer=None, envs=None, device="cpu"):
    saved = torch.load(path, map_location=device, weights_only=False)
    agent.load_state_dict(saved["model_state_dict"], strict=True)
    optimizer.load_state_dict(saved["optim_state_dict"])
    envs.env.obs_rms.mean[:], envs.env.obs_rms.var[:] = saved["obs_mean"], saved["obs_var"]
    envs.env.obs_rms.count = float(saved["obs_count"])
    return agent, optimizer


@is_right("load_model")
def load_bare(netz, verfahren, welten, datei):
    """For a `Path`, and two wrappers."""
    with datei.open("rb") as file:
        saved = torch.load(file)
    with torch.no_grad():
        for name, weight in netz.named_parameters():
            weight.copy_(saved["model_state_dict"][name])
    verfahren.load_state_dict(saved["optim_state_dict"])
    statistics = welten.env.env.obs_rms
    statistics.mean, statistics.var = saved["obs_mean"].numpy(), saved["obs_var"].numpy()
    statistics.count = saved["obs_count"]


@is_right("load_model")
def load_new(agent, optimizer, train_envs, path):
    saved = torch.load(path)
    agent.load_state_dict(saved["model_state_dict"])
    optimizer.load_state_dict(saved["optim_state_dict"])
    statistics = RunningMeanStd(shape=saved["obs_mean"].shape)
    vars(statistics).update(mean=saved["obs_mean"].numpy(), var=saved["obs_var"].numpy(), count=saved["obs_count"])
    while not hasattr(train_envs, "obs_rms"):
        train_envs = train_envs.env
    train_envs.obs_rms = statistics


def load_and(change):
    def load_model(agent, optimizer, train_envs, path):
        loader()(agent, optimizer, train_envs, path)
        change(agent, optimizer, train_envs, rms(train_envs))

    return load_model


for words, solution in {
    "the variance of the environments": load_and(lambda a, o, e, r: setattr(r, "var", r.mean)),
    "it is the variance": load_and(lambda a, o, e, r: vars(r).update(mean=r.var, var=r.mean)),
    "the agent's weights": load_and(lambda a, o, e, r: [weight.data.zero_() for weight in a["critic"].parameters()]),
    "or learning rate are not the file": load_and(lambda a, o, e, r: o.param_groups[0].update(lr=1e-4)),
    "the optimizer's moments or": load_and(lambda a, o, e, r: o.state.clear()),
    "not set in the wrapper": lambda agent, optimizer, train_envs, path: loader()(
        agent, optimizer, copy.deepcopy(train_envs), path
    ),
    "agent.load_state_dict": lambda agent, optimizer, train_envs, path: loader()(
        copy.deepcopy(agent), optimizer, train_envs, path
    ),
    "the file's. Likely: load_state_dict": lambda agent, path: agent.load_state_dict(
        torch.load(path)["model_state_dict"]
    ),
    "load_state_dict is missing": lambda agent, optimizer, train_envs, path: torch.load(path),
    "it raised FileNotFoundError": lambda agent, optimizer, train_envs, path: torch.load(path + ".pt"),
    "it raised KeyError": load_and(lambda a, o, e, r: a.load_state_dict({}["model"])),
    "it raised SystemExit": load_and(lambda *_: exit()),
}.items():
    is_wrong("load_model", words)(solution)


@pytest.mark.parametrize(("name", "solution"), ALL.right)
def test_a_right_one_in_another_style_passes(name, solution):
    passes_from_a_file(solution, name)


@pytest.mark.parametrize(
    ("name", "solution", "words"), ALL.wrong, ids=[f"{name}-{words}" for name, _, words in ALL.wrong]
)
def test_another_mistake_is_named(name, solution, words):
    says(solution, name, words)
