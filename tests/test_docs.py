"""What the documents say is in the code, and what they show runs."""

import ast
import json
import math
import re
import runpy
import shlex
import sys
import textwrap
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "lemniscate"
PAGES = [str(p.relative_to(ROOT)) for p in (*ROOT.glob("*.md"), *sorted(ROOT.glob("docs/**/*.md")))]
MAKEFILE = (ROOT / "Makefile").read_text()


def text_of(page):
    return (ROOT / page).read_text()


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(page), re.DOTALL | re.MULTILINE)


def with_blocks(language):
    return [(page, block) for page in PAGES for block in blocks(page, language)]


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


def anchors(page):
    """The anchors of a page's headings."""
    prose = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", [*PAGES, "llms.txt"])
def test_every_link_leads_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", text_of(page))
    for link in links:
        if not link.startswith("https://"):
            name, _, anchor = link.partition("#")
            target = (ROOT / page).parent / name if name else ROOT / page
            assert target.is_file(), link
            assert not anchor or anchor in anchors(target.resolve().relative_to(ROOT)), link


@pytest.mark.parametrize("page", PAGES)
def test_every_file_that_a_page_names_is_there(page):
    folders = "benchmarks|docs|tests|examples|src"
    for name in re.findall(rf"`\.?/?((?:{folders})/[\w./-]+\.\w+)[` ]", text_of(page)):
        assert (ROOT / name).is_file(), name
    for name in re.findall(r"<!-- file: (.+?) -->", text_of(page)):
        assert (ROOT / name).is_file(), name


@pytest.mark.parametrize("page", PAGES)
def test_lists_and_tables_begin_after_an_empty_line(page):
    """On GitHub they need not; on the site they would be a part of the paragraph."""
    prose = re.sub(r"^```.*?^```$", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    assert not re.search(r"^(?![-|#\s]|\d+\. ).+\n(- |\| |1\. )", prose, re.MULTILINE)


@pytest.mark.parametrize(
    ("page", "code"),
    [(page, code) for page, code in with_blocks("python") if "lander" not in page and "courses" not in page],
)
def test_python_runs(page, code, tmp_path, monkeypatch):
    """A block that imports is a program, another the inside of a function."""
    monkeypatch.chdir(tmp_path)
    if "import " not in code:
        ast.parse(f"def function():\n{textwrap.indent(code, '    ')}")
        return
    scope = {}
    exec(re.sub(r"total_steps=[\d_]+", "total_steps=2_048, report=False", code), scope)
    assert "action" not in scope or scope["action"] in (0, 1)


def test_the_home_page_is_short():
    page = text_of("README.md")
    assert len(page.splitlines()) <= 100
    (code,) = blocks("README.md", "python")
    assert len(code.splitlines()) <= 8
    figures = [line for line in page.splitlines() if re.match(r"\| [A-Z]\w+", line)]
    assert 1 <= len(figures) <= 10
    tables = text_of("docs/results.md")
    for line in figures:
        algorithm, env, steps, value, worst, seeds, _ = (cell.strip() for cell in line.strip("| ").split("|"))
        row = rf"^\| {algorithm.split()[0]} .?.?\| {env} \| {steps} \| {value} \|.*\| {worst} \| {seeds} \|"
        assert "495 of 500" in line or re.search(row, tables, re.MULTILINE), line


def shell_lines():
    """(page, words) of every command in a block."""
    found = []
    for page, block in [*with_blocks(""), *with_blocks("sh")]:
        for line in block.replace("\\\n", " ").splitlines():
            if re.match(r"([A-Z_]+=\S+ )?(lemniscate|make|pip|docker|python|benchmarks/\S+|\.venv/\S+) ", line):
                words = shlex.split(line, comments=True)
                found.append((page, words[1:] if "=" in words[0] else words))
    return found


def test_there_are_commands():
    assert len(shell_lines()) >= 40


@pytest.mark.parametrize(("page", "words"), shell_lines(), ids=lambda x: x if isinstance(x, str) else " ".join(x))
def test_every_command_is_understood(page, words, monkeypatch):
    from lemniscate.cli import parse

    monkeypatch.chdir(ROOT / "examples")  # where the files of one's own are
    program = words[0]
    if words[:2] == ["docker", "run"]:
        program, words = "lemniscate", words[words.index("lemniscate") :]
    if program == "lemniscate" and words[1].startswith("--"):
        with pytest.raises(SystemExit, match=r"^0$"):
            parse(words[1:])
    elif program == "lemniscate":
        parse(words[1:])
    elif program == "make":
        for target in (word for word in words[1:] if "=" not in word):
            assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target
    elif program == "pip":
        extras = tomllib.loads(text_of("pyproject.toml"))["project"]["optional-dependencies"]
        for names in re.findall(r"^\.\[(.+)\]$", " ".join(words[2:]), re.MULTILINE):
            assert set(names.split(",")) <= set(extras)


def constants():
    """Every string of the source, the parts of f-strings too."""
    trees = [ast.parse(file.read_text()) for file in SOURCE.rglob("*.py")]
    return [
        node.value
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and node.value.__class__ is str
    ]


def test_every_message_that_is_quoted_can_be_said():
    messages = [line for block in blocks("docs/faq.md", "output") for line in block.splitlines()]
    assert len(messages) >= 15
    said = constants()
    for message in messages:
        for part in message.split("…"):
            assert any(part.strip() in constant for constant in said), part


def test_what_is_counted_is_counted():
    sys.path.insert(0, str(ROOT / "tests" / "envs"))
    try:
        mutants, contract = import_module("test_mutants").MUTANTS, import_module("test_contract").EVERY
    finally:
        sys.path.pop(0)
    golden = json.loads(text_of("tests/algos/golden.json"))
    guarantees = " ".join(text_of("docs/guarantees.md").split())
    assert f"each of {len(mutants)} wrong versions" in " ".join(text_of("README.md").split())
    assert f"**{len(mutants)} wrong versions**" in guarantees
    assert f"**{len(golden)} golden records**" in guarantees
    assert f"on {len(contract)} environments" in guarantees


@pytest.mark.long
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
    figure = runpy.run_path(str(ROOT / "docs" / "figures" / "gae_lambda.py"))["draw"](walks=6_000)
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


def test_a_normal_covers_two_peaks_or_takes_the_higher_one_by_the_direction_of_the_kl():
    kl, log_peaks, log_normal, fits, draw = map(drawing("kl").get, ("kl", "log_peaks", "log_normal", "fits", "draw"))
    forward, reverse = fits().values()
    assert forward == pytest.approx((-0.4, (0.25 + 3.84) ** 0.5), abs=1e-3)  # mean and std of the mixture
    assert reverse == pytest.approx((-2.0, 0.5), abs=2e-3)
    assert kl(log_normal(*reverse), log_peaks()) == pytest.approx(math.log(1 / 0.6), abs=1e-2)
    assert all(panel.get_title(loc="left").endswith(name) for panel, name in zip(draw().axes, fits(), strict=True))


def test_baselines_lower_the_variance_of_the_gradient_in_the_picture():
    figure = drawing("variance")["draw"](batches=12, updates=4, num_envs=2)
    whole, to_go, _, value = (bar.get_width() for bar in figure.axes[0].patches[::-1])
    assert whole == 1
    assert value < to_go < whole


@pytest.mark.long
@pytest.mark.parametrize(("name", "fields"), [("collapse", {"seeds": (1,)}), ("traces", {})])
def test_the_pictures_of_training_are_drawn(name, fields):
    figure = drawing(name)["draw"](steps=4096, **fields)
    assert all(axes.lines for axes in figure.axes)


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
