"""The documentation site: every page is in its navigation, and it is built without a warning."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import lemniscate
from test_reading import LIMITS

ROOT = Path(__file__).parents[1]


def nav():
    """The pages that the site's navigation names."""
    entries, found = [yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]], []
    while entries:
        entry = entries.pop()
        if isinstance(entry, str):
            found.append(entry)
        else:
            entries += entry.values() if isinstance(entry, dict) else entry
    return found


def test_every_page_is_in_the_navigation_of_the_site_once():
    pages = {file.relative_to(ROOT / "docs").as_posix() for file in (ROOT / "docs").rglob("*.md")}
    tutorials = {f"tutorial/{file.stem}.md" for file in (ROOT / "docs" / "tutorial").glob("*.ipynb")}
    assert sorted(nav()) == sorted({*pages, *tutorials, "index.md", "contributing.md", "changelog.md"})


def test_every_public_name_is_in_the_reference():
    page = (ROOT / "docs" / "reference" / "lemniscate.md").read_text()
    assert set(lemniscate.__all__) <= set(re.findall(r"^::: lemniscate\.(\w+)$", page, re.MULTILINE))


def test_the_limits_in_the_note_on_a_record_are_those_that_are_tested():
    note = " ".join((ROOT / "docs" / "notes" / "record.md").read_text().split())
    for algorithm in ("ppo", "sac"):
        most = LIMITS[f"an iteration of {algorithm}"]
        limit = f"{most['executed']} lines in {most['functions']} functions for {algorithm.upper()}"
        assert limit in note


def test_the_site_is_built_without_a_warning_and_asks_nobody_else(tmp_path):
    for package in ("latex2mathml", "material", "mkdocs", "mkdocstrings_handlers"):
        pytest.importorskip(package)
    subprocess.run([sys.executable, "docs/pages.py"], cwd=ROOT, check=True)
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path), "-f", "-"]
    config = (ROOT / "mkdocs.yml").read_text().replace("  - search\n", "")  # its index takes half of the time
    done = subprocess.run(command, cwd=ROOT, input=config, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in tmp_path.rglob("*.html"):
        assert not re.search(r'<(?:script|img|iframe|link)\b[^>]+(?:src|href)="(?:https?:)?//', page.read_text()), page


def test_the_workflow_calls_targets_that_there_are():
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"].values()
    matrix = job["strategy"]["matrix"]
    targets = [*matrix["target"], *(row["target"] for row in matrix["include"])]
    assert {"check", "test", "wheel", "docs"} == set(targets)
    assert all(re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE) for target in targets)
    assert "make setup" in [step.get("run") for step in job["steps"]]
