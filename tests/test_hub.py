"""Policies on the Hub: uploaded, loaded, refused. `huggingface_hub` speaks HTTP with a stand-in of the Hub."""

import json
import re
import shutil
import sys
from urllib.parse import unquote

import numpy as np
import pytest
import torch
import yaml
from huggingface_hub import constants
from huggingface_hub.utils import _cache_assets

import hub_server
import lemniscate as lem
import toy
from conftest import tiny_fields
from forks import LEMNISCATE, Forks, command
from lemniscate.cli import main, parse
from lemniscate.hub import repository as hub
from lemniscate.run import checkpoint
from lemniscate.system.files import write_json

pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")  # huggingface_hub's own

NAME = "anna/cart.pole_v1"
ADDRESS = f"hf://{NAME}"


class Own(toy.Countdown):
    """An environment of one's own, which nobody else has."""


def train(path, env="CartPole-v1", **fields):
    return lem.train("ppo", env=env, run=path, progress=False, **tiny_fields(env, **fields))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with figures, a video and an export."""
    run = train(tmp_path_factory.mktemp("hub") / "run")
    for name in ("plots/learning_curve.png", "videos/my flight.gif", "export/policy.onnx", "export/policy.c"):
        (run.path / name).parent.mkdir(parents=True, exist_ok=True)
        (run.path / name).write_bytes(name.encode())
    write_json(run.path / "export" / "manifest.json", {"export": 1, "step": run.policy.step})
    (run.path / "plots" / "report.html").write_text("with paths of this machine")
    (run.path / "export" / "link").symlink_to("/etc/hostname")
    return run


@pytest.fixture(scope="module")
def pushed(run, tmp_path_factory):
    """The files of the run's repository."""
    with hub_server.serving() as server, pytest.MonkeyPatch.context() as patch:
        connect(patch, server.endpoint, tmp_path_factory.mktemp("cache"))
        patch.setenv("HF_TOKEN", hub_server.WRITER)
        lem.push(run, NAME)
        return server.files(NAME)


@pytest.fixture
def server(pushed, monkeypatch, tmp_path):
    """A Hub that has the run's policy, and a user who may write there."""
    with hub_server.serving() as server:
        connect(monkeypatch, server.endpoint, tmp_path / "cache")
        monkeypatch.setenv("HF_TOKEN", hub_server.WRITER)
        store(server, NAME, pushed)
        yield server


def connect(patch, endpoint, cache):
    """Have `huggingface_hub` ask another Hub, keep its files elsewhere, and find no token of this machine's user."""
    patch.setattr(constants, "ENDPOINT", endpoint)
    patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", endpoint + "/{repo_id}/resolve/{revision}/{filename}")
    patch.setattr(constants, "HF_HUB_CACHE", str(cache / "hub"))
    patch.setattr(_cache_assets, "HF_ASSETS_CACHE", str(cache / "assets"))
    patch.setattr(constants, "HF_TOKEN_PATH", str(cache / "token"))
    patch.setattr(constants, "HF_HUB_DISABLE_XET", True)


def store(server, name, files):
    """A repository on the Hub with these files, of one's own or another's; the hash of the commit."""
    repository = server.repositories.setdefault(name, hub_server.Repository(private=False))
    return repository.commit(dict(files))


def downloaded(server):
    """The names of the files that were asked for, other than for their sizes."""
    return {line.rpartition("/")[2] for line in server.asked if line.startswith("GET") and "/resolve/" in line}


def test_what_is_uploaded_is_loaded_again_bit_for_bit(run, pushed, server):
    policy = lem.load(ADDRESS)
    assert (policy.spec, policy.config, policy.step) == (run.policy.spec, run.policy.config, run.policy.step)
    mine, theirs = policy.networks.state_dict(), run.policy.networks.state_dict()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    obs = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    assert np.array_equal(policy.act(obs), run.policy.act(obs))
    assert lem.evaluate(ADDRESS, episodes=3).returns == lem.evaluate(run, episodes=3).returns


