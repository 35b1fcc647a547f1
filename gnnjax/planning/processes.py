"""A planner in several processes, each on a core of its own.

Half of what a pool of problems takes on a CPU is spent in Python, which lets one thread of a
process at a time. Processes share nothing but the cache of compiled code.
"""

import contextlib
import dataclasses
import functools
import io
import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
import types
from collections.abc import Callable, Sequence
from typing import IO, Any

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.devices import deal, gather, num_cores
from gnnjax.errors import InputError, check_seed, is_out_of_memory
from gnnjax.notice import silence
from gnnjax.planning.load import make_planner
from gnnjax.planning.motions import motion_options
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.query import Plan, plan_valid
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.options import MotionOptions

LEAST_SHARE = 8  # problems; fewer are not worth another process


class PlannerProcesses:
    """Plans batches as a planner does, in processes that share them out; the plans are the same.

    A context manager, whose end ends the processes. They start within seconds, and compile what
    they need or find it in the cache, as the planner itself does. Each takes the memory that the
    planner takes.

        with PlannerProcesses(load_planner("kuka_iiwa14")) as planners:
            plans = planners.plan_batch(problems)
    """

    def __init__(self, planner: Planner, num: int | None = None):
        """Args:
            planner: what each process plans with.
            num: of the processes; by default, one for each core that this one may use.

        Raises:
            InputError: a guide or scorer of the planner that cannot be sent to another process.
        """
        num = num_cores() if num is None else num
        if num < 1:
            raise InputError(f"{num} processes; it must be at least 1")
        self._planner = planner
        self._workers: list[_Worker] = []
        sent = _sent(planner)
        try:
            for _ in range(num):
                self._workers.append(_Worker())
            # Once all of them are starting: each reads this when it has imported what it needs.
            for number, worker in enumerate(self._workers):
                worker.send(number)
                worker.send(sent)
        except BaseException:
            self.close()
            raise

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self._planner.robot

    @property
    def radius(self) -> float:
        """Of the roadmaps, configuration units."""
        return self._planner.radius

    def plan_batch(
        self, problems: Problem, *, seed: int = 0, trajectory: bool | MotionOptions = False
    ) -> list[Plan]:
        """See `Planner.plan_batch`; times are shared out over the processes, too.

        Raises:
            InputError: what `Planner.plan_batch` refuses, or a process has ended.
        """
        # What is wrong with one is found out here, as the arms of the processes have no model to
        # name what overlaps by.
        margin = self._planner.options.margin
        motion, seed = motion_options(self.robot, trajectory), check_seed(seed)
        search = functools.partial(self._plan_accepted, seed, motion)
        return plan_valid(self.robot, jax.tree.map(np.asarray, problems), margin, search)

    def _plan_accepted(
        self, seed: int, motion: MotionOptions | None, problems: Problem
    ) -> list[Plan]:
        weights = jax.tree.map(np.asarray, self._planner.strategy.weights)
        dealt = self._deal(len(problems.start))
        parts = [jax.tree.map(lambda x, at=at: x[at], problems) for at in dealt]
        found = self._call([("plan_accepted", (weights, seed, motion, part)) for part in parts])
        return [
            plan._replace(
                planning_time_s=plan.planning_time_s / len(dealt),
                total_time_s=plan.total_time_s / len(dealt),
            )
            for plan in gather(dealt, found)
        ]

    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        """See `Planner.warm_up`."""
        most = max(map(len, self._deal(batch_size)))
        asked = "warm_up", (jax.tree.map(np.asarray, scene), most)
        self._call([asked])
        # The others find in the cache what the first has compiled.
        self._call([asked] * len(self._workers))

    def cpu_time(self) -> float:
        """CPU time that the processes have taken, s."""
        return sum(self._call([("cpu_time", ())] * len(self._workers)))

    def close(self) -> None:
        """Ends the processes, whatever they are doing."""
        while self._workers:
            self._workers.pop().kill()

    def __enter__(self) -> "PlannerProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _deal(self, num: int) -> list[np.ndarray]:
        return deal(num, len(self._workers), LEAST_SHARE)

    def _call(self, asked: Sequence[tuple[str, tuple]]) -> list[Any]:
        """Asks the first processes, each a function with arguments, and waits for all of them."""
        if not self._workers:
            raise InputError("the processes of this planner have ended; make new ones")
        try:
            workers = self._workers[: len(asked)]
            for worker, question in zip(workers, asked, strict=True):
                worker.send(question)
            answers = [worker.receive() for worker in workers]
        except BaseException:  # what the others answer would be taken for the answer to the next
            self.close()
            raise
        for _, error in answers:
            if error is not None:
                raise error
        return [found for found, _ in answers]


