"""Scenes: oriented boxes, padded to a fixed number with a mask."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write
from gnnjax.scene.shapes import for_every_kind

# Padded numbers of boxes; one compilation each. The first holds the paper's 2 to 9 boxes.
BOX_BUCKETS = (10, 16, 32, 64)

MOST_METERS = 1e4  # of any coordinate; single precision has lost a millimetre there

_IDENTITY_QUAT = (1.0, 0.0, 0.0, 0.0)

# What an obstacle of each kind has in a scene file, and how many numbers.
_JSON = for_every_kind("scene file", box={"center": 3, "half_extents": 3, "quat": 4})


class Scene(NamedTuple):
    """Oriented boxes in the frame of the arm's base, wherever its MJCF puts that."""

    centers: Float[Array, "*batch M 3"]  # m
    half_extents: Float[Array, "*batch M 3"]  # m, positive
    quats: Float[Array, "*batch M 4"]  # unit quaternions w x y z, box to base
    mask: Bool[Array, "*batch M"]  # true where the box exists


def box_bucket(num_boxes: int, source: str = "the scene") -> int:
    """The padded number of boxes for a scene of `num_boxes`."""
    for bucket in BOX_BUCKETS:
        if num_boxes <= bucket:
            return bucket
    raise InputError(
        f"{source} has {num_boxes} boxes; at most {BOX_BUCKETS[-1]} are supported, merge some"
    )