def test_a_policy_that_remembers_plays_the_same_episode_from_the_hub(server, tmp_path):
    fields = {"network": "gru", "sequence_length": 8, "num_steps": 16}
    run = lem.train(
        "ppo", "CartPole-v1", run=tmp_path / "gru", progress=False, **{**tiny_fields("CartPole-v1"), **fields}
    )
    lem.push(run, "anna/gru")
    policy = lem.load("hf://anna/gru")
    states = np.random.default_rng(0).normal(size=(30, 4)).astype(np.float32)
    played = [[one.act(obs) for obs in states] for one in (policy, run.policy)]
    assert played[0] == played[1]
    assert len(set(played[0])) == 2
    assert lem.evaluate(policy, episodes=3).returns == lem.evaluate(run, episodes=3).returns


def test_all_is_in_one_commit_that_has_no_path_token_or_pickle(run, pushed):
    shown = {"README.md", "final.json", "plots/learning_curve.png", "videos/my flight.gif"}
    export = {"export/policy.onnx", "export/policy.c", "export/manifest.json"}
    assert set(pushed) == {".gitattributes", *hub.CHECKPOINT, *shown, *export}
    for content in pushed.values():
        assert hub_server.WRITER.encode() not in content
        assert str(run.path.parent).encode() not in content


def test_an_upload_is_one_commit_and_deletes_the_figures_of_the_one_before(run, server):
    before = {**server.files(NAME), "plots/old.png": b"", "replay.mp4": b"", "LICENSE": b"", "notes/mine.md": b""}
    first = store(server, NAME, before)
    assert lem.push(run, NAME) == f"{server.endpoint}/{NAME}"
    commits = [*server.repositories[NAME].commits]
    assert commits[-2] == first
    assert set(before) - set(server.files(NAME)) == {"plots/old.png", "replay.mp4"}


def test_an_export_of_another_step_is_left_out_and_named(run, server, tmp_path, capsys):
    copy = shutil.copytree(run.path, tmp_path / "copy", symlinks=True)
    write_json(copy / "export" / "manifest.json", {"export": 1, "step": 1})
    lem.push(copy, "anna/older")
    assert not [name for name in server.files("anna/older") if name.startswith("export/")]
    assert f"it is left out; lemniscate export {copy}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"private": "yes"}, "private must be True or False, not 'yes'"),
        ({"license": "MIT License\nfoo: bar"}, "license is written as on the Hub, such as 'mit'"),
        ({"license": 3}, "license is written as on the Hub"),
    ],
)
def test_what_a_repository_is_not_is_refused_before_the_hub_is_asked(run, server, options, said):
    with pytest.raises(lem.UserError, match=said):
        lem.push(run, NAME, **options)
    with pytest.raises(lem.UserError, match="name must be a text, not None"):
        lem.push(run, None)
    assert not server.asked


def test_the_card_has_the_scores_for_the_hub_and_for_people(run, pushed):
    card, scores = pushed["README.md"].decode(), json.loads(pushed["final.json"])
    front = yaml.safe_load(card.split("---")[1])
    assert front["library_name"] == "lemniscate"
    assert front["tags"] == ["reinforcement-learning", "lemniscate", "CartPole-v1", "ppo"]
    assert "license" not in front
    (model,) = front["model-index"]
    (metric,) = model["results"][0]["metrics"]
    assert model["name"] == NAME
    assert metric["value"] == f"{scores['mean_return']:.2f} +/- {scores['std_return']:.2f}"
    assert metric["args"] == {"episodes": 100, "seed": 0, "training_seeds": [1]}
    assert f"| {scores['mean_return']:,.1f} ± {scores['std_return']:,.1f} |" in card


def test_the_card_shows_files_that_are_there_and_lines_that_work(run, pushed, server):
    card = pushed["README.md"].decode()
    links = [unquote(link) for link in re.findall(r"\]\(([^)\s]+)\)", card)]
    assert set(links) == {name for name in pushed if "/" in name}
    load, evaluate, train = re.findall(r"```\w*\n(.*?)\n```", card, re.DOTALL)
    scope = {}
    exec(load, scope)
    assert scope["policy"].step == run.policy.step
    assert parse(evaluate.split()[1:]).policy.as_posix() == "hf:/" + NAME
    again = parse(train.split()[1:])
    assert lem.config_for(again.algorithm, again.env, again.preset, **again.fields) == run.policy.config


