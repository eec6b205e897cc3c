"""What the documents say is in the code, and what they show runs."""

import re
import runpy
import shlex
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "lemniscate"


def equation_rows():
    """(file, line of code) of each row of the tables in docs/notes/ that map equations to lines."""
    rows = []
    for line in "\n".join(note.read_text() for note in sorted((ROOT / "docs" / "notes").glob("*.md"))).splitlines():
        cells = re.findall(r"`([^`]+)`", line)
        files = [cell for cell in cells if re.fullmatch(r"\w+/\w+\.py", cell)]
        if line.startswith("|") and files and cells[-1] != files[0]:
            rows.append((files[0], cells[-1]))
    return rows


def test_the_table_has_its_equations():
    assert len(equation_rows()) >= 40


@pytest.mark.parametrize(("file", "code"), equation_rows())
def test_every_line_that_the_notes_quote_is_there(file, code):
    assert code in (SOURCE / file).read_text()


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", *(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md"))]
)
def test_every_link_leads_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text())
    for link in links:
        assert link.startswith("https://") or ((ROOT / page).parent / link).exists(), link


def test_the_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    scope = {}
    exec(code.replace("total_steps=20_000", "total_steps=2_048, progress=False"), scope)
    assert scope["action"] in (0, 1)


def test_the_python_of_the_lander_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "notes" / "lander.md").read_text(), re.DOTALL)
    assert len(code.splitlines()) <= 10
    scope = {}
    exec(code.replace("seed=1)\npictures", "seed=1, total_steps=1600, progress=False)\npictures"), scope)
    assert [picture.name for picture in scope["pictures"]] == ["learning_curve.png", "diagnostics.png", "report.html"]
    assert scope["run"].policy.step == 1600
    assert (tmp_path / "lander.gif").stat().st_size > 10_000


def test_lambda_is_drawn_and_the_formulas_lie_on_its_lines(tmp_path):
    """At λ = 0 and 1 the lines of `gae` go through the dots that were added up by hand."""
    figure = runpy.run_path(str(ROOT / "docs" / "figures" / "gae_lambda.py"))["draw"]()
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    assert lines["gae, λ = 0"] == pytest.approx(lines["r + V(s′) − V(s)"])
    assert lines["gae, λ = 1"] == pytest.approx(lines["return to come − V(s)"])
    bias, std = (figure.axes[1].lines[i].get_ydata() for i in (0, 1))
    assert std[0] == pytest.approx(0, abs=1e-9)
    assert bias[-1] < 0.1 * bias[0]


def drawing(name):
    return runpy.run_path(str(ROOT / "docs" / "figures" / f"{name}.py"))


def test_the_clip_is_drawn_and_its_gradient_stops_where_the_note_says():
    objectives = drawing("clip")["objectives"]
    for advantage, stops in ((1.0, lambda ratio: ratio > 1.2), (-1.0, lambda ratio: ratio < 0.8)):
        ratio, plain, clipped, slope = objectives(advantage)
        assert ((slope == 0) == stops(ratio)).double().mean() > 0.98  # but for rounding at the edge
        assert (clipped <= plain + 1e-12).all()
    assert len(drawing("clip")["draw"]().axes) == 2


def test_baselines_lower_the_variance_of_the_gradient_in_the_picture():
    figure = drawing("variance")["draw"](batches=12, updates=4, num_envs=2)
    whole, to_go, _, value = (bar.get_width() for bar in figure.axes[0].patches[::-1])
    assert whole == 1
    assert value < to_go < whole


@pytest.mark.parametrize(("name", "fields"), [("collapse", {"seeds": (1,)}), ("traces", {})])
def test_the_pictures_of_training_are_drawn(name, fields):
    figure = drawing(name)["draw"](steps=4096, **fields)
    assert all(axes.lines for axes in figure.axes)


def test_every_command_of_the_readme_is_understood(monkeypatch):
    from lemniscate.cli import parse

    monkeypatch.chdir(ROOT / "examples")  # where the algorithm of one's own is
    lines = re.findall(r"^lemniscate ([^#\n]+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert len(lines) >= 6
    for line in lines:
        parse(shlex.split(line))


def test_every_field_has_its_docstring():
    from lemniscate.algos import ALGORITHMS

    for name in ALGORITHMS:
        module = import_module(f"lemniscate.algos.{name}")
        for config in module.Config.__mro__[:-1]:
            source = (SOURCE / (config.__module__.replace("lemniscate.", "").replace(".", "/") + ".py")).read_text()
            for field in config.__annotations__:
                assert re.search(rf'^    {field}: [^\n]+\n    """', source, re.MULTILINE), field


def test_algorithm_files_have_the_same_names_in_the_same_order():
    from lemniscate.algos import ALGORITHMS

    for name in ALGORITHMS:
        text = (SOURCE / "algos" / f"{name}.py").read_text()
        order = [
            text.index(f"\n{mark}")
            for mark in ("class Config", "class State", "def init", "def learn", "def update", "def train")
        ]
        assert order == sorted(order)
        assert 60 <= len(text.splitlines()) <= 180
        assert text.startswith('"""')
