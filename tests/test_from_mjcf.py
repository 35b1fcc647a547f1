"""Obstacles from MuJoCo models: C's engine finds them where we do, and the robot is left out."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax import load_robot, scene_from_mjcf
from gnnjax.errors import InputError
from gnnjax.scene.any_file import read_scene
from gnnjax.scene.geometry import signed_distance
from gnnjax.scene.scene import Scene, rotation_matrices
from gnnjax.scene.shapes import KINDS, kind_of

TABLE = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.3" euler="0.1 0.2 0"/>
    <geom type="box" size="0.4 0.5 0.02" pos="0.5 0 0.1" euler="0.1 0.2 0.3"/>
    <geom name="sign" type="mesh" mesh="tetra" contype="0" conaffinity="0"/>
    <body pos="0.5 0.2 0.2" euler="0 0 1">
      <freejoint/>
      <geom type="cylinder" size="0.06 0.1" euler="0.5 0 0"/>
      <body name="lid" pos="0 0 0.15"><geom type="sphere" size="0.05"/></body>
    </body>
    <body name="rail" pos="-0.4 0 0.3" euler="0 1 0">
      <geom type="capsule" size="0.05" fromto="0 -0.3 0 0.1 0.3 0.2"/>
    </body>
  </worldbody>
  <asset><mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <keyframe><key name="fallen" qpos="-0.3 0.4 0 1 0 0 0"/></keyframe>
</mujoco>
"""
PROBE = 0.02  # m


