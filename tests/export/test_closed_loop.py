"""Parity in closed loop, at ten thousand observations each: every algorithm, every kind of actions, the drone."""

import json

import pytest
import torch
from exported import needs_compiler

import environments  # noqa: F401  (registers the environments)
import lemniscate as lem
from lemniscate.algos import a2c, ddpg, ppo, pqn, reinforce, reppo, sac, shac, td3, trpo
from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs import registry
from lemniscate.exporting.compiled import missing_target_tools

pytestmark = [pytest.mark.long, needs_compiler]


def test_the_figure_eight_fits_and_flies_on_the_target(tmp_path):
    pytest.importorskip("crazyflow")
    lem.train("ppo", env="DroneFigureEightTrajectory-v0", run=tmp_path / "run", progress=False)
    folder = lem.export(tmp_path / "run")
    manifest, record = (json.loads((folder / name).read_text()) for name in ("manifest.json", "parity.json"))
    assert (folder / "crazyflie" / "policy_controller.c").exists()
    assert manifest["observations"][0]["name"] == "position_x"
    assert all(entry["unit"] and entry["frame"] for entry in manifest["observations"] + manifest["actions"])
    assert (manifest["control_period_s"], manifest["delay_s"], manifest["dynamics"]) == (0.02, [0.0, 0.0], ["so_rpy"])
    low, high = manifest["observations"][2]["range"]
    assert 0.3 < low < high < 1.7  # it flew the curve, which is half a metre up and down from one metre
    copies = ["c_host"] if missing_target_tools() else ["c_host", "c_cortex_m4f"]
    for name in copies:
        assert record[name]["observations"] >= 10_000
        assert record[name]["max_abs_difference"] <= 1e-5
        assert record[name]["self_test"] <= 1e-5
    if not missing_target_tools():
        assert record["c_cortex_m4f"]["flash_bytes"] <= 32 * 1024
        assert record["c_cortex_m4f"]["ram_bytes"] <= 1024


ALGORITHMS = [(algo, "Pendulum-v1") for algo in (reinforce, a2c, trpo, ppo, reppo, shac, ddpg, td3, sac)]
ALGORITHMS += [(pqn, f"Copy-{kind}-v0") for kind in ("discrete", "masked")]
KINDS = [(ppo, f"Copy-{kind}-v0") for kind in ("box", "discrete", "multi-discrete", "multi-binary", "tuple", "masked")]


@pytest.mark.parametrize(("algo", "env"), ALGORITHMS + KINDS, ids=lambda x: x if isinstance(x, str) else x.__name__)
def test_all_copies_act_alike_in_closed_loop(algo, env, tmp_path):
    pytest.importorskip("onnxruntime")
    made = registry.make(env, 1)
    made.close()
    config = algo.Config(env=env, hidden=(64, 64), normalize_observations=True)
    torch.manual_seed(0)
    policy = TrainedPolicy(config.networks(made.spec), made.spec, config, 0)
    with torch.no_grad():
        for parameter in policy.module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    record = json.loads((lem.export(policy, tmp_path / "e") / "parity.json").read_text())
    assert record["acting"] == "policy.c"
    for name in ("onnx", "c_host") if missing_target_tools() else ("onnx", "c_host", "c_cortex_m4f"):
        assert record[name]["observations"] >= 10_000
        assert record[name]["max_abs_difference"] <= 1e-5, name
    print(
        algo.__name__,
        env,
        {name: (record[name] or {}).get("max_abs_difference") for name in ("onnx", "c_host", "c_cortex_m4f")},
    )
