"""An export of a run: its files, what they say, and what is refused."""

import hashlib
import json
import re
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from exported import needs_compiler, policy_for

import environments  # noqa: F401  (registers the environments)
import lemniscate as lem
from conftest import tiny_fields
from lemniscate.algos import ppo
from lemniscate.api.policy import TrainedPolicy
from lemniscate.cli import main
from lemniscate.drones.vehicle import interface_of
from lemniscate.envs import registry
from lemniscate.envs.backend import Interface
from lemniscate.envs.check import BAD
from lemniscate.errors import UserError
from lemniscate.exporting import compiled, parity
from lemniscate.exporting import export as exporting
from lemniscate.exporting.c_code import c_files
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.deployed import Deployed, act_with, input_size
from lemniscate.exporting.export import acted, observed, ranges
from lemniscate.exporting.parity import fly
from lemniscate.exporting.translation import translate
from lemniscate.spec import Box, ObservationPart, Spec


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "run"
    fields = {**tiny_fields("CartPole-v1"), "normalize_observations": True}
    lem.train("ppo", env="CartPole-v1", run=path, progress=False, **fields)
    return path


@pytest.fixture
def few(monkeypatch):
    """Exports that are compared at 200 observations."""
    monkeypatch.setattr(exporting, "fly", partial(fly, rows=200))
    monkeypatch.setattr(parity, "nanoseconds", lambda call: call() is None or 1.0)


@pytest.fixture
def same(run, monkeypatch):
    """Exports that all have the same content, which is there at once."""
    contents = {name: name.encode() for name in ("policy.c", "policy.h", "parity.json")}
    monkeypatch.setattr(exporting, "_contents", lambda policy, program: (contents, {"export": 1}, []))


