"""The wheel holds every module and says its version; what else carries the version agrees."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import lemniscate

ROOT = Path(__file__).parents[1]


def test_the_wheel_holds_the_package(tmp_path):
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(tmp_path)]
    done = subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(ROOT)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (file,) = tmp_path.glob("*.whl")
    assert file.name == f"lemniscate-{lemniscate.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(file) as wheel:
        packed = {name: wheel.read(name) for name in wheel.namelist()}
    source = {path.relative_to(ROOT / "src").as_posix(): path for path in (ROOT / "src" / "lemniscate").rglob("*")}
    for name, path in source.items():
        if path.is_file() and "__pycache__" not in name:
            assert packed[name] == path.read_bytes(), name
    extra = {name for name in packed if not name.startswith("lemniscate-")} - set(source)
    assert not extra
    info = f"lemniscate-{lemniscate.__version__}.dist-info"
    assert b"lemniscate = lemniscate.cli:main" in packed[f"{info}/entry_points.txt"]
    assert f"\nVersion: {lemniscate.__version__}\n" in packed[f"{info}/METADATA"].decode()


def test_there_is_one_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["dynamic"] == ["version"]
    assert f"\nversion: {lemniscate.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    assert newest in ("Unreleased", lemniscate.__version__)


def test_the_command_says_its_version(capsys):
    from lemniscate.cli import main

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"lemniscate {lemniscate.__version__}\n"