def written(folder, text, name="world.xml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def kinds_of(scene: Scene) -> list[str]:
    return [KINDS[k] for k in kind_of(scene.half_extents, scene.radii)[scene.mask]]


def distances(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Of points `[P, 3]` to the nearest obstacle."""
    scene = jax.tree.map(jnp.asarray, scene)
    turned = rotation_matrices(scene.quats).swapaxes(-1, -2)
    extents, radii = scene.half_extents, scene.radii

    def one(point):
        seen = jnp.einsum("mij,mj->im", turned, point - scene.centers)
        away = signed_distance(list(seen), list(extents.T), *radii.T)
        return jnp.where(scene.mask, away, jnp.inf).min()

    return np.asarray(jax.vmap(one)(jnp.asarray(points, jnp.float32)))


def samples(scene: Scene) -> np.ndarray:
    """Points `[P, 3]` all about, and 200 near each obstacle, a good part of them inside."""
    rng, near = np.random.default_rng(0), scene.mask & (scene.half_extents[:, 0] < 10)
    extents = scene.half_extents[near].max(axis=1) + scene.radii[near].max(axis=1)
    about = rng.normal(0.0, 0.5, (200, near.sum(), 3)) * extents[:, None] + scene.centers[near]
    return np.concatenate([rng.uniform(-1, 1, (400, 3)), about.reshape(-1, 3)])


def touched(path, points: np.ndarray, left_out=(), qpos=None) -> np.ndarray:
    """Whether C's engine finds a contact of a small ball at points `[P, 3]` with the model."""
    spec = mujoco.MjSpec.from_file(str(path))
    # MuJoCo lets no two things touch of which neither can move.
    probe = spec.worldbody.add_body(name="the_probe")
    probe.add_freejoint()
    probe.add_geom(size=[PROBE, 0, 0], contype=-1, conaffinity=-1)
    for key in list(spec.keys):
        spec.delete(key)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:-7] = model.qpos0[:-7] if qpos is None else qpos
    found, ball = [], model.ngeom - 1
    for point in points:
        data.qpos[-7:-4] = point
        mujoco.mj_fwdPosition(model, data)
        pairs = [set(pair) for pair in data.contact.geom.tolist()]
        others = {g for pair in pairs if ball in pair for g in pair - {ball}}
        names = {model.body(model.geom_bodyid[g]).name for g in others}
        found.append(bool(names - set(left_out)))
    return np.array(found)


@pytest.mark.parametrize("keyframe", [None, "fallen"])
def test_obstacles_are_where_the_c_engine_has_them(tmp_path, keyframe):
    path = written(tmp_path, TABLE)
    scene = scene_from_mjcf(path, keyframe=keyframe)
    assert sorted(kinds_of(scene)) == ["box", "capsule", "cylinder", "half_space", "sphere"]
    points = samples(scene)
    away = distances(scene, points)
    clear = np.abs(away - PROBE) > 1e-4
    qpos = None if keyframe is None else [-0.3, 0.4, 0, 1, 0, 0, 0]
    found = touched(path, points, qpos=qpos)
    np.testing.assert_array_equal(found[clear], (away < PROBE)[clear])
    assert 0.1 < found.mean() < 0.9


def test_names_that_are_ignored_are_left_out_with_what_hangs_on_them(tmp_path):
    path = written(tmp_path, TABLE)
    scene = scene_from_mjcf(path, ignore=["floor", "rail"])
    assert sorted(kinds_of(scene)) == ["box", "cylinder", "sphere"]
    with pytest.raises(InputError, match=r"no body or geom 'rial' to ignore .* \['lid', 'rail'\]"):
        scene_from_mjcf(path, ignore=["rial"])
    with pytest.raises(InputError, match="no body or geom '' to ignore"):
        scene_from_mjcf(path, ignore=[""])
    with pytest.raises(InputError, match="ignore is 'rail'; give a list"):
        scene_from_mjcf(path, ignore="rail")
    with pytest.raises(InputError, match=r"no keyframe 'home' in .*; there are \['fallen'\]"):
        scene_from_mjcf(path, keyframe="home")


# A robot whose base its file lifts, with nameless links and a mount beside it in the world.
ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    {mount}
    <body name="base" {place}>
      <geom type="box" size="0.1 0.1 0.1" contype="1" conaffinity="1"/>
      <body name="upper" pos="0 0 0.2">
        <joint name="a" axis="0 0 1" range="-3 3"/>
        <geom type="sphere" size="0.08" pos="0.2 0 0" mass="1"/>
        <body pos="0.4 0 0">
          <joint name="b" axis="0 1 0" range="-2.5 2.5"/>
          <geom type="sphere" size="0.08" pos="0.15 0 0" mass="1"/>
          {more}
        </body>
        {tool}
      </body>
      {camera}
    </body>
    {world}
  </worldbody>
</mujoco>
"""
PARTS = dict.fromkeys("mount place more tool camera world".split(), "")
MOUNT = '<geom type="sphere" size="0.05" pos="0 0 0.45"/>'
WORLD = """
<geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.4" euler="0.1 0 0"/>
<body pos="0.9 0 0.4" euler="0 0 0.3"><geom type="box" size="0.2 0.3 0.1"/></body>
<body name="drawer" pos="-0.5 0.6 0.5">
  <joint name="slide" type="slide" axis="1 0 0" range="0 0.3"/>
  <geom type="cylinder" size="0.1 0.2" mass="1"/>
</body>
"""
PLACE = 'pos="0.1 0.2 0.5" euler="0.3 0 0.5"'
OTHER_PLACE = 'pos="0.4 -0.2 0.6" euler="0 0.2 -0.4"'
LATER_MOUNT = '<geom type="sphere" size="0.05" pos="{} {} {}" quat="{} {} {} {}"/>'


def arm(**parts) -> str:
    return ARM.format(**(PARTS | parts))


def test_the_scene_is_seen_from_the_base_of_the_robot_in_it(tmp_path):
    robot = load_robot(written(tmp_path, arm(place=PLACE, mount=MOUNT), "arm.xml"))
    # The scene has the arm elsewhere, and its mount with it: as the base sees it in its own file.
    own = robot.mj_model
    fixed = int(np.flatnonzero((own.geom_bodyid == 0) & (own.geom_type == 2))[0])
    spot, turned = own.geom_pos[fixed], np.zeros(4)
    empty = mujoco.MjModel.from_xml_string(arm(place=OTHER_PLACE))
    data = mujoco.MjData(empty)
    mujoco.mj_kinematics(empty, data)
    base = data.body("base")
    turn = base.xmat.reshape(3, 3)
    mujoco.mju_mulQuat(turned, base.xquat, own.geom_quat[fixed])
    mount = LATER_MOUNT.format(*(turn @ spot + base.xpos), *turned)
    path = written(tmp_path, arm(place=OTHER_PLACE, mount=mount, world=WORLD))
    scene = scene_from_mjcf(path, robot=robot)
    assert sorted(kinds_of(scene)) == ["box", "cylinder", "half_space"]
    points = samples(scene)
    away = distances(scene, points)
    clear = np.abs(away - PROBE) > 1e-4
    bare = written(tmp_path, arm(place=OTHER_PLACE, world=WORLD), "bare.xml")
    links = ("base", "upper", "link")
    bare.write_text(bare.read_text().replace('<body pos="0.4 0 0">', '<body name="link">'))
    found = touched(bare, points @ turn.T + base.xpos, left_out=links)
    np.testing.assert_array_equal(found[clear], (away < PROBE)[clear])
    assert 0.1 < found.mean() < 0.9


def test_a_first_link_that_hangs_in_the_world_is_where_its_joint_is_at_zero(tmp_path, tiny_path):
    robot = load_robot(tiny_path)
    text = tiny_path.read_text()
    ball = '<geom name="ball" type="sphere" size="0.2" pos="1 2 3"/>'
    alone = text.replace("</worldbody>", f"{ball}</worldbody>").replace(
        "</mujoco>", '<keyframe><key name="bent" qpos="1 1 1"/></keyframe></mujoco>'
    )
    for keyframe in (None, "bent"):
        scene = scene_from_mjcf(written(tmp_path, alone), robot=robot, keyframe=keyframe)
        assert kinds_of(scene) == ["sphere"]  # not the arm's own sphere in the world
        np.testing.assert_allclose(scene.centers[0], [1, 2, 3], atol=1e-6)
    # Held, it is the base, and stands where it is held, whether or not MuJoCo would fuse it.
    cos, sin = np.cos(0.7), np.sin(0.7)
    for more in ("", ' fusestatic="true"'):
        own, world = (
            written(tmp_path, x.replace("<compiler", f"<compiler{more}"), name)
            for x, name in ((text, "own.xml"), (alone, "world.xml"))
        )
        scene = scene_from_mjcf(world, robot=load_robot(own, hold={"a": 0.7}))
        np.testing.assert_allclose(scene.centers[0], [cos + 2 * sin, 2 * cos - sin, 3], atol=1e-6)


@pytest.mark.parametrize("name", ["kuka_iiwa14", "franka_panda"])
def test_a_scene_that_includes_a_shipped_robot_has_only_the_rest(tmp_path, caplog, name):
    robot = load_robot(name)
    text = f"""
    <mujoco><include file="{robot.path.resolve()}"/>
      <worldbody>
        <geom name="floor" type="plane" size="0 0 0.05"/>
        <body name="cube" pos="0.5 0 0.2"><geom type="box" size="0.1 0.1 0.1"/></body>
      </worldbody>
    </mujoco>"""
    scene = scene_from_mjcf(written(tmp_path, text), robot=robot)
    assert kinds_of(scene) == ["box", "half_space"]
    assert not caplog.records  # of what the robot looks like
    np.testing.assert_allclose(scene.centers[0], [0.5, 0, 0.2], atol=1e-6)
    with pytest.raises(InputError, match="moves by a joint; if that is the robot, give robot="):
        scene_from_mjcf(written(tmp_path, text))
    first = robot.mj_model.body(1).name
    assert kinds_of(scene_from_mjcf(written(tmp_path, text), ignore=[first])) == kinds_of(scene)


def test_what_a_robot_carries_and_does_not_have_is_refused(tmp_path):
    robot = load_robot(written(tmp_path, arm(), "arm.xml"))
    tool = '<body name="tool"><geom type="box" size="0.1 0.1 0.1"/></body>'
    nameless = '<body><body><geom type="box" size="0.1 0.1 0.1"/></body></body>'
    for part in ({"tool": tool}, {"more": nameless}, {"tool": nameless}):
        path = written(tmp_path, arm(**part))
        with pytest.raises(InputError, match="is carried by arm, whose own model lacks it"):
            scene_from_mjcf(path, robot=robot)
    assert not scene_from_mjcf(
        written(tmp_path, arm(tool=tool)), robot=robot, ignore=["tool"]
    ).mask.any()
    # On the base, which does not move, it is an obstacle like others.
    camera = '<body name="camera" pos="0 1 0"><geom type="sphere" size="0.1"/></body>'
    assert kinds_of(scene_from_mjcf(written(tmp_path, arm(camera=camera)), robot=robot)) == [
        "sphere"
    ]


@pytest.mark.parametrize("inside", ["", '<body name="upper"><geom size="0.1"/></body>'])
def test_what_is_only_called_like_the_robot_is_an_obstacle(tmp_path, inside):
    robot = load_robot(written(tmp_path, arm(), "arm.xml"))
    path = written(
        tmp_path,
        f"""
        <mujoco><worldbody><body name="base" pos="1 0 0">
          <geom type="box" size="0.1 0.1 0.1"/>{inside}
        </body></worldbody></mujoco>""",
    )
    assert kinds_of(read_scene(path, robot)) == ["box", "sphere"][: 1 + bool(inside)]
    with pytest.raises(InputError, match=r"none of the first bodies of arm .* in their places"):
        scene_from_mjcf(path, robot=robot)


def test_what_a_link_has_there_and_not_in_its_own_file_is_not_left_out(tmp_path):
    robot = load_robot(written(tmp_path, arm(), "arm.xml"))
    geom = '<geom name="own" type="box" size="0.2 0.3 0.02" pos="0 0 -0.5"/>'
    on_base = written(tmp_path, arm(camera=geom))
    assert kinds_of(scene_from_mjcf(on_base, robot=robot)) == ["box"]
    # What moves with the arm is no obstacle, and no part of it.
    path = written(tmp_path, arm(more=geom))
    with pytest.raises(
        InputError, match=r"geom own .of body .* is no part of arm, whose own model"
    ):
        scene_from_mjcf(path, robot=robot)
    assert not scene_from_mjcf(path, robot=robot, ignore=["own"]).mask.any()


def test_what_is_soft_is_refused_by_name_in_scenes_and_arms(tmp_path):
    pinned = """
      <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2">
        <pin gridrange="0 0 2 2"/><edge equality="true"/>
      </flexcomp>"""
    path = written(tmp_path, f"<mujoco><worldbody>{pinned}</worldbody></mujoco>")
    with pytest.raises(InputError, match=r"flex 'cloth' of .* is soft, which is not read; enclose"):
        scene_from_mjcf(path)
    assert not scene_from_mjcf(path, ignore=["cloth"]).mask.any()
    with pytest.raises(InputError, match=r"flex 'cloth' of .* is soft, which no arm can be here"):
        load_robot(written(tmp_path, arm(world=pinned), "soft.xml"))


def test_a_nameless_body_of_the_world_is_not_the_robots(tmp_path):
    nameless = arm().replace('body name="base"', "body")
    robot = load_robot(written(tmp_path, nameless, "arm.xml"))
    with pytest.raises(InputError, match="holds none of the first bodies of arm"):
        scene_from_mjcf(written(tmp_path, TABLE), robot=robot)


def test_meshes_and_height_fields_are_enclosed_where_they_stand(tmp_path):
    text = """
    <mujoco>
      <asset>
        <mesh name="tetra" vertex="0 0 0 0.3 0 0 0 0.2 0 0 0 0.4"/>
        <hfield name="hills" nrow="2" ncol="3" size="0.2 0.1 0.3 0.1" elevation="0 1 0 0 0.5 1"/>
      </asset>
      <worldbody>
        <body name="thing" pos="0.5 0.1 0.2" euler="0 0 90">
          <geom type="mesh" mesh="tetra" pos="0 0 0.1"/>
        </body>
        <geom type="hfield" hfield="hills" pos="-0.6 0 0.1"/>
      </worldbody>
    </mujoco>"""
    scene = scene_from_mjcf(written(tmp_path, text))
    assert scene.cloud is not None
    points = scene.cloud.points[: scene.cloud.num]
    radius = float(scene.cloud.radius)
    # Turned about z, x is where y was: corners of the tetrahedron, and of the field and its base.
    tetra = np.add([[0, 0, 0], [0, 0.3, 0], [-0.2, 0, 0], [0, 0, 0.4]], [0.5, 0.1, 0.3])
    heights = [[0, 0.15, 0.3], [0, 0.3, 0]]  # MuJoCo's files have the farthest row first
    field = [
        [x - 0.6, y, z + 0.1]
        for y, row in zip((-0.1, 0.1), heights, strict=True)
        for x, height in zip((-0.2, 0, 0.2), row, strict=True)
        for z in (height, -0.1)
    ]
    apart = np.linalg.norm(points - np.array([*tetra, *field])[:, None], axis=2).min(axis=1)
    assert (apart <= radius).all()
    low, high = tetra.min(axis=0) - 0.01, tetra.max(axis=0) + 0.01
    mine = points[points[:, 0] > 0]
    assert ((mine >= low) & (mine <= high)).all()
    # Of the corner that is farthest from the slanted face, nothing is covered on its other side.
    assert (((mine - tetra[0]) / [-0.2, 0.3, 0.4]).sum(axis=1) < 1.08).all()
    beside = points[points[:, 0] < 0]
    assert ((beside >= [-0.81, -0.11, -0.01]) & (beside <= [-0.39, 0.11, 0.41])).all()


def test_geoms_that_are_not_read_are_refused_by_name(tmp_path):
    geom = '<geom name="odd" type="ellipsoid" size="0.1 0.2 0.3"/>'
    text = f'<mujoco><worldbody><body name="thing">{geom}</body></worldbody></mujoco>'
    path = written(tmp_path, text)
    fault = "geom odd .of body thing. .* is of the type ellipsoid, which is not read; enclose it"
    with pytest.raises(InputError, match=fault):
        scene_from_mjcf(path)
    assert not scene_from_mjcf(path, ignore=["odd"]).mask.any()


def test_a_geom_that_collides_in_an_explicit_pair_alone_is_an_obstacle(tmp_path):
    ghost = '<geom name="{}" type="sphere" size="1" contype="0" conaffinity="0"/>'
    text = f"""
    <mujoco><worldbody>
      {ghost.format("seen")}<body><freejoint/>{ghost.format("one")}{ghost.format("other")}</body>
      </worldbody><contact><pair geom1="seen" geom2="one"/></contact></mujoco>"""
    text = text.replace('name="other"', 'name="other" mass="1"')
    assert kinds_of(scene_from_mjcf(written(tmp_path, text))) == ["sphere", "sphere"]


@pytest.mark.parametrize("discards", ["false", "true"])
def test_geoms_for_looks_are_told_of_and_refused_where_all_are(tmp_path, caplog, discards):
    lamp = '<body name="lamp"><geom name="glow" size="0.1" contype="0" conaffinity="0"/></body>'
    text = f'<mujoco><compiler discardvisual="{discards}"/><worldbody>{lamp}</worldbody></mujoco>'
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=r": 1, the first is geom glow .*; nothing else is there"):
        scene_from_mjcf(path)
    assert not scene_from_mjcf(path, ignore=["lamp"]).mask.any()
    assert not scene_from_mjcf(path, ignore=["glow"]).mask.any()
    assert not caplog.records
    path = written(tmp_path, text.replace("<worldbody>", '<worldbody><geom size="0.1"/>'))
    assert kinds_of(scene_from_mjcf(path)) == ["sphere"]
    (told,) = caplog.messages
    assert "for looks alone (contype and conaffinity 0) are no obstacles: 1, the first" in told


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "MuJoCo cannot read"),
        ("no XML", "MuJoCo cannot read"),
        (
            '<mujoco><worldbody><geom size="1" pos="nan 0 0"/></worldbody></mujoco>',
            "must be finite|MuJoCo cannot read",
        ),
    ],
)
def test_files_that_are_no_models_are_refused(tmp_path, text, fault):
    path = written(tmp_path, text)
    with pytest.raises(InputError, match=fault):
        scene_from_mjcf(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no MJCF file at '.*none.xml'; check the path"):
        scene_from_mjcf(tmp_path / "none.xml")


@pytest.mark.parametrize("size", ["0.2 0.05 0.3", "0.62 0.02 0.02"])
def test_what_lies_between_the_posts_of_a_base_is_an_obstacle(tmp_path, size):
    """Within the box around them, and, of the second, with its corners in them."""
    base = (
        '<body name="base"><geom type="box" pos="0.6 0 0" size="0.05 0.05 0.5"/>'
        '<geom type="box" pos="-0.6 0 0" size="0.05 0.05 0.5"/>{}'
        '<body name="link" pos="0 0 1"><joint range="-90 90"/><geom size="0.1"/></body></body>'
    )
    world = "<mujoco><worldbody>{}</worldbody></mujoco>"
    robot = load_robot(written(tmp_path, world.format(base.format("")), "arm.xml"))
    between = f'<geom type="box" size="{size}" pos="0 0 0.1"/>'
    scene = scene_from_mjcf(written(tmp_path, world.format(base.format(between))), robot=robot)
    assert kinds_of(scene) == ["box"]