def _sent(planner: Planner) -> bytes:
    """What a process makes the planner of."""
    cache = jax.config.jax_compilation_cache_dir
    # Those of a command belong to its module, which is another one there.
    names = [field.name for field in dataclasses.fields(PlannerOptions)]
    options = PlannerOptions(**{name: getattr(planner.options, name) for name in names})
    sent = io.BytesIO()
    try:
        _Pickler(sent).dump((planner.robot, options, planner.given, cache))
        return sent.getvalue()
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"the planner's guide or scorer cannot be sent to another process ({error}); make it "
            "of functions at the top of a module, or plan in this process"
        ) from None


class _Pickler(pickle.Pickler):
    """Refuses what another process would not find."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, types.FunctionType | type) and obj.__module__ == "__main__":
            raise pickle.PicklingError(f"{obj.__qualname__} is in the script that runs")
        return NotImplemented


class _Worker:
    """A process with a planner."""

    def __init__(self):
        # By name, and not by multiprocessing, which would run the script that asks once more.
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import work; work()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # Searches run on the host, and its cores are what is shared out.
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._questions, self._answers = self._process.stdin, self._process.stdout

    def send(self, what: Any) -> None:
        with contextlib.suppress(BrokenPipeError):  # `receive` says it
            _write(self._questions, what)

    def receive(self) -> tuple[Any, Exception | None]:
        """An answer, or why there is none."""
        try:
            return pickle.load(self._answers)
        except (EOFError, pickle.UnpicklingError):
            status = self._process.wait()
            why = "; it may have told why"
            if status == -signal.SIGKILL:
                why = (
                    ", perhaps for want of memory; plan fewer problems at once, or in fewer "
                    "processes"
                )
            raise InputError(f"a process of the planner has ended (status {status}){why}") from None

    def kill(self) -> None:
        self._process.kill()
        for pipe in (self._questions, self._answers):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
        self._process.wait()


def _write(file: IO[bytes], what: Any) -> None:
    pickle.dump(what, file)
    file.flush()


def work() -> None:
    """What a process does: answers, until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
    # What anything prints goes to the errors, not among the answers.
    questions, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    number = pickle.load(questions)
    if number:  # the first tells for all of them
        silence()
    # Before JAX starts as many threads as it may use cores.
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    sent, made = pickle.load(questions), []

    def planner() -> Planner:
        """Made when it is first asked, so that whoever asks is told what is wrong."""
        if not made:
            robot, options, given, cache = pickle.loads(sent)
            jax.config.update("jax_compilation_cache_dir", cache)
            made.append(make_planner(robot, options, **given))
        return made[0]

    def plan_accepted(
        weights: Any, seed: int, motion: MotionOptions | None, problems: Problem
    ) -> list[Plan]:
        planner().use_weights(weights)
        return planner().plan_accepted(seed, motion, problems)

    functions: dict[str, Callable[..., Any]] = {
        "plan_accepted": plan_accepted,
        "warm_up": lambda *asked: planner().warm_up(*asked),
        "cpu_time": time.process_time,
    }
    while True:
        try:
            name, arguments = pickle.load(questions)
        except EOFError:
            return
        try:
            answer = functions[name](*arguments), None
        except InputError as error:
            answer = None, error
        except Exception as error:
            if is_out_of_memory(error):
                answer = None, MemoryError(str(error))
            else:
                answer = None, RuntimeError(traceback.format_exc())
        _write(answers, answer)
