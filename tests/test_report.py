"""Pictures and pages of runs: axes, gaps, titles, and report.html."""

import re
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.api import plots
from lemniscate.cli import parse
from lemniscate.report import curves, pages
from lemniscate.report.curves import run_styles
from lemniscate.report.flight import Flight, draw_from_above
from lemniscate.run.metrics import to_line
from lemniscate.system.files import read_json, write_json
from test_compare import without_layout, write_run, write_runs

PAGE = (Path(__file__).parents[1] / "docs" / "glossary.md").read_text()
SCORES = {
    "env_id": "CartPole-v1",
    "episodes": 4,
    "mean_return": 20.0,
    "std_return": 11.2,
    "returns": [5.0, 15.0, 25.0, 35.0],
    "lengths": [5, 15, 25, 35],
    "terminated": 3,
    "tracking_error": 0.25,
    "rmse_mm": 7.5,
    "seed": 0,
}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def drawn(monkeypatch, module, draw):
    """The figure that a function saves."""
    figures = []
    write = curves.save
    monkeypatch.setattr(module, "save", lambda figure, file: figures.append(figure) or write(figure, file))
    draw()
    return figures[0]


def curve(monkeypatch, run, by="step"):
    """(axes, x and y of the moving average) of a run's learning curve."""
    figure = drawn(monkeypatch, curves, lambda: curves.learning_curve([run], Path("x.png"), by=by))
    (axes,) = figure.axes
    _, line, *_ = axes.lines
    return axes, *np.asarray(line.get_xydata()).T


def with_lines(run, lines):
    (run / "metrics.jsonl").write_bytes(b"".join(map(to_line, lines)))
    return run


def without_policy(run):
    shutil.rmtree(run / "checkpoints")
    return run


def test_dots_and_line_of_a_learning_curve_are_in_its_legend(tmp_path, monkeypatch):
    axes, *_ = curve(monkeypatch, write_run(tmp_path / "r"))
    assert [text.get_text() for text in axes.figure.legends[0].texts] == ["an episode", "mean of the last 20"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("environment steps", "return of an episode")
    assert axes.xaxis.get_major_formatter()(100_000) == "100,000"


def test_a_curve_is_interrupted_where_no_episode_ended_for_long(tmp_path, monkeypatch):
    ended = [*range(100, 1_000, 100), *range(6_000, 7_000, 100)]
    lines = [{"step": step, "episode/returns": [float(step)]} for step in ended]
    run = with_lines(write_run(tmp_path / "r"), lines)
    _, x, y = curve(monkeypatch, run)
    assert x[np.flatnonzero(np.isnan(y)) + 1].tolist() == [6_000]
    _, x, y = curve(monkeypatch, run, by="episode")
    assert not np.isnan(y).any()


def test_slow_but_regular_episodes_leave_no_gap():
    assert not curves.gaps(np.array([1000.0, 2000, 3000, 4500, 5000])).any()
    assert curves.gaps(np.array([1000.0])).tolist() == []


def test_by_episode_the_curve_is_the_moving_average_of_20(tmp_path, monkeypatch):
    returns = [float(i % 7) for i in range(1_500)]
    run = with_lines(write_run(tmp_path / "r"), [{"step": 10_000, "episode/returns": returns}])
    axes, x, y = curve(monkeypatch, run, by="episode")
    assert axes.get_xlabel() == "episode"
    assert x[-1] == 1_500
    assert y[-1] == pytest.approx(np.mean(returns[-20:]))
    _, _, y = curve(monkeypatch, run)
    assert y[-1] == pytest.approx(np.mean(returns[-30:]))


def test_by_minute_the_curve_ends_with_the_training(tmp_path, monkeypatch):
    _, x, _ = curve(monkeypatch, write_run(tmp_path / "r", rate=50.0), by="minute")
    assert x[-1] == pytest.approx(10_000 / 50 / 60)


def test_another_axis_is_refused(tmp_path):
    with pytest.raises(lem.UserError, match="There is no axis 'episodes': did you mean episode"):
        lem.plot(write_run(tmp_path / "r"), by="episodes")


def test_one_spike_does_not_flatten_a_panel():
    values = np.array([*np.linspace(1, 2, 50), 1e6])
    assert curves.robust_range(values) == (1.0, 2.0)
    assert curves.robust_range(np.array([3.0, 3.0, 3.0, 9.0])) == (3.0, 9.0)
    assert curves.robust_range(np.array([3.0, 3.0 + 1e-15, 3.0, 3.0, 3.0 + 1e-15, 9.0, *[3.0] * 20])) == (3.0, 9.0)
    axes = Figure().subplots()
    axes.plot(np.arange(51), values)
    curves.limit_axis(axes)
    assert axes.get_ylim() == pytest.approx((0.95, 2.05))  # no margin below that is a share of the spike
    assert axes.lines[-1].get_xydata().tolist() == [[50, 1]]  # the triangle at the upper edge
    assert axes.get_title("right") == "▲ to 1e+06"


def test_diagnostics_have_plain_titles_and_the_units_of_the_glossary(tmp_path, monkeypatch):
    lines = [
        {"step": s, "approx_kl": 0.01, "old_approx_kl": 0.01, "losses/mine": 1.0, "time/x": 1.0} for s in (1, 2, 3)
    ]
    run = with_lines(write_run(tmp_path / "r"), lines)
    figure = drawn(monkeypatch, curves, lambda: curves.diagnostics([run], Path("x.png")))
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title("left") for axes in shown] == ["Approximate KL divergence", "losses/mine"]
    assert [axes.get_ylabel() for axes in shown] == ["nats", ""]
    assert {axes.get_xlabel() for axes in shown} == {"environment steps"}


