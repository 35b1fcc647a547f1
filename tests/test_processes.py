"""A planner in processes of its own plans what it plans in this one."""

import dataclasses
import functools
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.guide.field import field_guide
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions, make_options
from gnnjax.planning.processes import PlannerProcesses
from tests.queries import random_problem, same


def read_in_a_script(*scene):
    """As of a script that is run as such."""


read_in_a_script.__module__ = "__main__"


class Gone:
    """What another process cannot make."""

    def __reduce__(self):
        return exec, ("raise ModuleNotFoundError('no such module there')",)


@pytest.fixture(scope="module")
def planner(tiny_path):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Options(PlannerOptions):
        """Those of a command, which its module alone knows."""

    options = Options(planner="lazysp", num_nodes=40, max_roadmaps=1)
    return make_planner(load_robot(tiny_path), options)


@pytest.fixture(scope="module")
def problems(planner):
    rng = np.random.default_rng(5)
    drawn = [random_problem(planner.robot, rng, num=9) for _ in range(16)]
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


def test_plans_do_not_depend_on_the_number_of_processes(planner, problems):
    with PlannerProcesses(planner, 2) as planners:
        planners.warm_up(jax.tree.map(lambda x: x[0], problems.scene), 16)
        before = planners.cpu_time()
        plans = planners.plan_batch(problems, seed=1)
        assert planners.cpu_time() > before
        assert same(plans, planner.plan_batch(problems, seed=1))
        assert len({plan.success for plan in plans}) == 2

        # What a process finds wrong is told here, and it goes on.
        with pytest.raises(InputError, match=r"seed is -1"):
            planners.plan_batch(problems, seed=-1)
        few = jax.tree.map(lambda x: x[:3].copy(), problems)
        few.start[0] = few.goal[0] = 0.0
        few.scene.centers[0, 0] = [0.5, 0.0, 0.0]  # where the arm is then
        found = planners.plan_batch(few, seed=1)
        assert "is in collision" in found[0].reason
        assert same(found[1:], plans[1:3])

        # One that is killed ends all of them.
        os.kill(planners._workers[1]._process.pid, signal.SIGKILL)
        with pytest.raises(
            InputError, match=r"has ended \(status -9\), perhaps for want of memory"
        ):
            planners.plan_batch(problems)
        with pytest.raises(InputError, match="have ended; make new ones"):
            planners.plan_batch(problems)


def test_what_fails_in_a_process_is_told(planner, problems, monkeypatch):
    # Whatever is wrong there and not here: a folder that is gone, a package that is missing.
    given = planner.given | {"scorer": Gone()}
    monkeypatch.setattr(planner, "given", given)
    with PlannerProcesses(planner, 1) as planners:
        with pytest.raises(RuntimeError, match="ModuleNotFoundError: no such module there"):
            planners.plan_batch(problems)


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.whole
def test_processes_end_with_whoever_started_them(tiny_path):
    code = f"""
from gnnjax import PlannerProcesses, load_planner
planner = load_planner({str(tiny_path)!r}, "lazysp", num_nodes=40, max_roadmaps=1)
planners = PlannerProcesses(planner, 1)
print(planners.cpu_time() > 0, planners._workers[0]._process.pid)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    answered, pid = done.stdout.split()
    assert answered == "True"
    begin = time.monotonic()
    while is_running(int(pid)):  # until it sees that nobody asks any more
        assert time.monotonic() < begin + 60
        time.sleep(0.01)


def test_what_cannot_be_shared_out_is_refused(planner, tiny_path, tmp_path):
    with pytest.raises(InputError, match="0 processes; it must be at least 1"):
        PlannerProcesses(planner, 0)
    field = field_guide(planner.robot)
    own = field._replace(read=lambda *scene: field.read(*scene))
    guided = make_planner(planner.robot, make_options("guided"), own)
    with pytest.raises(InputError, match="cannot be sent to another process"):
        PlannerProcesses(guided, 1)
    # The script that runs is another module there.
    of_script = functools.update_wrapper(lambda *scene: None, read_in_a_script)
    guided = make_planner(planner.robot, make_options("guided"), field._replace(read=of_script))
    with pytest.raises(InputError, match=r"sent to another process \(read_in_a_script is in the"):
        PlannerProcesses(guided, 1)
    settings = {"problems": tmp_path / "none.npz", "json": tmp_path / "out.json", "processes": 2}
    for changes, message in (
        ({"batch_size": 15}, "with batch_size 15; they share out a batch"),
        ({"planner": "ompl:rrt_connect", "batch_size": 16}, "'ompl:rrt_connect'; it takes 1"),
    ):
        with pytest.raises(InputError, match=message):
            evaluate(EvaluateConfig(robot=str(tiny_path), **settings, **changes))
