"""The package as a whole: its table of contents, and the texts that describe it."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import gnnjax
from gnnjax.__main__ import COMMANDS, main
from gnnjax.arguments import parse_arguments
from gnnjax.evaluate import EvaluateConfig

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", gnnjax.__all__)
def test_everything_public_is_there_and_documented(name):
    thing = getattr(gnnjax, name)
    assert inspect.getdoc(thing)
    assert thing.__module__.startswith("gnnjax.")


def test_the_table_of_contents_is_complete():
    tree = ast.parse((ROOT / "gnnjax" / "__init__.py").read_text())
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported = {a.name for n in froms if n.module.startswith("gnnjax.") for a in n.names}
    assert imported == set(gnnjax.__all__)


def test_help_names_no_planner_that_commands_refuse(capsys):
    with pytest.raises(SystemExit):
        parse_arguments(EvaluateConfig, args=["--help"], prog="evaluate")
    said = capsys.readouterr().out
    assert "lazysp (lazy search" in said
    assert "greedy (" not in said


# Imports go down this list only.
ORDER = """
interruption notice progress_bar errors arguments per_object files array_files devices clock digest
surroundings memory_maps kept
roll_call cluster
arm.shipped
arm.parts arm.bodies arm.couplings arm.joints arm.mjcf arm.mesh_files arm.urdf arm.sources
arm.contacts arm.choice arm.load
arm.reading arm.fit arm.blocks arm.covers arm.robot arm.hulls arm.kinematics arm.transforms
arm.torques arm.turns arm.meetings
scene.shapes scene.cloud scene.lookup scene.own_points scene.point_files scene.numbers
scene.scene scene.batches scene.allowed scene.surfaces scene.octomap scene.units scene.scene_file
scene.geometry scene.field scene.mujoco_world
scene.pose scene.held scene.holding scene.messages scene.collision_objects
scene.moveit scene.robot_in_mjcf scene.from_mjcf scene.any_file
collision.placed collision.spheres collision.simplex collision.convex collision.reaches
collision.couples
collision.contact_cells collision.contact_maps collision.exact collision.components
collision.obstacles collision.hulls collision.bounds collision.link_frames
collision.levels collision.fused collision.mjx collision.points collision.cloud collision.edges
collision.stretches collision.checker collision.blocks collision.one_call collision.sequences
collision.travel collision.gaps collision.certify collision.clearances collision.margins
roadmap.graph roadmap.sampled roadmap.paths roadmap.smallest roadmap.sobol roadmap.stored
plot
pose.goal pose.chain pose.solver pose.inverse pose.reasons
guide.guide guide.view guide.motion guide.field guide.rest
search.knowledge search.greedy search.lazy search.rounds search.path_roadmap
problems.problem problems.arrays problems.file problems.shards problems.camera
problems.structures problems.shelves problems.furniture problems.clutter problems.families
problems.family_problem problems.labelled problems.moveit_names
problems.moveit
trajectory.limits trajectory.options trajectory.dynamics trajectory.curve trajectory.smooth
trajectory.clearance trajectory.timing trajectory.batches trajectory.needs trajectory.jerk
trajectory.moves trajectory.trajectory trajectory.states trajectory.files
planning.options planning.query planning.progress planning.goals planning.motions
planning.strategy planning.sampled_search planning.looks planning.guided planning.pool
planning.batch planning.steps planning.shorten_by_guide
planning.shorten_by_tests planning.tree planning.trees
planning.attempts planning.engine planning.planner planning.load planning.processes
trajectory.control trajectory.simulate trajectory.steps trajectory.execution
training.weights training.checkpoint training.optimizer training.parallel training.motions
training.figure training.run
paper.encoding paper.graphs paper.occupancy paper.validity paper.network paper.strategy
baselines.ledger baselines.ompl
measure.machine measure.own_planner measure.rows measure.batches measure.result_files
measure.statistics measure.table measure.figure
arm_options generate paper.losses paper.step train train_motion evaluate planner_arena video
query_options plan plot_execution execute fit
viewer.frames viewer.meshes viewer.worker viewer.answers viewer.session viewer.prices viewer.stage
viewer.player viewer.ends viewer.obstacles viewer.saving viewer.downloads viewer.panel viewer.page
view __main__
""".split()
# Imported up the list, inside of functions: by name, when somebody asks for it.
LAZY = {
    ("arm.robot", "arm.torques"),
    ("arm.robot", "scene.holding"),
    ("planning.load", "training.weights"),
    ("planning.load", "paper"),
    ("planning.load", "baselines.ompl"),
    ("training.weights", "training.checkpoint"),
}


def imports_of(module):
    """Modules of the package that a module imports, and whether inside of a function."""
    path = ROOT / "gnnjax" / f"{module.replace('.', '/')}.py"
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gnnjax"):
            used = node.module.removeprefix("gnnjax").removeprefix(".")
            if used in ORDER:
                yield used, node not in tree.body
            else:  # a wing, of which modules are imported
                for alias in node.names:
                    inside = f"{used}.{alias.name}".removeprefix(".")
                    yield (
                        (inside if inside in ORDER and node in tree.body else used),
                        (node not in tree.body),
                    )


def test_no_module_imports_one_that_comes_after_it():
    package = ROOT / "gnnjax"
    found = {
        ".".join(path.relative_to(package).with_suffix("").parts)
        for path in package.rglob("*.py")
        if path.name != "__init__.py"
    }
    assert found == set(ORDER)
    lazy = set()
    for module in ORDER:
        for used, inside in imports_of(module):
            if inside:
                lazy.add((module, used))
            else:
                assert ORDER.index(used) < ORDER.index(module), f"{module} imports {used}"
    up = {
        pair for pair in lazy if pair[1] not in ORDER or ORDER.index(pair[1]) > ORDER.index(pair[0])
    }
    assert up == LAZY


GUESTS = ("gnnjax.paper", "gnnjax.baselines", "jraph", "orbax", "tensorboardX", "scipy.stats")
GUESTS += ("flax", "optax")


def test_planning_with_the_default_planner_loads_neither_the_paper_nor_its_libraries(tiny_path):
    code = f"""
import sys, gnnjax
planner = gnnjax.load_planner({str(tiny_path)!r}, max_roadmaps=1)
planner.plan(gnnjax.make_scene([], []), [0.5, 0, 0], [-0.5, 0, 0])
print(*sorted(name for name in sys.modules if name.startswith({GUESTS!r})))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


def test_all_commands_are_named(monkeypatch, capsys):
    runs = {
        path.stem for path in (ROOT / "gnnjax").glob("*.py") if "run_command(" in path.read_text()
    }
    assert set(COMMANDS) == runs - {"errors"}
    monkeypatch.setattr("sys.argv", ["gnnjax"])
    assert main() == 0
    printed = capsys.readouterr().out
    assert all(f"python -m gnnjax.{name} " in printed for name in COMMANDS)
    monkeypatch.setattr("sys.argv", ["gnnjax", "plan", "--scene", "scene.json"])
    assert main() == 2
    assert "write python -m gnnjax.plan" in capsys.readouterr().err
