"""The flight of a body, along a reference or among what stands there: the path, the error, a video."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from lemniscate.envs.backend import Baseline
from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.policies import Policy
from lemniscate.report.curves import finish, save
from lemniscate.report.playback import Tell, give, sentence
from lemniscate.run.evaluate import EpisodeTable, Evaluation, play_episodes
from lemniscate.system.console import in_notebook, say
from lemniscate.system.files import make_directory

BLUE, ORANGE, GREY = "#1f5fa8", "#e07b1a", "#9aa0a6"

STRIDE = 5
"""a video has a frame for every so many-th step"""


@dataclass(frozen=True)
class Flight:
    """A flight of T steps: `position` [T, 3] in metres, `attitude` [T, 4] (xyzw).

    What it flies along or among: `reference` [T, 3] in metres, [0, 3] where none is followed; the boxes [B, 15] of a
    `Scene`. All of these are as observed, which may be noisy and late; `measured` [T] is the true distance to the
    reference in metres, where the environment tells it.
    """

    position: np.ndarray
    reference: np.ndarray
    attitude: np.ndarray
    time_step: float
    boxes: np.ndarray
    measured: np.ndarray | None = None

    @property
    def error_mm(self) -> np.ndarray:
        """Distance to the reference, [T]."""
        if self.measured is not None:
            return 1000 * self.measured
        return 1000 * np.linalg.norm(self.position - self.reference, axis=-1)

    @property
    def time(self) -> np.ndarray:
        """Seconds since the start, [T]."""
        return self.time_step * np.arange(1, len(self.position) + 1)


def record(
    policy: Policy | Baseline | None,
    env: VecEnv,
    flights: int,
    seed: int,
    deterministic: bool = True,
    table: EpisodeTable | None = None,
) -> list[Flight]:
    """Play what `evaluate` plays, and keep the tracks; in `table` also what `evaluate` keeps.

    Of more flights than there are environments, the track of each environment's first is kept. Without a policy,
    actions are uniformly random. The environment has a scene.
    """
    scene = env.scene
    assert scene is not None
    rows, errors, first = [], [], torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    boxes = np.zeros((env.num_envs, 0, 15))
    for _, _, step, counts in play_episodes(policy, env, flights, seed, deterministic):
        if not rows and scene.boxes:
            boxes = scene.boxes()
        if table:
            table.add(step, counts)
        if (first & counts).any():
            row = torch.where((first & counts)[:, None], step.next_obs, torch.nan)[:flights]
            rows.append(row.cpu().numpy())
            errors.append(step.measures.get("tracking_error", torch.full_like(step.reward, torch.nan)).cpu().numpy())
        first = first & ~((step.terminated | step.truncated) & counts)
    found = []
    for flown, standing, distances in zip(np.stack(rows, axis=1), boxes, np.stack(errors, axis=1), strict=False):
        own = ~np.isnan(flown[:, 0])
        track, measured = flown[own], distances[own]
        position = track[:, scene.position]
        reference = position + track[:, scene.error] if scene.error else position[:0]
        told = None if np.isnan(measured).any() else measured
        found.append(Flight(position, reference, track[:, scene.attitude], scene.time_step, standing, told))
    return found


def show_flights(
    policy: Policy | Baseline | None,
    env: VecEnv,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    video: Path | None = None,
    tell: Tell = say,
) -> Evaluation:
    """Show flights in their scene, in a window, a notebook or a video; returns their evaluation.

    The flights are those of `evaluate`, and played together. Of more flights than there are environments, the first of
    each is shown.
    """
    table = EpisodeTable(env.num_envs, env.device)
    flights = record(policy, env, episodes, seed, deterministic, table)
    scores = table.evaluation(env.spec.env_id, env.summaries)
    if episodes > env.num_envs:
        say(f"{env.num_envs} of the {episodes} flights are shown, the first of each environment.")
    for number, of_episode in enumerate(zip(scores.returns, scores.lengths, strict=True), start=1):
        tell(sentence(number, *of_episode))
    assert env.scene is not None
    if video is None and not in_notebook():
        from lemniscate.report import scene

        scene.show(map(vars, flights), env.scene.model)
    else:
        frames, how = _frames(flights, env.scene.model)
        give(frames, 1 / (STRIDE * env.scene.time_step), video)
        tell(how)
    return scores


def draw_flights(
    policy: Policy | Baseline, env: VecEnv, run: Path, flights: int, record_video: bool, seed: int = 0
) -> list[Path]:
    """The paths of some flights in a scene, into the `plots/` of a run; with `record_video` one of them into `videos/`.

    Beside a path along a reference, the error. Returns the files, the video last.
    """
    flown = record(policy, env, flights, seed)
    folder, video = run / "plots", run / "videos" / "flight.gif"
    if record_video:
        make_directory(video.parent)
        show_flights(policy, env, 1, seed, video=video, tell=lambda text: None)
    if len(flown[0].reference):
        beside = record(env.baseline, env, flights, seed) if env.baseline else []
        drawn = [draw_path(flown, folder / "flight.png"), draw_error(flown, folder / "error.png", beside)]
    else:
        drawn = [draw_from_above(flown, folder / "flight.png")]
    return [*drawn, video] if record_video else drawn


def draw_from_above(flights: Sequence[Flight], file: Path) -> Path:
    """The first flight from above (x, y), its speed as colour, and what stands there; the others faintly."""
    figure = Figure(figsize=(7, 4.6), layout="constrained")
    axes = figure.subplots()
    first, *others = flights
    for other in others:
        axes.plot(*other.position[:, :2].T, color=GREY, linewidth=0.5, alpha=0.4)
    _draw_boxes(axes, first.boxes)
    path = first.position
    pieces = list(np.stack([path[:-1, :2], path[1:, :2]], axis=1))
    axes.plot(*path[0, :2], "o", color=BLUE, markersize=5, zorder=4)
    if pieces:  # not of a flight that ended in its first step
        speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / first.time_step
        points = axes.add_collection(LineCollection(pieces, array=speed, linewidths=2.2, zorder=3))
        figure.colorbar(points, ax=axes, label="speed / (m/s)", shrink=0.85)
    axes.set_title(f"One flight of {first.time[-1]:.2f} s, and {len(others)} others", loc="left")
    axes.set(xlabel="x / m", ylabel="y / m", aspect="equal")
    finish(axes)
    return save(figure, file)


def _draw_boxes(axes: Axes, boxes: np.ndarray) -> None:
    """The obstacles seen from above: the outline of each box's shadow."""
    from scipy.spatial import ConvexHull

    signs = np.array(list(product((-1, 1), repeat=3)))
    for box in boxes:
        corners = (box[:3] + (signs * box[3:6]) @ box[6:].reshape(3, 3).T)[:, :2]
        outline = corners[ConvexHull(corners, qhull_options="QJ").vertices]
        axes.add_patch(Polygon(outline, facecolor=ORANGE, edgecolor=ORANGE, linewidth=0.8, alpha=0.5))