def test_a_revision_is_loaded_as_it_was(run, server, tmp_path):
    repository = server.repositories[NAME]
    repository.tags["v1"], first = [*repository.commits][-1], lem.load(ADDRESS)
    policy = lem.load(run.path)
    policy.step = 5
    with torch.no_grad():
        next(policy.networks.parameters()).add_(1)
    lem.push(policy, NAME)
    assert lem.load(ADDRESS).step == 5
    for revision in ("v1", repository.tags["v1"]):
        old = lem.load(f"{ADDRESS}@{revision}")
        assert old.step == first.step
        assert torch.equal(next(old.networks.parameters()), next(first.networks.parameters()))


@pytest.mark.parametrize("name", hub.CHECKPOINT)
def test_a_flipped_byte_is_named(pushed, server, name):
    content = bytearray(pushed[name])
    content[len(content) // 2] ^= 1
    store(server, NAME, {**pushed, name: bytes(content)})
    with pytest.raises(lem.UserError, match=rf"^{ADDRESS}: .*{name} (is damaged|has no sha256)"):
        lem.load(ADDRESS)


@pytest.mark.parametrize("name", ["policy.zip", "model.pt", "pytorch_model.bin", "run.py"])
def test_what_may_execute_code_is_not_downloaded(pushed, server, name):
    store(server, "eve/policy", {"README.md": b"", name: b""})
    with pytest.raises(lem.UserError, match=f"has no manifest.json but {name}, which may execute code"):
        lem.load("hf://eve/policy")
    without = {file: content for file, content in pushed.items() if file != "tensors.safetensors"}
    store(server, "eve/policy", {**without, name: b""})
    with pytest.raises(lem.UserError, match=rf"has no tensors.safetensors but {name}"):
        lem.load("hf://eve/policy")
    store(server, "eve/policy", {**pushed, name: b"", "state.pkl": b"", "more/manifest.json": b""})
    assert lem.load("hf://eve/policy").step == 256
    assert downloaded(server) <= set(hub.CHECKPOINT)


def test_a_repository_of_something_else_is_a_sentence(server):
    store(server, "eve/text", {"README.md": b"", "config.json": b"{}", "model.safetensors": b""})
    with pytest.raises(lem.UserError, match=r"holds no policy of lemniscate: it has no manifest\.json"):
        lem.load("hf://eve/text")
    assert not downloaded(server)


@pytest.mark.parametrize(
    ("address", "token", "said"),
    [
        ("hf://anna/none", hub_server.WRITER, "no such repository on the Hub, or you may not read it; `hf auth login`"),
        ("hf://anna/none", "", "no such repository on the Hub, or you may not read it; `hf auth login`"),
        ("hf://anna/secret", "", "no such repository on the Hub, or you may not read it; `hf auth login`"),
        (f"{ADDRESS}@v9", hub_server.WRITER, f"{ADDRESS}@v9: The repository on the Hub has no such revision."),
        (ADDRESS, "hf_old", "The Hub refuses: it does not know your token; log in again with `hf auth login`"),
        ("hf://anna", hub_server.WRITER, "hf://anna is no address of a policy, such as hf://user/name or hf://user/name@revision"),
        ("hf://anna/a/b", hub_server.WRITER, "hf://anna/a/b is no address of a policy"),
        (f"{ADDRESS}@", hub_server.WRITER, f"{ADDRESS}@ is no address of a policy"),
        ("hf://anna/a..b", hub_server.WRITER, "hf://anna/a..b: Cannot have -- or .."),
    ],
)  # fmt: skip
def test_what_cannot_be_loaded_is_a_sentence(server, monkeypatch, capsys, address, token, said):
    server.repositories["anna/secret"] = hub_server.Repository(private=True)
    monkeypatch.setenv("HF_TOKEN", token)
    assert main(["evaluate", address]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_a_private_policy_is_loaded_with_a_token(pushed, server):
    server.repositories["anna/secret"] = hub_server.Repository(private=True)
    store(server, "anna/secret", pushed)
    assert lem.load("hf://anna/secret").step == 256


def test_a_hub_that_cannot_be_reached_is_a_sentence_unless_the_policy_is_here(server, monkeypatch, capsys):
    policy = lem.load(ADDRESS)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert lem.load(ADDRESS).path == policy.path
    with pytest.raises(lem.UserError, match=r"^hf://anna/other: The Hub cannot be reached: .*[Rr]efused\.$"):
        lem.load("hf://anna/other")


@pytest.mark.parametrize(
    ("name", "token", "options", "said"),
    [
        ("anna/new", "", [], "anna/new: To upload, log in with `hf auth login`, or set HF_TOKEN"),
        ("anna/new", hub_server.READER, [], "anna/new: The Hub refuses: your token has no right to it."),
        ("anna/new", "hf_old", [], "anna/new: The Hub refuses: it does not know your token"),
        ("new", hub_server.WRITER, [], "new: A repository on the Hub is named user/name."),
        ("anna/a--b", hub_server.WRITER, [], "anna/a--b: Cannot have -- or .. in repo_id"),
        ("anna/text", hub_server.WRITER, [], "The repository holds no policy of lemniscate but model.bin"),
        (NAME, hub_server.WRITER, ["--private"], "The repository is public already; make it private on its page"),
    ],
)
def test_what_cannot_be_uploaded_is_a_sentence_and_changes_nothing(
    run, server, monkeypatch, capsys, name, token, options, said
):
    store(server, "anna/text", {"README.md": b"", "model.bin": b""})
    before = {name: [*repository.commits] for name, repository in server.repositories.items()}
    monkeypatch.setenv("HF_TOKEN", token)
    assert main(["push", str(run.path), name, *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert {name: [*repository.commits] for name, repository in server.repositories.items()} == before


def test_a_hub_that_is_down_is_a_sentence(run, server, monkeypatch):
    server.status = 503
    with pytest.raises(lem.UserError, match=r"The Hub answers with status 503: down for maintenance\.$"):
        lem.push(run, NAME)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(lem.UserError, match="The Hub cannot be reached"):
        lem.push(run, NAME)


def test_a_run_without_a_policy_is_refused_before_the_hub_is_asked(server, tmp_path):
    with pytest.raises(lem.UserError, match="is not a run directory"):
        lem.push(tmp_path, NAME)
    with pytest.raises(lem.UserError, match=r"Cannot have -- or \.\."):  # the name first: it costs nothing
        lem.push(tmp_path, "anna/a--b")
    assert not server.asked


def test_without_the_extra_a_sentence_names_it(run, server, monkeypatch):
    monkeypatch.setattr(hub, "is_installed", lambda package: False)
    for verb in (lambda: lem.push(run, NAME), lambda: lem.load(ADDRESS)):
        with pytest.raises(lem.UserError, match=r"huggingface_hub is not installed; it comes with the extra hub"):
            verb()


def test_a_repository_can_be_private_and_have_a_license(run, server):
    lem.push(run, "anna/secret", private=True, license="mit")
    assert server.repositories["anna/secret"].private
    assert "\nlicense: mit\n" in server.files("anna/secret")["README.md"].decode()


@pytest.mark.parametrize("field", ["env", "backend", "network", "wrappers"])
def test_each_field_that_names_code_is_looked_at(field):
    named = "theirs:Own"
    assert hub.own_code({"env": "CartPole-v1", field: [named] if field == "wrappers" else named}) == [named]
    assert not hub.own_code({"env": "CartPole-v1", "backend": "envpool", "network": "mlp", "wrappers": []})


def test_code_of_a_downloaded_policy_is_imported_only_with_trust(server, tmp_path, monkeypatch, capsys):
    """And a policy without pictures, video or figures is uploaded, with a line on why."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "theirs.py").write_text("from test_hub import Own\n")
    lem.push(train(tmp_path / "run", "theirs:Own"), "eve/own")
    del sys.modules["theirs"]
    assert "No video: " in capsys.readouterr().err
    files = server.files("eve/own")
    assert set(files) == {".gitattributes", "README.md", "final.json", *hub.CHECKPOINT}
    assert "loaded with `trust=True`: theirs:Own." in files["README.md"].decode()
    for verb in (lem.load, lem.evaluate, lem.watch, lem.export):
        with pytest.raises(
            lem.UserError, match=r"hf://eve/own: The policy would execute code of its own: theirs:Own\."
        ):
            verb("hf://eve/own")
    assert main(["evaluate", "hf://eve/own"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("If you know that code, add --trust (in Python trust=True).")
    assert "theirs" not in sys.modules
    assert lem.load("hf://eve/own", trust=True).step == 256
    assert main(["evaluate", "hf://eve/own", "--episodes", "2", "--trust"]) == 0


@pytest.mark.parametrize("field", ["env", "network", "wrappers", "algorithm"])
def test_every_name_of_code_in_a_downloaded_record_is_asked_for(run, server, tmp_path, field):
    found = checkpoint.read(lem.save(run, tmp_path / "policy"))
    name = "nowhere.evil" if field == "algorithm" else "nowhere:evil"
    at = found.record if field == "algorithm" else found.record["config"]
    at[field] = [name] if field == "wrappers" else name
    checkpoint.write_fields(found.path, {"networks": run.policy.networks, "step": 256}, found.record)
    store(server, "eve/policy", {file.name: file.read_bytes() for file in found.path.iterdir()})
    with pytest.raises(lem.UserError, match=f"would execute code of its own: {name}"):
        lem.load("hf://eve/policy")


def test_a_policy_without_a_run_is_filmed_and_evaluated_now(run, server, capsys):
    lem.push(lem.save(run, run.path.parent / "best"), "anna/best")
    files = server.files("anna/best")
    assert files["videos/episode.gif"].startswith(b"GIF")
    assert json.loads(files["final.json"])["step"] == 256
    assert set(files) == {".gitattributes", "README.md", "final.json", "videos/episode.gif", *hub.CHECKPOINT}


def test_a_video_has_the_name_that_the_hub_plays(run, server, tmp_path):
    video = run.path / "videos" / "newer.mp4"
    video.write_bytes(b"mp4")
    try:
        lem.push(run, "anna/video")
    finally:
        video.unlink()
    assert server.files("anna/video")["replay.mp4"] == b"mp4"
    assert "[Video](replay.mp4)" in server.files("anna/video")["README.md"].decode()


def test_a_run_begins_with_a_policy_on_the_hub(run, server, tmp_path, capsys):
    config = tiny_fields("CartPole-v1", total_steps=32, warm_start=ADDRESS)
    lem.train("ppo", env="CartPole-v1", run=tmp_path / "warm", **config)
    assert f"Warm start: all networks of {ADDRESS} at step 256." in capsys.readouterr().err
    with pytest.raises(lem.UserError, match="no such repository on the Hub"):
        lem.train("ppo", env="CartPole-v1", run=tmp_path / "cold", **{**config, "warm_start": "hf://anna/none"})
    assert not (tmp_path / "cold").exists()


@pytest.mark.parametrize("words", [["plot"], ["resume"], ["train", "ppo", "--env", "CartPole-v1", "--run"]])
def test_a_directory_is_not_an_address(capsys, words):
    assert main([*words, ADDRESS]) == 2
    assert f"{ADDRESS} is on the Hub, and no run directory" in capsys.readouterr().err


@pytest.mark.long
def test_the_commands_speak_with_the_hub_that_the_environment_names(run, server, tmp_path):
    names = {"HF_ENDPOINT": server.endpoint, "HF_HOME": str(tmp_path), "HF_HUB_DISABLE_XET": "1"}
    forks = Forks(LEMNISCATE, HF_TOKEN=hub_server.WRITER, **names)
    try:
        process = command("push", run.path, "anna/new", server=forks)
        assert process.communicate() == (
            "",
            f"Uploaded: {server.endpoint}/anna/new. It is loaded from hf://anna/new.\n",
        )
        process = command("evaluate", "hf://anna/new", "--episodes", "3", "--json", server=forks)
        out, err = process.communicate()
    finally:
        forks.close()
    assert err == ""
    assert json.loads(out)["returns"] == lem.evaluate(run, episodes=3).returns


def test_a_policy_that_is_not_the_newest_is_uploaded_with_its_own_scores(tmp_path, server, monkeypatch):
    monkeypatch.setattr("lemniscate.api.results.FINAL_EPISODES", 5)
    run = train(tmp_path / "run", checkpoint_every=128)
    older = lem.load(run, checkpoint=128)
    lem.push(older, "anna/older")
    scores = json.loads(server.files("anna/older")["final.json"])
    assert scores["step"] == 128
    assert scores["mean_return"] == lem.evaluate(older, episodes=5).mean_return


def test_an_export_without_onnx_is_uploaded_too(tmp_path, server):
    run = train(tmp_path / "run", total_steps=32)
    (run.path / "export").mkdir()
    (run.path / "export" / "policy.c").touch()
    write_json(run.path / "export" / "manifest.json", {"export": 1, "step": run.policy.step})
    lem.push(run, "anna/c")
    assert "export/policy.c" in server.files("anna/c")