@needs_compiler
def test_an_export_is_whole_and_acts_as_the_policy_does(run, tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    assert main(["export", str(run), "--to", str(tmp_path / "e")]) == 0
    files = {file.name: file.read_bytes() for file in (tmp_path / "e").iterdir()}
    assert set(files) == {"policy.c", "policy.h", "policy.onnx", "parity.json", "manifest.json"}
    manifest, record = json.loads(files["manifest.json"]), json.loads(files["parity.json"])
    named = {name: hashlib.sha256(content).hexdigest() for name, content in files.items() if name != "manifest.json"}
    assert manifest["files"] == named
    assert (manifest["environment"], manifest["algorithm"], manifest["step"]) == ("CartPole-v1", "ppo", 256)
    assert manifest["lemniscate"] == lem.__version__
    assert [entry["name"] for entry in manifest["observations"]] == [f"obs[{i}]" for i in range(4)]
    assert manifest["actions"] == [{"index": 0, "name": "action", "unit": None, "frame": None, "range": [0, 1]}]
    assert record["acting"] == "policy.c"
    assert record["observations"] >= 10_000
    compared = [
        record["onnx"],
        record["c_host"],
        *([] if compiled.missing_target_tools() else [record["c_cortex_m4f"]]),
    ]
    assert all(each["max_abs_difference"] <= 1e-5 for each in compared)
    assert record["c_host"]["self_test"] <= 1e-5
    assert record["ns_per_action"]["c"] < record["ns_per_action"]["torch"]
    said = capsys.readouterr().err
    assert "C is exact at 10," in said
    assert said.endswith(f"Everything is in {tmp_path / 'e'}\n")


def test_onnx_takes_a_raw_observation_and_any_number_of_them(run, tmp_path, few):
    runtime = pytest.importorskip("onnxruntime")
    folder = lem.export(run, tmp_path / "e")
    session = runtime.InferenceSession(folder / "policy.onnx")
    obs = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    (actions,) = session.run(["action"], {"obs": obs})
    assert actions.dtype == np.int64
    assert np.array_equal(actions, lem.load(run).act(obs))
    assert session.get_modelmeta().custom_metadata_map["environment"] == '"CartPole-v1"'


def test_it_is_in_the_run_by_default_and_replaces_an_export_only(run, same, tmp_path):
    assert lem.export(run) == run / "export"
    (run / "export" / "policy.c").write_text("broken")
    lem.export(str(run))
    assert "broken" not in (run / "export" / "policy.c").read_text()
    (checkpoint,) = list(run.glob("checkpoints/step-*"))[-1:]
    assert lem.export(checkpoint) == run / "export"  # a checkpoint is removed, and all in it
    assert sorted(file.name for file in run.iterdir() if file.name.startswith("export")) == ["export"]
    assert not [finding for finding in lem.check(run) if finding.grade == BAD]
    for name in ("notes", "link"):
        (tmp_path / "notes").mkdir(exist_ok=True)
        (tmp_path / "notes" / "mine.txt").write_text("mine")
        if name == "link":
            (tmp_path / "link").symlink_to(run / "export")
        with pytest.raises(lem.UserError, match="exists already, and is no export; choose another directory"):
            lem.export(run, tmp_path / name)
    assert (tmp_path / "notes" / "mine.txt").read_text() == "mine"


def test_a_disk_that_is_full_leaves_the_export_that_was_there(run, tmp_path, same, monkeypatch):
    folder = lem.export(run, tmp_path / "e")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}

    def full(path, content):
        if path.name == "parity.json":
            raise OSError(28, "No space left on device")
        path.write_bytes(content)

    monkeypatch.setattr(exporting, "replace_file", full)
    with pytest.raises(lem.UserError, match="cannot be written: No space left on device"):
        lem.export(run, folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    with pytest.raises(lem.UserError, match="cannot be written"):
        lem.export(run, tmp_path / "new")
    assert [file.name for file in tmp_path.iterdir()] == ["e"]


def test_what_is_not_installed_is_said_and_left_out(run, tmp_path, few, monkeypatch, capsys):
    monkeypatch.setattr(exporting, "host_compiler", lambda: None)
    for module in (exporting, parity):
        monkeypatch.setattr(module, "is_installed", lambda package: False)
    monkeypatch.setattr(compiled, "missing_target_tools", lambda: [compiled.TARGET_COMPILER, compiled.EMULATOR])
    folder = lem.export(run, tmp_path / "e")
    record = json.loads((folder / "parity.json").read_text())
    assert record["onnx"] is record["c_host"] is record["c_cortex_m4f"] is None
    assert record["acting"] == "the policy itself"
    assert not (folder / "policy.onnx").exists()
    assert (folder / "policy.c").exists()
    said = capsys.readouterr().err
    assert all(sentence in said for sentence in record["missing"])
    assert len(record["missing"]) == 4
    assert "pip install '.[export]'; policy.onnx is left out." in said
    assert "There is no C compiler here" in said
    assert "arm-none-eabi-gcc is not installed" in said


def test_without_a_compiler_onnx_acts(run, tmp_path, few, monkeypatch):
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(exporting, "host_compiler", lambda: None)
    record = json.loads((lem.export(run, tmp_path / "e") / "parity.json").read_text())
    assert record["acting"] == "policy.onnx"


def compiler(folder, does):
    """A program that stands in for the C compiler, and does what its text says in Python."""
    file = folder / "mycc"
    file.write_text(f"#!{sys.executable}\nimport sys\n{does}\n")
    file.chmod(0o755)
    return str(file)


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ("sys.exit('stdint.h: No such file')", "policy.c is not compared on this machine: .*stdint.h"),
        ("open('policy.so', 'w').write('of another machine')", "What mycc made cannot be loaded here"),
    ],
)
def test_a_compiler_that_makes_nothing_for_this_machine_is_said_and_all_else_is_exported(
    run, tmp_path, few, monkeypatch, does, said
):
    monkeypatch.setenv("CC", compiler(tmp_path, does))
    record = json.loads((lem.export(run, tmp_path / "e") / "parity.json").read_text())
    assert record["c_host"] is None
    assert any(re.search(said, line) for line in record["missing"])
    assert (tmp_path / "e" / "policy.c").exists()


def test_images_and_policies_of_no_run_are_refused(tmp_path):
    image = registry.make("Copy-image-v0", 1)
    config = ppo.Config(env="Copy-image-v0", hidden=(8,))
    policy = TrainedPolicy(config.networks(image.spec), image.spec, config, 0)
    image.close()
    with pytest.raises(lem.UserError, match="A policy for Copy-image-v0 observes images; an export"):
        lem.export(policy, tmp_path / "e")
    steps = Spec("Steps-v0", (ObservationPart((), (3,)),), Box((0.0,), (4.0,), dtype="int64"))
    whole = TrainedPolicy(config.networks(steps), steps, config, 0)
    with pytest.raises(
        lem.UserError, match="Steps-v0 has a Box of integers as actions; an export has one of real numbers"
    ):
        lem.export(whole, tmp_path / "e")
    with pytest.raises(lem.UserError, match="This policy is of no run here: name the directory"):
        lem.export(policy_for())
    with pytest.raises(lem.UserError, match="of no run here"):
        exporting._destination("hf://user/name", policy, None)
    assert list(tmp_path.iterdir()) == []


class Batched(torch.nn.Linear):
    """A network that looks at other rows, and makes nothing of them."""

    def forward(self, x):
        return super().forward(x - 0 * x.mean(0))


def test_a_network_that_cannot_be_translated_is_refused_with_a_sentence(tmp_path, capsys):
    run, fields = tmp_path / "run", {**tiny_fields("CartPole-v1"), "network": "test_export:Batched"}
    lem.train("ppo", env="CartPole-v1", run=run, progress=False, **fields)
    assert main(["export", str(run)]) == 2
    assert capsys.readouterr().err == "This network cannot be exported: mean mixes the observations of a batch.\n"
    assert not (run / "export").exists()


