"""A drone's flight rendered by MuJoCo, off screen."""

# pyright: reportAttributeAccessIssue=false

from itertools import pairwise

import mujoco
import numpy as np

from lemniscate.envs.crazyflow import simulator
from lemniscate.report.flight import Flight

SIZE = (360, 600)
REFERENCE = np.array([0.9, 0.5, 0.1, 0.4], dtype=np.float32)
TRAIL = np.array([0.2, 0.9, 1.0, 1.0], dtype=np.float32)


def render(flight: Flight, env_id: str, num_envs: int, every: int = 4) -> list[np.ndarray]:
    """Frames of the first flight, one each `every` steps: [H, W, 3] uint8.

    Raises:
        RuntimeError: there is no off-screen OpenGL (EGL or OSMesa).
    """
    model = simulator(env_id, num_envs, "cpu").env.sim.mj_model
    model.vis.global_.offheight, model.vis.global_.offwidth = SIZE
    data = mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, *SIZE)
    except Exception as error:  # each OpenGL backend fails with exceptions of its own
        raise RuntimeError(f"no off-screen OpenGL: {error}") from error
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.azimuth, camera.elevation = (0, 0, 0.95), 90, -8
    camera.distance = 2.3
    path, reference = flight.position[:, 0], flight.reference[:, 0]
    frames = []
    for t in range(0, len(path), every):
        data.mocap_pos[0] = path[t]
        data.mocap_quat[0] = np.roll(flight.attitude[t, 0], 1)  # ours xyzw, MuJoCo's wxyz
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        renderer.update_scene(data, camera)
        _line(renderer.scene, reference[::5], REFERENCE, width=3)
        _line(renderer.scene, path[max(0, t - 100) : t + 1 : 2], TRAIL, width=4)
        frames.append(renderer.render())
    renderer.close()
    return frames


def _line(scene: mujoco.MjvScene, points: np.ndarray, color: np.ndarray, width: float) -> None:
    for start, end in pairwise(points):
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3), np.zeros(3), np.zeros(9), color)
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, width, start, end)
        scene.ngeom += 1
