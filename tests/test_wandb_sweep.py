"""The sweeps of W&B on the pages: the command that its agent would start is understood, and logs what it is judged by."""

import re
import sys
from pathlib import Path

import pytest
import yaml

from lemniscate.cli import main, parse
from lemniscate.run.metrics import read_metrics
from run.test_loggers import FakeWandb

DOCS = Path(__file__).parents[1] / "docs"
PAGES = ("scale.md", "courses.md")


def sweep_of(page):
    block = re.search(r"```yaml\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)
    return yaml.safe_load(block[1])


def agent_command(sweep, which):
    """The command for the first or the last values of all parameters, as the agent writes them: --name=value."""
    values = {name: p.get("values") or [p["min"], p["max"]] for name, p in sweep["parameters"].items()}
    arguments = [f"--{name}={of[which]}" for name, of in values.items()]
    words = []
    for word in sweep["command"]:
        words += arguments if word == "${args}" else [sweep["program"] if word == "${program}" else word]
    return words


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("which", [0, -1])
def test_the_agent_starts_what_is_understood(page, which):
    sweep = sweep_of(page)
    program, *words = agent_command(sweep, which)
    assert program == "lemniscate"
    given = parse(words)
    named = {name.replace("-", "_") for name in sweep["parameters"]}
    assert named <= set(given.fields)
    assert given.track == "wandb"


@pytest.mark.long
def test_an_agent_on_a_machine_without_a_network_logs_the_metric_that_runs_are_judged_by(tmp_path, monkeypatch):
    fake = FakeWandb(has_key=False, reachable=False)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr("lemniscate.api.options.is_installed", lambda package: True)
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    sweep = sweep_of("scale.md")
    _, *words = agent_command(sweep, 0)
    small = ["--env", "CartPole-v1", "--preset", "default", "--total-steps", "512", "--evaluate-every", "256"]
    small += ["--num-envs", "4", "--num-steps", "64", "--evaluate-episodes", "2", "--run", str(tmp_path / "r")]
    assert main([*words, *small]) == 0
    assert fake.started[0]["mode"] == "offline"
    judged_by = sweep["metric"]["name"]
    assert [row[judged_by] for _, row in fake.said if judged_by in row]
    assert any(judged_by in line for line in read_metrics(tmp_path / "r"))
    assert fake.started[0]["config"]["minibatch_size"] == 256
