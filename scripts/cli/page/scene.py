"""Pictures of a machine, drawn by MuJoCo into memory: no window, no display."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from headway.models.source import read_spec
from headway.sim.plugin import load_plugin

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

WIDTH, HEIGHT = 640, 480
SAMPLES, SHADOW = 4, 1024  # a pixel; pixels of the shadow map: both are what takes the time
SKY, GROUND = (0.13, 0.16, 0.20), (0.24, 0.28, 0.34)  # behind models without a background
GHOST = (0.45, 0.72, 1.0, 0.38)
GHOST_SIZE = 0.985  # faces that coincide with the machine's would flicker
GHOST_FROM = 0.005  # of the machine's extent: what is nearer to the machine shows nothing
BONE = (0.75, 0.78, 0.82, 1.0)  # of a machine without shapes
BONE_RADIUS = 0.015  # of the machine's extent
AZIMUTH_DEG, ELEVATION_DEG = 125.0, -25.0  # of the camera, if the model has none
DISTANCE = 2.2  # of the camera, in extents
BORDER = 1.12  # room around the machine
POSES = 60  # looked at to find where the machine goes
MAX_GEOMS = 5000
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
LAST_VISIBLE_GROUP = 2  # MuJoCo's viewers hide the others: collision shapes, by custom


class NoPicture(Exception):
    """The machine cannot be drawn; says why, and what to do about it."""


class Scene:
    """A machine's model with a camera on it.

    The camera is the model's first one; without one it looks from the front, a little from above.
    Either way the picture is cut to where the machine goes.
    """

    def __init__(self, path: Path, joints: list[str], poses: Array) -> None:
        """`joints`: names by axis; `poses`: positions (m, axes) that are to be in the picture.

        Raises NoPicture.
        """
        self._model = model = _model(path)
        known = {model.joint(j).name: int(model.jnt_qposadr[j]) for j in range(model.njnt)}
        if not known.keys() >= set(joints):
            raise NoPicture(
                f"the machine cannot be drawn: {path} has changed, its joints are now "
                f"{', '.join(known)}; run the config again"
            )
        self._places = [known[joint] for joint in joints]
        self._data, self._ghost = mujoco.MjData(model), mujoco.MjData(model)
        moving = model.body_weldid > 0
        shown = model.geom_group <= LAST_VISIBLE_GROUP
        self._geoms = np.flatnonzero(shown & moving[model.geom_bodyid])
        self._still = np.flatnonzero(shown & ~moving[model.geom_bodyid] & (model.geom_rbound > 0))
        self._bodies = np.flatnonzero(moving)
        self._gl = _context()
        font = mujoco.mjtFontScale.mjFONTSCALE_100.value
        self._renderer = mujoco.MjrContext(model, font)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._renderer)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._option, self._perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
        points = self._reach(poses[:: max(1, len(poses) // POSES)])
        self._extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        self._camera = self._look_at(points)
        self._frame = self._framed(points)

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.free()
        self._gl.free()

    def picture(self, pose: Array, ghost: Array | None, scale: float = 1.0) -> Picture:
        """The machine with its axes at `pose` [rad or m], as pixels (height, width, 3).

        `ghost`: where a translucent copy stands; it is only drawn if it can be told from the
        machine. `scale`: of the picture's size, at most 1.
        """
        self._update(pose)
        if ghost is not None:
            self._add_ghost(ghost)
        width, height = round(WIDTH * scale), round(HEIGHT * scale)
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, self._scene, self._renderer)
        pixels: Picture = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, area, self._renderer)
        return pixels[::-1]

    def _stand(self, data: mujoco.MjData, pose: Array) -> None:
        data.qpos[self._places] = pose
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)  # which cameras may follow
        mujoco.mj_camlight(self._model, data)

    def _points(self, data: mujoco.MjData, geoms: NDArray[np.int64]) -> Array:
        """The corners of boxes around shapes, (8 m, 3) in the world."""
        box = self._model.geom_aabb[geoms]
        local = box[:, None, :3] + CORNERS * box[:, None, 3:]
        turn = data.geom_xmat[geoms].reshape(-1, 3, 3)
        corners: Array = local @ turn.transpose(0, 2, 1) + data.geom_xpos[geoms, None]
        return corners.reshape(-1, 3)

    def _moving_points(self, data: mujoco.MjData) -> Array:
        if not len(self._geoms):
            return np.vstack(self._bones(data))
        return np.vstack((self._points(data, self._geoms), data.xpos[self._bodies]))

    def _reach(self, poses: Array) -> Array:
        """Points around all that is to be in the picture: what moves, what it stands on."""
        reached = []
        for pose in poses:
            self._stand(self._data, pose)
            reached.append(self._moving_points(self._data))
        moving = np.vstack(reached)
        still = [self._points(self._data, np.array([geom])) for geom in self._still]
        extent = np.linalg.norm(np.ptp(moving, axis=0))
        near = [box for box in still if np.linalg.norm(np.ptp(box, axis=0)) <= 1.5 * extent]
        return np.vstack((moving, *near))

    def _look_at(self, points: Array) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        if self._model.ncam:
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
            return camera
        camera.lookat = (points.min(axis=0) + points.max(axis=0)) / 2
        camera.distance = DISTANCE * self._extent
        camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
        return camera

    def _framed(self, points: Array) -> tuple[float, float, float]:
        """Horizontal centre, bottom and top of the picture, at distance 1 from the camera."""
        self._frame = 0.0, -1.0, 1.0
        self._update(self._data.qpos[self._places])
        eye = self._scene.camera[0]
        forward, up = np.array(eye.forward), np.array(eye.up)
        away = points - np.array(eye.pos)
        depth = away @ forward
        ahead = depth > 0.05 * self._extent
        if not ahead.any():
            raise NoPicture(
                "the machine cannot be drawn: the model's first camera looks away from it"
            )
        right = np.cross(forward, up)
        seen = np.stack((away @ right, away @ up), axis=1)[ahead] / depth[ahead, None]
        low, high = seen.min(axis=0), seen.max(axis=0)
        middle = (low + high) / 2
        half = BORDER * max((high - low) / 2 * (HEIGHT / WIDTH, 1.0))
        return middle[0], middle[1] - half, middle[1] + half

    def _update(self, pose: Array) -> None:
        """The scene at a pose, seen through the frame."""
        self._stand(self._data, pose)
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._option,
            self._perturbation,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        if not len(self._geoms):
            self._add_bones(self._data)
        centre, bottom, top = self._frame
        for eye in self._scene.camera:
            eye.frustum_center = eye.frustum_near * centre
            eye.frustum_bottom = eye.frustum_near * bottom
            eye.frustum_top = eye.frustum_near * top

    def _add_ghost(self, pose: Array) -> None:
        self._stand(self._ghost, pose)
        apart = self._moving_points(self._ghost) - self._moving_points(self._data)
        if np.linalg.norm(apart, axis=1).max() < GHOST_FROM * self._extent:
            return
        before = self._scene.ngeom
        mujoco.mjv_addGeoms(
            self._model,
            self._ghost,
            self._option,
            self._perturbation,
            mujoco.mjtCatBit.mjCAT_DYNAMIC,
            self._scene,
        )
        if not len(self._geoms):
            self._add_bones(self._ghost)
        for geom in self._scene.geoms[before : self._scene.ngeom]:
            geom.rgba, geom.matid, geom.transparent = GHOST, -1, 1
            if geom.type != mujoco.mjtGeom.mjGEOM_MESH:  # whose size is not looked at
                geom.size *= GHOST_SIZE

    def _bones(self, data: mujoco.MjData) -> tuple[Array, Array]:
        """Both ends of lines from each body to the one it hangs from, and to its centre of mass."""
        bodies = self._bodies
        joints = data.xpos[bodies]
        begin = np.vstack((data.xpos[self._model.body_parentid[bodies]], joints))
        return begin, np.vstack((joints, data.xipos[bodies]))

    def _add_bones(self, data: mujoco.MjData) -> None:
        """What is drawn of a machine without shapes."""
        scene, capsule = self._scene, mujoco.mjtGeom.mjGEOM_CAPSULE
        for begin, end in zip(*self._bones(data), strict=True):
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), BONE)
            mujoco.mjv_connector(geom, capsule, BONE_RADIUS * self._extent, begin, end)
            scene.ngeom += 1


def _context() -> Any:
    """An OpenGL context: of the kind that MUJOCO_GL names, else EGL, which needs no display."""
    try:
        if os.environ.get("MUJOCO_GL"):
            from mujoco.gl_context import GLContext
        else:
            from mujoco.egl import GLContext
        context = GLContext(WIDTH, HEIGHT)
        context.make_current()
    except Exception as error:  # each kind fails in its own way, some with an AttributeError
        what = " ".join(str(error).split()) or type(error).__name__
        raise NoPicture(
            f"the machine cannot be drawn: OpenGL does not work here ({what}): run "
            "`sudo apt-get install -y libegl1 libgl1` and leave MUJOCO_GL unset"
        ) from error
    return context


def _model(path: Path) -> mujoco.MjModel:
    """The machine, with light and a background where it has none of its own."""
    load_plugin()
    if not path.is_file():
        raise NoPicture(
            f"the machine cannot be drawn: its model is gone: put {path} back and make the report "
            "again"
        )
    try:
        spec = read_spec(path)
        spec.compiler.discardvisual = False  # as it is for a URDF
        if not any(t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for t in spec.textures):
            spec.add_texture(
                name="background of the report",
                type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
                builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
                rgb1=SKY,
                rgb2=GROUND,
                width=128,
                height=768,
            )
        if not spec.lights:
            spec.visual.headlight.ambient = [0.35] * 3
            spec.visual.headlight.diffuse = [0.3] * 3
            spec.worldbody.add_light(
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                dir=[-0.3, 0.4, -1.0],
                diffuse=[0.55] * 3,
                castshadow=True,
            )
        spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
        spec.visual.quality.offsamples, spec.visual.quality.shadowsize = SAMPLES, SHADOW
        return spec.compile()
    except ValueError as error:
        what = " ".join(str(error).split())
        raise NoPicture(
            f"the machine cannot be drawn: its model can no longer be read: {path}: {what}"
        ) from error
