"""The drone's policy, trained, exported and flown by the C."""

import json

import pytest
from exported import needs_compiler

import lemniscate as lem
from lemniscate.exporting import target

pytestmark = [pytest.mark.long, needs_compiler]


def test_the_figure_eight_fits_and_flies_on_the_target(tmp_path):
    pytest.importorskip("crazyflow")
    lem.train("ppo", env="DroneFigureEightTrajectory-v0", run=tmp_path / "run", progress=False)
    folder = lem.export(tmp_path / "run")
    manifest, record = (json.loads((folder / name).read_text()) for name in ("manifest.json", "parity.json"))
    assert (folder / "crazyflie" / "policy_controller.c").exists()
    assert manifest["observations"][0]["name"] == "position_x"
    assert all(entry["unit"] and entry["frame"] for entry in manifest["observations"] + manifest["actions"])
    assert (manifest["control_period_s"], manifest["delay_s"], manifest["dynamics"]) == (0.02, 0.0, "so_rpy")
    low, high = manifest["observations"][2]["range"]
    assert 0.3 < low < high < 1.7  # it flew the curve, which is half a metre up and down from one metre
    copies = ["c_host"] if target.missing_tools() else ["c_host", "c_cortex_m4f"]
    for name in copies:
        assert record[name]["observations"] >= 10_000
        assert record[name]["max_abs_difference"] <= 1e-5
        assert record[name]["self_test"] <= 1e-5
    if not target.missing_tools():
        assert record["c_cortex_m4f"]["flash_bytes"] <= 32 * 1024
        assert record["c_cortex_m4f"]["ram_bytes"] <= 1024