def test_every_metric_with_a_title_is_in_the_glossary():
    for name in curves.TITLES:
        word = name.replace("gradient_norm", "") if "/" in name and name.startswith("gradient") else name
        assert f"{word}`" in PAGE, name


class Page(HTMLParser):
    """The elements of a page, in balance, and its text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.text = [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        self.open += [tag] if tag not in ("img", "meta") else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def page_of(run, scores=SCORES, pictures=(), found=()):
    return pages.write_run(run, pictures, scores, found).read_text()


def test_the_page_of_a_run_is_one_file(tmp_path):
    run = write_run(tmp_path / "r", gamma=0.9)
    text = page_of(run, pictures=curves.plot_runs([run], run / "plots"), found=lem.diagnose(run))
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>")
    sources = [attrs["src"] for tag, attrs in page.seen if "src" in attrs]
    assert len(sources) == 2
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.seen}
    assert "prefers-color-scheme: dark" in text
    assert "20.0 ± 11.2" in page.text
    assert "7.5 mm" in page.text
    assert "3 of 4" in page.text
    assert "One seed says nothing about another setting" in page.text


def test_what_differs_from_the_defaults_is_marked(tmp_path):
    text = page_of(write_run(tmp_path / "r", gamma=0.9, hidden=(8, 16)))
    marked = re.findall(r"<td>(\w+)</td><td><mark>([^<]*)</mark></td><td>([^<]*)</td>", text)
    assert ("gamma", "0.9", "0.99") in marked
    assert ("hidden", "8 16", "64 64") in marked
    assert "clip" not in {name for name, *_ in marked}


def test_nothing_in_the_files_of_a_run_becomes_markup(tmp_path):
    """Each text that a run's directory holds, and the directory's own name."""
    evil = '"><script>alert(1)</script><img src=x onerror=alert(1)>&\ud800'
    run = write_run(tmp_path / "<b>r")
    record = read_json(run / "config.json")
    record["config"] = dict.fromkeys(record["config"], evil) | {
        "total_steps": 10,
        evil: evil,
        "env_kwargs": {evil: evil},
    }
    write_json(run / "config.json", {"algorithm": evil, "config": record["config"]})
    text = page_of(run, {**SCORES, evil: 1.0})
    page = Page(text)
    assert {tag for tag, _ in page.seen} & {"script", "img", "b"} == set()
    assert "alert(1)" in page.text


def test_a_small_film_is_in_the_page_and_a_large_one_is_linked(tmp_path, monkeypatch):
    run = write_run(tmp_path / "r")
    (run / "videos").mkdir()
    (run / "videos" / "step 1.mp4").write_bytes(b"video")
    assert 'video src="data:video/mp4;base64,dmlkZW8="' in page_of(run)
    monkeypatch.setattr(pages, "MOST_BYTES", 3)
    assert 'href="../videos/step%201.mp4"' in page_of(run)


def test_a_run_without_anything_has_a_page(tmp_path):
    run = with_lines(write_run(tmp_path / "r"), [])
    assert "not been evaluated" in Page(page_of(run, None)).text


@pytest.mark.parametrize(
    ("algorithm", "fields"),
    [
        ("ppo", {"hidden": (8, 16), "normalize_advantage": False, "target_kl": 0.05, "desired_kl": None}),
        ("ppo", {"env_kwargs": {"gravity": 9.0, "x y": "a'b"}, "wrappers": ("m:f(x=1,y=2)",), "initial_log_std": -1.0}),
        ("ppo", {"preset": "default"}),
        ("sac", {"target_entropy": -3.0, "critic_hidden": (), "env": "Pendulum-v1"}),
    ],
)
def test_the_command_of_the_page_trains_the_same_run(tmp_path, algorithm, fields):
    run = write_run(tmp_path / "r", algorithm, **{"env": "CartPole-v1", **fields}, seed=7)
    record = read_json(run / "config.json")
    _, *words = shlex.split(pages.train_command(algorithm, record["config"]))
    given = parse(words)
    again = lem.config_for(given.algorithm, given.env, given.preset, **given.fields)
    assert again.to_json() == record["config"]


def test_the_page_of_a_comparison(tmp_path, monkeypatch):
    runs = [*write_runs(tmp_path / "a", gamma=0.9), write_run(tmp_path / "b" / "x", gamma=0.8, score=1e6)]
    page_of(runs[0])
    *_, file = lem.plot(*runs)
    assert file == Path("plots/report.html")
    page = Page(file.read_text())
    assert len([attrs for tag, attrs in page.seen if tag == "img"]) == 3
    links = [attrs["href"] for tag, attrs in page.seen if tag == "a"]
    assert [(file.parent / link).resolve() for link in links] == [runs[0] / "plots" / "report.html"]
    assert "--seeds 1,2,3" in page.text
    assert "gamma0.90.8" in page.text  # the row of what differs


def test_plot_of_a_run_returns_its_page_last(tmp_path, monkeypatch):
    without_layout(monkeypatch)
    run = without_policy(write_run(tmp_path / "r"))
    assert lem.plot(run)[-1] == run / "plots" / "report.html"


@pytest.mark.parametrize("count", [1, 2])
def test_a_notebook_shows_the_pictures_of_every_plot(tmp_path, monkeypatch, count):
    shown = []
    without_layout(monkeypatch)
    monkeypatch.setattr("IPython.display.display", lambda image: shown.append(image.filename))
    monkeypatch.setattr(plots, "in_notebook", lambda: True)
    files = lem.plot(*map(without_policy, write_runs(tmp_path / "a")[:count]))
    assert shown == [str(file) for file in files[:-1]]
    assert len(shown) == 1 + count


def test_the_report_of_an_evaluation_is_not_written_into_another_run(tmp_path):
    fields = tiny_fields("CartPole-v1")
    one, other = (
        lem.train("ppo", "CartPole-v1", run=tmp_path / name, progress=False, **fields) for name in ("one", "other")
    )
    with pytest.raises(lem.UserError, match="other is another run, whose page this would replace"):
        lem.evaluate(one, episodes=1, report=other.path)
    assert not (other.path / "plots").exists()
    for policy in (one, next(one.path.glob("checkpoints/step-*"))):
        lem.evaluate(policy, episodes=1, report=one.path)
    assert list(one.path.rglob("*.html"))


def test_a_flight_that_ends_in_its_first_step_is_drawn(tmp_path):
    flight = Flight(np.zeros((1, 3)), np.zeros((0, 3)), np.array([[0.0, 0, 0, 1]]), 0.02, np.zeros((0, 15)))
    assert draw_from_above([flight], tmp_path / "flight.png").exists()


def test_names_that_matplotlib_takes_for_something_else_are_shown(tmp_path):
    names = [label for _, _, label in run_styles([tmp_path / "_old", tmp_path / "a$1$"])]
    assert names == [" _old", r"a\$1\$"]