def make_scene(
    centers: Sequence | np.ndarray,
    half_extents: Sequence | np.ndarray,
    quats: Sequence | np.ndarray | None = None,
    *,
    max_boxes: int | None = None,
    source: str = "the scene",
) -> Scene:
    """Builds a scene from `[M, 3]`, `[M, 3]` and `[M, 4]` (or no quaternions: axis-aligned).

    Args:
        centers: box centres, m.
        half_extents: half the edge lengths, m.
        quats: orientations w x y z; normalized here.
        max_boxes: padded size; by default the smallest bucket that fits.
        source: how error messages call the scene, a file name for example.

    Raises:
        InputError: wrong shape, a number that is not finite or beyond 10 km, a size that is not
            positive, a quaternion of zeros.
    """
    centers = _rows("centers", centers, 3, source)
    half_extents = _rows("half_extents", half_extents, 3, source)
    num = len(centers)
    given = np.tile(_IDENTITY_QUAT, (num, 1)) if quats is None else quats
    rotations = _rows("quats", given, 4, source)
    if not num == len(half_extents) == len(rotations):
        raise InputError(
            f"{source} has {num} centers, {len(half_extents)} half_extents and "
            f"{len(rotations)} quats; give one of each a box"
        )
    for i in range(num):
        if not (half_extents[i] > 0).all():
            raise InputError(
                f"box {i} of {source} has half_extents {half_extents[i].tolist()}; "
                "all three must be positive (m)"
            )
    largest = np.abs(rotations).max(axis=1, initial=0.0)
    if num and largest.min() < 1e-3:
        raise InputError(
            f"box {int(largest.argmin())} of {source} has the quaternion "
            f"{rotations[int(largest.argmin())].tolist()}; give a rotation as w x y z, not zeros"
        )
    scene = Scene(
        centers.astype(np.float32),
        half_extents.astype(np.float32),
        unit_quats(rotations).astype(np.float32),
        np.ones(num, bool),
    )
    return pad_scene(scene, box_bucket(num, source) if max_boxes is None else max_boxes)


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Normalizes quaternions `[*batch, 4]`, however long they are; those of zeros stay."""
    quats = np.asarray(quats, float)
    # In double precision, and scaled first: the square of 1e20 is infinite in single precision.
    largest = np.abs(quats).max(axis=-1, keepdims=True)
    scaled = quats / np.where(largest > 0, largest, 1)
    norms = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return scaled / np.where(norms > 0, norms, 1)


def _rows(name: str, values: Sequence | np.ndarray, width: int, source: str) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} of {source} are not numbers; give {width} a box") from None
    if array.size == 0:
        return np.zeros((0, width))
    if array.ndim != 2 or array.shape[1] != width:
        raise InputError(f"{name} of {source} have shape {array.shape}; give {width} numbers a box")
    finite = np.isfinite(array)
    bad = ~finite.all(axis=1)
    if name != "quats":  # those are normalized, whatever their length
        bad |= (np.abs(array) > MOST_METERS).any(axis=1)
    if bad.any():
        raise InputError(
            f"box {int(bad.argmax())} of {source} has {name} {array[bad.argmax()].tolist()}; "
            f"all numbers must be finite, and lengths below {MOST_METERS:g} m"
        )
    return array


def pad_scene(scene: Scene, max_boxes: int) -> Scene:
    """Pads a NumPy scene `[*batch, M]` with boxes that do not exist, up to `max_boxes`."""
    missing = max_boxes - scene.mask.shape[-1]
    if missing < 0:
        raise InputError(
            f"the scene has room for {scene.mask.shape[-1]} boxes, more than {max_boxes}; "
            "raise max_boxes"
        )

    def pad(array: np.ndarray, value: float | bool) -> np.ndarray:
        axis = scene.mask.ndim - 1
        widths = [(0, 0)] * array.ndim
        widths[axis] = (0, missing)
        return np.pad(np.asarray(array), widths, constant_values=value)

    quats = pad(scene.quats, 0.0)
    quats[..., scene.mask.shape[-1] :, 0] = 1.0
    # Padding boxes have a size, so that nothing divides by zero.
    return Scene(
        pad(scene.centers, 0.0), pad(scene.half_extents, 0.1), quats, pad(scene.mask, False)
    )


def pad_boxes(scene: Scene, max_boxes: int) -> Scene:
    """`pad_scene` inside of compiled functions: room for `max_boxes`, existing boxes as before."""
    pad = max_boxes - scene.mask.shape[-1]
    identity = jnp.tile(jnp.array(_IDENTITY_QUAT), (pad, 1))
    return Scene(
        jnp.pad(scene.centers, ((0, pad), (0, 0))),
        jnp.pad(scene.half_extents, ((0, pad), (0, 0)), constant_values=0.1),
        jnp.concatenate([scene.quats, identity]),
        jnp.pad(scene.mask, (0, pad)),
    )


def is_axis_aligned(scene: Scene) -> bool:
    """Whether no existing box of the scene, or batch of scenes, is rotated (host side)."""
    quats = np.asarray(scene.quats)[np.asarray(scene.mask)]
    # Not by w, which float32 rounds to 1 for rotations of nearly 1 mrad.
    return bool((np.abs(quats[:, 1:]) < 1e-7).all())


def last_box(mask: Bool[Array, "*batch M"]) -> Int[Array, ""]:
    """How many boxes have to be looked at: none after the last that exists in any scene."""
    return jnp.max(jnp.where(mask, jnp.arange(1, mask.shape[-1] + 1), 0), initial=0)


def rotation_matrices(quats: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of unit quaternions w x y z."""
    w, x, y, z = jnp.moveaxis(quats, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def scene_from_json(path: str | Path) -> Scene:
    """Reads `{"boxes": [{"center": [x,y,z], "half_extents": [x,y,z], "quat": [w,x,y,z]}]}`.

    Raises:
        InputError: the file is missing, is no JSON, holds anything but boxes, or a box lacks what
            it needs.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        data = json.loads(text, object_pairs_hook=_unrepeated)
    except FileNotFoundError:
        raise InputError(f"no scene file {str(path)!r}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"scene file {str(path)!r} is a folder; name a file") from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, or nested without end
        raise InputError(f"scene file {str(path)!r} is no JSON: {error}; mend it") from None
    # What is not read would be planned through.
    unknown = sorted(data.keys() - {"boxes"}) if isinstance(data, dict) else []
    if unknown:
        raise InputError(
            f'scene file {str(path)!r} has {unknown}, and only "boxes" are known; enclose such '
            "obstacles in boxes, and remove what is none"
        )
    boxes = data.get("boxes") if isinstance(data, dict) else None
    if not isinstance(boxes, list):
        raise InputError(
            f'scene file {str(path)!r} lacks the list "boxes"; write {{"boxes": [...]}}'
        )
    box_bucket(len(boxes), repr(str(path)))  # too many are refused before each is looked at
    for i, box in enumerate(boxes):
        _check_json_box(box, f"box {i} of {str(path)!r}")
    return make_scene(
        [box["center"] for box in boxes],
        [box["half_extents"] for box in boxes],
        [box.get("quat", list(_IDENTITY_QUAT)) for box in boxes],
        source=repr(str(path)),
    )


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object as a dict; of a name that comes twice, JSON would drop the first value."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{max(names, key=names.count)!r} comes twice in one object")
    return found


def _check_json_box(box: Any, called: str) -> None:
    widths = _JSON["box"]
    # A misspelled "quat" must not leave a box unrotated.
    if not isinstance(box, dict) or not box.keys() <= widths.keys():
        found = brief(sorted(box) if isinstance(box, dict) else box)
        raise InputError(f"{called} has {found}; give center, half_extents and, if rotated, quat")
    for name, width in widths.items():
        if name == "quat" and name not in box:
            continue
        value = box.get(name)
        # Booleans and strings would pass for numbers in NumPy.
        numbers = isinstance(value, list) and all(type(x) in (int, float) for x in value)
        if not numbers or len(value) != width:
            raise InputError(
                f"{called} has {name} = {brief(value)}; give a list of {width} numbers"
            )


def scene_to_json(scene: Scene, path: str | Path) -> None:
    """Writes the existing boxes of one scene as JSON that `scene_from_json` reads."""
    mask = np.asarray(scene.mask)
    rows = zip(
        np.asarray(scene.centers)[mask].tolist(),
        np.asarray(scene.half_extents)[mask].tolist(),
        np.asarray(scene.quats)[mask].tolist(),
        strict=True,
    )
    boxes = [{"center": c, "half_extents": h, "quat": q} for c, h, q in rows]
    text = json.dumps({"boxes": boxes}, indent=1)
    atomic_write(path, lambda file: file.write_text(text + "\n", encoding="utf-8"))


def sample_scene(
    key: jax.Array,
    boxes_clear: Callable[[Scene], Bool[Array, " M"]],
    *,
    max_boxes: int = BOX_BUCKETS[0],
    min_num: int = 2,
    max_num: int = 9,
    candidates: int = 8,
) -> Scene:
    """Draws a scene of the paper: axis-aligned boxes that leave the arm at q = 0 free.

    Between `min_num` and `max_num` boxes, half extents uniform in [0.1, 0.3] m and centres uniform
    in [-1, 1] x [-1, 1] x [0.5, 1.3] m. A box that touches the arm is drawn again: of `candidates`
    draws a box, the first that is clear counts, and a box with none is left out (about 1 in 10^8
    for the iiwa, which touches 9 % of them).

    Args:
        key: randomness.
        boxes_clear: tells for each box of a scene whether the arm at q = 0 is clear of it.
    """
    num_key, size_key, center_key = jax.random.split(key, 3)
    shape = (max_boxes * candidates, 3)
    half_extents = jax.random.uniform(size_key, shape, minval=0.1, maxval=0.3)
    centers = jax.random.uniform(
        center_key, shape, minval=jnp.array([-1.0, -1.0, 0.5]), maxval=jnp.array([1.0, 1.0, 1.3])
    )
    quats = jnp.tile(jnp.array(_IDENTITY_QUAT), (shape[0], 1))
    everything = Scene(centers, half_extents, quats, jnp.ones(shape[0], bool))
    clear = boxes_clear(everything).reshape(max_boxes, candidates)
    chosen = jnp.arange(max_boxes) * candidates + jnp.argmax(clear, axis=1)
    num = jax.random.randint(num_key, (), min_num, max_num + 1)
    mask = (jnp.arange(max_boxes) < num) & jnp.any(clear, axis=1)
    return Scene(centers[chosen], half_extents[chosen], quats[chosen], mask)