def draw_path(flights: Sequence[Flight], file: Path) -> Path:
    """The first flight over the reference, seen from the side (x, z); the others' first second faintly."""
    figure = Figure(figsize=(7, 4.4), layout="constrained")
    axes = figure.subplots()
    first, *others = flights
    axes.plot(*first.reference[:, [0, 2]].T, color=ORANGE, linewidth=5, alpha=0.35, label="reference")
    for other in others:
        axes.plot(*other.position[other.time <= 1][:, [0, 2]].T, color=GREY, linewidth=0.6, alpha=0.6)
    axes.plot([], [], color=GREY, linewidth=0.8, label=f"first second of {len(others)} other starts")
    axes.plot(*first.position[:, [0, 2]].T, color=BLUE, linewidth=1.2, label="flown")
    axes.plot(*first.position[0, [0, 2]], "o", color=BLUE, markersize=5)
    errors = np.concatenate([one.error_mm for one in flights])
    late = np.concatenate([one.time for one in flights]) > 1
    counted, when = (errors[late], " after the first second") if late.any() else (errors, "")
    axes.set_title(f"Tracking error{when}: {np.sqrt(np.mean(np.square(counted))):.1f} mm", loc="left")
    axes.set(xlabel="x / m", ylabel="z / m", aspect="equal")
    finish(axes)
    axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
    return save(figure, file)


