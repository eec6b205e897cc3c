"""A flight in MuJoCo, off screen or in a window.

OpenGL is chosen when MuJoCo is imported, and a driver that does not work can take the process with it. So what is
rendered off screen is rendered in a process of its own: `python -m lemniscate.report.scene FOLDER`.
"""

# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

Track = Mapping[str, Any]
"""the fields of a `Flight`"""

SIZE = (360, 600)
REFERENCE = np.array([0.9, 0.5, 0.1, 0.4], dtype=np.float32)
CAMERA, CAMERA_OF_ROOM = ((0, 0, 0.95), 90, -8, 2.3), ((0, 0, 0.6), 90, -40, 4.2)
"""where it looks at, azimuth, elevation (degrees), distance (m): beside a reference, and where boxes stand"""
BOX = np.array([0.95, 0.55, 0.15, 1.0], dtype=np.float32)
TRAIL = np.array([0.2, 0.9, 1.0, 1.0], dtype=np.float32)


def render(track: Track, model: mujoco.MjModel, every: int) -> np.ndarray | None:
    """Frames of a flight, one each `every` steps, [F, H, W, 3] uint8; None without an off-screen OpenGL.

    The OpenGL is that of MUJOCO_GL, or else the first of EGL and OSMesa that works.
    """
    with tempfile.TemporaryDirectory() as folder:
        mujoco.mj_saveModel(model, f"{folder}/model.mjb")
        np.savez(f"{folder}/flight.npz", every=every, **track)
        for backend in [os.environ["MUJOCO_GL"]] if "MUJOCO_GL" in os.environ else ["egl", "osmesa"]:
            command = [sys.executable, "-m", "lemniscate.report.scene", folder]
            done = subprocess.run(command, env={**os.environ, "MUJOCO_GL": backend}, capture_output=True)
            if done.returncode == 0:
                return np.load(f"{folder}/frames.npy")
    return None


def show(tracks: Iterable[Track], model: mujoco.MjModel) -> None:
    """Play the flights one by one in MuJoCo's window, at their own speed, until they end or the window is closed."""
    from mujoco import viewer

    data = mujoco.MjData(model)
    with viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
        assert window.user_scn is not None
        for track in tracks:
            _aim(window.cam, track)
            for t in range(len(track["position"])):
                if not window.is_running():
                    return
                _place(model, data, track, t)
                window.user_scn.ngeom = 0
                _draw_lines(window.user_scn, track, t)
                window.sync()
                time.sleep(track["time_step"])


def _aim(camera: Any, track: Track) -> None:
    looks = CAMERA_OF_ROOM if len(track["boxes"]) else CAMERA
    camera.lookat[:], camera.azimuth, camera.elevation, camera.distance = looks


def _place(model: mujoco.MjModel, data: mujoco.MjData, track: Track, t: int) -> None:
    data.mocap_pos[0] = track["position"][t]
    data.mocap_quat[0] = np.roll(track["attitude"][t], 1)  # ours xyzw, MuJoCo's wxyz
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


def _render_here(folder: Path) -> None:
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    track = dict(np.load(folder / "flight.npz"))
    model.vis.global_.offheight, model.vis.global_.offwidth = SIZE
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    _aim(camera, track)
    frames = []
    with mujoco.Renderer(model, *SIZE) as renderer:
        for t in range(0, len(track["position"]), int(track["every"])):
            _place(model, data, track, t)
            renderer.update_scene(data, camera)
            _draw_lines(renderer.scene, track, t)
            frames.append(renderer.render())
    np.save(folder / "frames.npy", np.stack(frames))


def _draw_lines(scene: mujoco.MjvScene, track: Track, t: int) -> None:
    """Add the boxes, the reference and the last hundred steps that were flown."""
    box, line, nothing = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3)
    for centre, half, frame in zip(*np.split(track["boxes"], (3, 6), axis=1), strict=True):
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], box, half, centre, frame, BOX)
        scene.ngeom += 1
    flown = track["position"][: t + 1][-101::2]
    for points, color, width in ((track["reference"][::5], REFERENCE, 3), (flown, TRAIL, 4)):
        for start, end in pairwise(points):
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, line, nothing, nothing, np.zeros(9), color)
            mujoco.mjv_connector(geom, line, width, start, end)
            scene.ngeom += 1


if __name__ == "__main__":
    _render_here(Path(sys.argv[1]))
