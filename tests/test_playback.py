"""Episodes shown where a person sits: in a notebook and in a window; films are in test_cli."""

import io
import textwrap

import gymnasium as gym
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

import lemniscate as lem
from lemniscate.report import playback


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("watch") / "run"
    return lem.train("ppo", "CartPole-v1", run=path, progress=False, total_steps=2048, compile="off").policy


def test_a_notebook_shows_the_episode_while_it_is_played(tmp_path):
    """A real kernel runs the cells of a real notebook; every frame replaces the one before."""
    cell = textwrap.dedent(
        f"""
        import lemniscate as lem
        run = lem.train("ppo", "CartPole-v1", run={str(tmp_path / "run")!r}, progress=False, total_steps=2048, compile="off")
        lem.watch(run.policy, seed=1)
        """
    )
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)])
    client = NotebookClient(notebook, timeout=120)
    updates = []
    heard = client.process_message

    def listen(message, *rest):
        if message["msg_type"] == "update_display_data":
            updates.append(message["content"]["data"]["image/jpeg"])
        return heard(message, *rest)

    client.process_message = listen
    client.execute()
    pictures = [output for output in notebook.cells[0].outputs if output.output_type == "display_data"]
    assert len(pictures) == 1
    assert len(set(updates)) > 5


def test_frames_are_sent_at_their_own_speed_but_no_faster_than_a_browser_takes(monkeypatch):
    class Place:
        def update(self, shown):
            sent.append(shown.data)

    def display(shown, display_id):
        assert display_id
        sent.append(shown.data)
        return Place()

    sent, now = [], [0.0]
    monkeypatch.setattr("IPython.display.display", display)
    monkeypatch.setattr(playback.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(playback.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    frames = [np.full((8, 8, 3), shade, dtype=np.uint8) for shade in range(0, 200, 2)]
    playback.send_frames(frames, fps=50)
    shades = [int(np.asarray(Image.open(io.BytesIO(jpeg)))[0, 0, 0]) for jpeg in sent]
    assert shades == pytest.approx(range(0, 200, 4), abs=2)
    assert now[0] == pytest.approx(2.0, abs=0.05)


def test_a_terminal_is_no_notebook():
    assert not playback.in_notebook()


def test_a_window_is_opened_and_closed(policy, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    opened, make = [], gym.make
    monkeypatch.setattr(gym, "make", lambda *spec, **kwargs: opened.append(make(*spec, **kwargs)) or opened[-1])
    assert lem.watch(policy, seed=3) is None
    (env,) = (env for env in opened if env.render_mode)
    assert env.render_mode == "human"
    assert not env.unwrapped.isopen


def test_a_film_lasts_as_long_as_the_episode(policy, tmp_path):
    said = lem.watch(policy, seed=3, video=tmp_path / "film.gif")
    steps = int(said.split(": ")[1].split()[0])
    with Image.open(tmp_path / "film.gif") as film:  # equal frames are merged into longer ones
        seconds = sum(film.seek(i) or film.info["duration"] for i in range(film.n_frames)) / 1000
    assert seconds == pytest.approx((steps + 1) / 50)
