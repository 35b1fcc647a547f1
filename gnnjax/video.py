"""Films of motions: the arm among the obstacles, drawn by MuJoCo off screen.

That takes OpenGL: where there is no display, MUJOCO_GL=egl (or osmesa) must be set when Python
starts.
"""

import itertools
import warnings
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, needs_extra, one_line
from gnnjax.files import atomic_write, check_target
from gnnjax.scene.allowed import last_link
from gnnjax.scene.mujoco_world import obstacles, place_obstacles, world_spec
from gnnjax.scene.scene import Scene

_RATE = 20  # frames a second, which GIF has exactly
_STILL = 0.5  # s, of the last frame
_WIDTH, _HEIGHT = 640, 480
_HIDDEN = 5  # group of geoms that is not drawn
_LINKS = (0.3, 0.5, 0.72, 1.0), (0.72, 0.78, 0.84, 1.0)  # one after the other
_OBSTACLE, _TRACE = (0.8, 0.62, 0.42, 0.5), (0.85, 0.2, 0.2, 1.0)
_NEAR = 2.0  # m; by a hundredth of this and more is away what is drawn
_AZIMUTH, _ELEVATION = 55, -25  # degrees, of the camera


def check_video(out: str | Path) -> Path:
    """Returns the path of a film that `draw_video` can write.

    Raises:
        InputError: another ending, an encoder that is not installed, or no OpenGL.
    """
    path = check_target(out)
    if path.suffix.lower() not in _ENCODERS:
        raise InputError(f"video {str(out)!r} has the ending {path.suffix!r}; give .gif or .mp4")
    with needs_extra(path.suffix, "video"):
        _IMPORTS[path.suffix.lower()]()
    _renderer(mujoco.MjSpec().compile(), 16, 16, 0).close()
    return path


def draw_video(
    robot: Robot, scene: Scene, times: np.ndarray, positions: np.ndarray, out: str | Path
) -> None:
    """Films a motion as fast as it is, with the way of the last body's origin, into a file.

    Args:
        robot: the arm, drawn as the parts that it collides as.
        scene: one scene.
        times: `[T]` s, ascending.
        positions: `[T, D]` configurations.
        out: .gif, or .mp4.

    Raises:
        InputError: see `check_video`.
    """
    path = check_video(out)
    frames = _frames(robot, scene, times, positions)
    atomic_write(path, lambda file: _ENCODERS[path.suffix.lower()](frames, file))


def _frames(
    robot: Robot, scene: Scene, times: np.ndarray, positions: np.ndarray
) -> Iterator[np.ndarray]:
    """Pictures `[H, W, 3]`."""
    model = _stage(robot, scene)
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene._replace(allowed=None))
    at = np.append(np.arange(times[0], times[-1], 1 / _RATE), times[-1])
    shots = np.stack([np.interp(at, times, column) for column in positions.T], axis=1)
    tips, low, high = np.empty((len(at), 3)), np.full(3, np.inf), np.full(3, -np.inf)
    for number, q in enumerate(shots):
        data.qpos = q
        mujoco.mj_forward(model, data)
        tips[number] = data.xpos[last_link(robot) + 1]
        places = data.geom_xpos[robot.part_geoms]
        low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
    camera = mujoco.MjvCamera()
    camera.lookat = (low + high) / 2
    camera.distance = 0.9 + 1.2 * np.linalg.norm(high - low)
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    renderer = _renderer(model, _WIDTH, _HEIGHT, len(at))
    try:
        for number, q in enumerate(shots):
            data.qpos = q
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            for first, second in itertools.pairwise(tips[: number + 1]):
                _add_line(renderer.scene, first, second)
            frame = renderer.render()
            yield frame
        for _ in range(round(_STILL * _RATE)):
            yield frame
    finally:
        renderer.close()


def _stage(robot: Robot, scene: Scene) -> mujoco.MjModel:
    """The world with a bright background and a lamp, of which only what can collide is drawn."""
    spec = world_spec(robot, len(scene.mask), scene.cloud)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = _WIDTH, _HEIGHT
    spec.visual.headlight.ambient = [0.45] * 3
    spec.visual.headlight.diffuse = [0.35] * 3
    spec.worldbody.add_light(
        pos=[0, 0, 4],
        dir=[0.3, 0.4, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False,
    )
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    spec.add_texture(
        name="background of a film",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.98, 0.98, 0.99],
        rgb2=[0.85, 0.87, 0.9],
        width=64,
        height=384,
    )
    model = spec.compile()
    model.stat.extent = _NEAR  # not that of obstacles that are far away: what is near is cut off
    arm = np.arange(robot.mj_model.ngeom)
    shown = robot.part_geoms
    model.geom_group[arm] = _HIDDEN
    model.geom_group[shown] = 0
    model.geom_matid[shown] = -1
    model.geom_rgba[shown] = np.array(_LINKS)[model.geom_bodyid[shown] % 2]
    boxes = obstacles(model, len(scene.mask)).geoms
    model.geom_group[boxes[~np.asarray(scene.mask)]] = _HIDDEN
    model.geom_rgba[boxes] = _OBSTACLE
    return model


def _add_line(scene: mujoco.MjvScene, first: np.ndarray, second: np.ndarray) -> None:
    if (first == second).all():
        return
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.float32(_TRACE))
    mujoco.mjv_connector(geom, kind, 0.006, first, second)
    scene.ngeom += 1


def _renderer(model: mujoco.MjModel, width: int, height: int, lines: int) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, height, width, max_geom=model.ngeom + lines + 100)
    except Exception as error:  # each of OpenGL's libraries raises another one
        raise InputError(
            f"MuJoCo has no OpenGL to draw a video with ({one_line(str(error), 100)}); install EGL "
            "or OSMesa, and start the command with MUJOCO_GL=egl or MUJOCO_GL=osmesa"
        ) from None


def _write_gif(frames: Iterator[np.ndarray], file: Path) -> None:
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    # One palette for all frames, without dithering: what rests stays the same, and takes no room.
    palette = rest[-1].quantize(128, dither=Image.Dither.NONE)
    each = [x.quantize(palette=palette, dither=Image.Dither.NONE) for x in (first, *rest)]
    each[0].save(
        file, save_all=True, append_images=each[1:], duration=1000 // _RATE, loop=0, format="GIF"
    )


def _write_mp4(frames: Iterator[np.ndarray], file: Path) -> None:
    from imageio_ffmpeg import write_frames  # pyright: ignore[reportMissingImports]

    writer = write_frames(str(file), (_WIDTH, _HEIGHT), fps=_RATE, macro_block_size=2)
    with warnings.catch_warnings():  # JAX warns of processes that fork; this one becomes ffmpeg
        warnings.simplefilter("ignore", RuntimeWarning)
        writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def _import_pillow() -> None:
    import PIL.Image  # noqa: F401


def _import_ffmpeg() -> None:
    import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]


_ENCODERS = {".gif": _write_gif, ".mp4": _write_mp4}
_IMPORTS = {".gif": _import_pillow, ".mp4": _import_ffmpeg}
