"""Settings and robots that several test files share."""

import atexit
import functools
import gc
import importlib.util
import os
import runpy

import tests.typed  # noqa: F401  before what it makes faster
from tests.compiling import ENVIRONMENT

os.environ.update(ENVIRONMENT)  # which commands that tests start read, too

import jax
import numpy as np
import pytest
from _pytest.unraisableexception import gc_collect_iterations_key
from jax._src.api import clean_up

from gnnjax.arm import covers
from gnnjax.arm.robot import load_robot
from gnnjax.collision import bounds, certify, contact_cells, sequences, spheres
from gnnjax.planning import attempts, pool
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene
from tests.arms import CAPSULES

# Arms that tests make up have few spheres a part, which leave more to the parts themselves.
covers._MOST = 3
# And few maps, of few cells, which code that was compiled in a hurry works out.
contact_cells._WORTH, contact_cells._MANY = {1: 0.02, 2: 0.02, 3: 1.0}, 1000
contact_cells._BITS, contact_cells._AT_ONCE = {1: 8, 2: 12, 3: 14}, 128
# Calls are of one size each, where sizes are not what a test is about.
_ONE_SIZE = [
    (sequences, "_BLOCKS", (64, 64, 64)),
    (pool, "_SIZES", (16, 64, 256)),
    (attempts, "_CHUNKS", (2, 2)),
]
_ALL_SIZES = [(module, name, getattr(module, name)) for module, name, _ in _ONE_SIZE]
for _setting in _ONE_SIZE:
    setattr(*_setting)


TINY = """
<mujoco model="tiny">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom type="sphere" size="0.1" contype="1" conaffinity="1"/>
    <body name="upper">
      <joint name="a" axis="0 0 1" range="-3 3"/>
      <geom type="sphere" size="0.08" pos="0.2 0 0" mass="1"/>
      <body name="middle" pos="0.4 0 0">
        <joint name="b" axis="0 1 0" range="-2.5 2.5"/>
        <geom type="sphere" size="0.08" pos="0.15 0 0" mass="1"/>
        <body name="lower" pos="0.3 0 0" quat="1 0 0 1">
          <joint name="c" axis="0 0.6 0.8" pos="0.02 0 0" range="-2 2"/>
          <geom type="sphere" size="0.07" pos="0.15 0 0.02" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="session")
def tiny_path(tmp_path_factory):
    """An arm of three joints and four spheres, whose kernels compile in a second."""
    path = tmp_path_factory.mktemp("robots") / "tiny.xml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="session")
def tiny(tiny_path):
    """That arm, which reaches 1 m."""
    return load_robot(tiny_path)


@pytest.fixture(scope="session")
def capsules(tmp_path_factory):
    """An arm of capsules and a sphere, that meets itself."""
    path = tmp_path_factory.mktemp("robots") / "capsules.xml"
    path.write_text(CAPSULES)
    return load_robot(path)


@pytest.fixture
def in_tables(monkeypatch):
    """As of arms with many spheres: several passes, and tables of pairs with some in a row."""
    for name, value in {"_MOST_IN_CODE": 0, "_PAIRS_A_ROW": 16, "_SPHERES_A_PASS": 16}.items():
        monkeypatch.setattr(spheres, name, value)


@pytest.fixture(scope="session")
def walled():
    """A problem of that arm, whose straight line is blocked by three boxes, `[1, ...]`."""
    scene = make_scene(
        [[0.55, 0.35, 0.1], [0.45, -0.4, 0.3], [0.0, 0.0, 0.9]],
        np.full((3, 3), 0.12),
        max_obstacles=3,
    )
    start, goal = np.array([[1.6, 0.0, 0.0], [-1.6, 0.0, 0.3]], np.float32)
    return jax.tree.map(lambda x: np.asarray(x)[None], Problem(start, goal, scene))


@pytest.fixture(scope="module")
def planner_once():
    """Makes `robot, options -> planner`, one of each for a module, so that each is traced once."""
    made = {}

    def make_once(robot, options):
        names = PlannerOptions.__dataclass_fields__
        key = robot.path, *(getattr(options, name) for name in names)
        if key not in made:
            made[key] = make_planner(robot, options)
        return made[key]

    return make_once


@pytest.fixture(scope="module")
def evaluate_with_one_planner(planner_once):
    """Evaluations that differ in nothing but problems, files and seeds share a planner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gnnjax.evaluate.make_planner", planner_once)
        yield


@pytest.fixture
def stand_ins(monkeypatch):
    """A planner may stand in for others, whose options results tell."""
    monkeypatch.setattr("gnnjax.evaluate.own_settings", lambda *given: {})


@pytest.fixture(scope="module")
def all_sizes():
    """Calls of all sizes: what comes out must not depend on which are filled."""
    with pytest.MonkeyPatch.context() as patch:
        for setting in _ALL_SIZES:
            patch.setattr(*setting)
        yield


@pytest.fixture
def bounds_too_low():
    """The certificate takes arms to move a fifth as far as they may; what it keeps of that goes."""
    reach = bounds.Spheres._reach
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounds.Spheres, "_reach", lambda *given: 0.2 * reach(*given))
        patch.setattr(certify, "FIRST_CUT", 10.0)
        bounds.spheres_of.cache_clear()
        yield
    bounds.spheres_of.cache_clear()


@pytest.fixture
def run_as_command(monkeypatch, capsys):
    """Runs `python -m module words` in this process: the status, and what was printed and said."""

    def run(module, *words):
        monkeypatch.setattr("sys.argv", [module, *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(importlib.util.find_spec(module).origin, run_name="__main__")
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def small_figures(monkeypatch):
    """Figures of experiments have few pixels, and are not laid out, which takes as long again."""
    from experiments import record

    def save_small(figure, path, save=record.save_figure):
        figure.set_dpi(20)
        figure.set_layout_engine("none")
        save(figure, path)

    monkeypatch.setattr(record, "save_figure", save_small)


@pytest.fixture
def experiments_remember(monkeypatch, small_figures):
    """Experiments keep one planner, and forget what others have compiled; here all is kept."""
    from experiments import measure

    monkeypatch.setattr("jax.clear_caches", lambda: None)
    monkeypatch.setattr(measure, "_planner", functools.cache(measure._planner.__wrapped__))


def pytest_collection_finish():
    """Spares the garbage collector what imports have made, and turns while JAX traces."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


# Files that take longest come first, so that no worker is left with one of them at the end.
_LONG = (
    "edges collision mjx families cloud_checks timing planner train guided_planner experiments "
    "evaluate fit guides holding engine model allowed accelerator wide_joints certify_campaign "
    "mjcf train_motion classical torques urdf ablation real_arm obstacles search digest "
    "sequences processes benchmark_collision mutations motion rounds certify"
).split()


def pytest_configure(config):
    """Leaves the freeing of all that was compiled to the end of the process."""
    gc.disable()  # until all is imported, of which nothing is garbage
    config.stash[gc_collect_iterations_key] = 0
    atexit.unregister(clean_up)


def pytest_collection_modifyitems(items):
    """Sorts files, and leaves the order of tests in them."""
    rank = {f"test_{name}.py": number for number, name in enumerate(_LONG)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