@needs_compiler
@pytest.mark.parametrize("kind", ["box", "discrete", "multi-discrete", "multi-binary", "tuple", "masked"])
def test_in_closed_loop_the_c_does_what_the_policy_does(kind):
    env = registry.make(f"Copy-{kind}-v0", 1)
    config = ppo.Config(env=f"Copy-{kind}-v0", hidden=(8,), normalize_observations=True)
    torch.manual_seed(0)
    policy = TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    policy.module.observe(torch.randn(50, input_size(env.spec)))
    with torch.no_grad():
        policy.module.net[-1].weight.mul_(100)
    env.close()
    program = translate(Deployed(policy).eval(), input_size(env.spec))
    zero = np.zeros((1, program.obs.size)), np.zeros((1, program.action.size))
    host = HostPolicy(c_files(program, env.spec.action, *zero, title="", origin=""), host_compiler(), ("-O0",))
    (flights, interface), (true, _) = (fly(policy, act, rows=300) for act in (host.act, act_with(policy)))
    flown, true = (each.obs.reshape(-1, program.obs.size) for each in (flights, true))
    assert len(flown) >= 300
    assert np.allclose(flown, true, atol=1e-4)
    assert np.abs(host.act(flown) - act_with(policy)(flown)).max() <= 1e-5
    assert len(observed(env.spec, interface)) == flown.shape[1]
    assert len(acted(env.spec.action, Interface())) == len(ranges(env.spec.action)) == program.action.size


@needs_compiler
def test_wrappers_that_are_not_in_the_files_are_named(tmp_path, few, capsys):
    """In the message, the manifest, the header, and the metadata of ONNX; an export without wrappers has no such word."""
    wrappers = ("environments:PlusOne", "environments:PlusOne(by=0.5)")
    for name, given in (("bare", ()), ("wrapped", wrappers)):
        env = registry.make("Copy-box-v0", 1, wrappers=given)
        env.close()
        config = ppo.Config(env="Copy-box-v0", hidden=(8,), wrappers=given)
        folder = lem.export(TrainedPolicy(config.networks(env.spec), env.spec, config, 0), tmp_path / name)
        manifest, header = json.loads((folder / "manifest.json").read_text()), (folder / "policy.h").read_text()
        assert manifest["wrappers"] == list(given)
        assert ("NOT IN THIS FILE" in header) == bool(given)
        assert ("NOT in the files" in capsys.readouterr().err) == bool(given)
    assert "environments:PlusOne, environments:PlusOne(by=0.5)" in header
    if onnx := pytest.importorskip("onnx"):
        facts = {prop.key: prop.value for prop in onnx.load(folder / "policy.onnx").metadata_props}
        assert json.loads(facts["wrappers"]) == list(wrappers)


def test_observations_without_units_have_the_names_of_their_parts():
    def names(kind):
        env = registry.make(f"Copy-{kind}-v0", 1)
        env.close()
        return [quantity.name for quantity in observed(env.spec, Interface())]

    assert names("discrete") == ["obs=5", "obs=6", "obs=7"]
    assert names("multi-discrete") == ["obs[0]=0", "obs[0]=1", "obs[1]=0", "obs[1]=1", "obs[1]=2"]
    assert names("tuple") == ["0=0", "0=1", "1/a", "1/z[0]", "1/z[1]", "1/z[2]"]
    assert names("masked")[3:] == [f"action_mask[{i}]" for i in range(4)]


def test_drones_have_units_and_frames():
    trajectory, offsets = np.zeros((500, 3)), np.arange(0, 50, 5)
    sim = SimpleNamespace(drone="cf2x_L250", control="attitude", dynamics="so_rpy")
    env = SimpleNamespace(freq=50, sim=sim, trajectory=trajectory, sample_offsets=offsets)
    interface = interface_of(env, ["so_rpy", "first_principles"], (0.0, 0.02), 2)
    assert (interface.period, interface.vehicle, interface.dynamics[1]) == (0.02, "crazyflie", "first_principles")
    assert (interface.delay, interface.history, len(interface.parts["history"])) == ((0.0, 0.02), 2, 2 * 17)
    assert interface.parts["history"][17].name == "position_x_2_steps_ago_less_now"
    assert {name: len(part) for name, part in interface.parts.items()}["local_samples"] == 30
    assert interface.parts["local_samples"][5].name == "to_reference_in_0.1s_z"
    assert [quantity.unit for quantity in interface.action] == ["rad", "rad", "rad", "N"]


def test_an_export_gets_a_directory_of_its_own(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"An export gets a directory of its own: name one in ., such as export"):
        lem.export(run, to=".")
