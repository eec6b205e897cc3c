"""benchmarks/gpu.py on the CPU, in miniature."""

import importlib.util

import gpu
import pytest
import torch

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    "name",
    [
        "agreement",
        "speed",
        pytest.param("resume", marks=pytest.mark.long),
        pytest.param("graphs", marks=pytest.mark.long),
    ],
)
def test_a_part_runs_in_miniature(name):
    rows = list(gpu.PARTS[name][0](CPU, True))
    assert len(rows) == {"agreement": 3, "resume": 2, "speed": 2, "graphs": 2}[name]
    assert all(row["ok"] is not False for row in rows), rows


@pytest.mark.skipif(not importlib.util.find_spec("crazyflow"), reason="crazyflow is not installed")
def test_arrays_pass_between_jax_and_torch_without_a_copy():
    assert gpu.zero_copy(CPU)["ok"]


@pytest.mark.long
def test_drones_fly_in_miniature():
    assert [row["what"] for row in gpu.drones(CPU, True)] == ["JAX to torch and back", "course, 4 drones"]


def test_six_minutes_are_enough():
    assert sum(limit for _, limit in gpu.PARTS.values()) < 360


def test_where_there_is_no_gpu_one_sentence_says_so(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    gpu.main([])
    assert capsys.readouterr().out.startswith("torch sees no CUDA device here")


def test_what_was_found_before_a_failure_is_in_the_table(monkeypatch, tmp_path):
    program = tmp_path / "part.py"
    program.write_text("""print('{"what": "a", "found": "1", "ok": true}', flush=True)\nraise ValueError("no more")""")
    monkeypatch.setattr(gpu, "__file__", str(program))
    rows = gpu.run_part("speed", "cpu", True, 600)
    assert rows == [gpu.row("a", "1", True), gpu.row("the rest", "ValueError: no more", False)]
    program.write_text(program.read_text().replace("raise", "import time\ntime.sleep(600)\nraise"))
    rows = gpu.run_part("speed", "cpu", True, 3.0)
    assert rows[-1] == gpu.row("the rest", "not done within 3 s")
    assert gpu.table({"speed": rows}).splitlines()[-1].startswith("speed        the rest")


def test_differing_bits_are_counted():
    assert gpu.differing_bits(b"\x00\xff", b"\x01\xff") == 1
    assert gpu.differing_bits(b"\x00", b"\x00\x00") == 16
