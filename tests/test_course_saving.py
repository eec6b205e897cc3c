"""Checkpoints of one's own: whole ones pass, what is missing is named."""

import pytest
import torch

from course_findings import says
from lemniscate import course


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
    assert "obs_rms.count" in course.check(loader("count"), "load_model").sentence
    says(loader("agent"), "load_model", "agent.load_state_dict is missing")
    says(loader("optimizer"), "load_model", "optimizer.load_state_dict is missing")
    says(loader("statistics"), "load_model", "the mean of the environments is not the file's")
    says(loader(scale=0.5), "load_model", "it is the standard deviation")