def draw_error(flights: Sequence[Flight], file: Path, baseline: Sequence[Flight] = ()) -> Path:
    """Distance to the reference over time: median, 10 % to 90 %, and the worst flight; a baseline's median beside."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    time, error = _errors(flights)
    low, middle, high = np.nanpercentile(error, [10, 50, 90], axis=1)
    axes.fill_between(time, low, high, color=BLUE, alpha=0.25, linewidth=0, label="10 % to 90 %")
    axes.plot(time, middle, color=BLUE, label="median")
    axes.plot(time, np.nanmax(error, axis=1), color=GREY, linewidth=0.8, label="worst")
    if baseline:
        its_time, its_error = _errors(baseline)
        its_median = np.nanmedian(its_error, axis=1)
        axes.plot(its_time, its_median, color=ORANGE, linewidth=1.2, label="median of the baseline")
    axes.set(xlabel="time / s", ylabel="tracking error / mm", yscale="log", xlim=(0, time[-1]))
    axes.set_title(f"{len(flights)} flights from unseen starts", loc="left")
    finish(axes)
    axes.legend(frameon=False, ncols=4, fontsize=9)
    return save(figure, file)


def _errors(flights: Sequence[Flight]) -> tuple[np.ndarray, np.ndarray]:
    """(seconds [T], errors [T, M] in mm) of M flights, NaN after the end of one that is shorter than others."""
    longest = max(flights, key=lambda one: len(one.position))
    return longest.time, np.array(list(zip_longest(*(one.error_mm for one in flights), fillvalue=np.nan)))


def _frames(flights: list[Flight], model: Any) -> tuple[Iterable[np.ndarray], str]:
    """Frames of flights, one after the other, and how they are drawn."""
    from lemniscate.report import scene

    rendered = (scene.render(vars(one), model, STRIDE) for one in flights)
    first = next(rendered)
    if first is not None:
        more = chain.from_iterable(frames for frames in rendered if frames is not None)
        return chain(first, more), "Rendered by MuJoCo."
    how = (
        "Drawn with matplotlib, since there is no off-screen OpenGL; for a MuJoCo rendering install EGL or OSMesa"
        " (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6)."
    )
    return chain.from_iterable(animate(one, STRIDE) for one in flights), how


def animate(flight: Flight, every: int) -> list[np.ndarray]:
    """Frames of a flight drawn with matplotlib, one each `every` steps: [H, W, 3] uint8.

    It is seen from the side beside a reference, and else from above.
    """
    figure = Figure(figsize=(6, 3.6), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    follows = len(flight.reference) > 0
    across = 2 if follows else 1
    path = flight.position[:, [0, across]]
    reference = flight.reference[:, [0, across]] if follows else path
    axes.plot(*reference.T, color=ORANGE, linewidth=4, alpha=0.3)
    if not follows:
        _draw_boxes(axes, flight.boxes)
    both = np.concatenate([path, reference])
    low, high = both.min(axis=0), both.max(axis=0)
    margin = 0.1 + 0.1 * np.max(high - low)  # metres; the body itself is 0.14 wide
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set(xlabel="x / m", ylabel=f"{'xyz'[across]} / m", aspect="equal")
    axes.spines[["top", "right"]].set_visible(False)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)  # the axes are drawn once: text and ticks would take most time
    (trail,) = axes.plot([], [], color=BLUE, linewidth=1.5)
    (arms,) = axes.plot([], [], color="black", linewidth=3, solid_capstyle="round")
    (goal,) = axes.plot([], [], "o", color=ORANGE, markersize=5)
    clock = axes.text(0.01, 0.95, "", transform=axes.transAxes)
    frames = []
    for t in range(0, len(path), every):
        x, y, z, w = flight.attitude[t]
        ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])[[0, across]]
        arms.set_data(*np.stack([path[t] - 0.07 * ahead, path[t] + 0.07 * ahead]).T)
        trail.set_data(*path[max(0, t - 100) : t + 1].T)
        said = f"{flight.time[t]:4.1f} s"
        if follows:
            goal.set_data(*reference[[t]].T)
            said += f"   {flight.error_mm[t]:5.1f} mm"
        clock.set_text(said)
        canvas.restore_region(background)
        for artist in (trail, goal, arms, clock):
            axes.draw_artist(artist)
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return frames
