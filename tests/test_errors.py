"""Errors in one line."""

import dataclasses
import inspect
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import (
    InputError,
    as_floats,
    as_typed,
    brief,
    check_number,
    check_seed,
    name_options,
    run_command,
)
from gnnjax.planning.options import PlannerOptions, check_options
from gnnjax.problems.file import save_problems
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.cloud import point_cloud
from gnnjax.scene.numbers import check_shapes
from gnnjax.scene.scene import make_scene, scene_from_shapes
from gnnjax.scene.surfaces import mesh
from gnnjax.training.run import AGAIN
from gnnjax.trajectory.options import MotionOptions, check_motion_options
from gnnjax.trajectory.simulate import check_errors
from gnnjax.trajectory.states import check_step, sample_times

EMPTY = make_scene([], [])


def with_text(kind: type, name: str) -> SimpleNamespace:
    """Options of which one is text, which nobody checks the type of but in tests."""
    values = {field.name: field.default for field in dataclasses.fields(kind)}
    return SimpleNamespace(**values | {name: "1", "is_classical": False})


@pytest.mark.parametrize(
    ("refuse", "message"),
    [
        (lambda: inspect.unwrap(mesh)("a.stl", scale="1"), "scale of mesh 'a.stl' is '1'; give"),
        (lambda: inspect.unwrap(point_cloud)([[0, 0, 1]], None), "radius of the cloud is None; "),
        (
            lambda: inspect.unwrap(load_robot)("panda", hold=[("a", 1.0)]),
            "hold is .*'a', 1.0.*; gi",
        ),
        (lambda: inspect.unwrap(check_step)("1"), "dt is '1'; give a number"),
        (lambda: inspect.unwrap(check_shapes)(None, "shapes"), "shapes is None; give a list of"),
        (lambda: inspect.unwrap(scene_from_shapes)([], clouds=5), "clouds of the scene is 5; give"),
        (lambda: inspect.unwrap(allow_contacts)(None, EMPTY, 5), "allow is 5; give pairs of names"),
        (lambda: inspect.unwrap(save_problems)("q.npz", 5), "5 is no ProblemSet; give what"),
        (lambda: inspect.unwrap(sample_times)(None, 0.1), "a NoneType is no motion; give plan"),
        (lambda: inspect.unwrap(check_errors)({"mass": 1}), "errors is {'mass': 1}; give Model"),
        (
            lambda: inspect.unwrap(check_motion_options)(None, with_text(MotionOptions, "blend")),
            "blend is '1'; give a number",
        ),
        (
            lambda: inspect.unwrap(check_options)(with_text(PlannerOptions, "margin")),
            "margin is '1'; give a number",
        ),
    ],
)
def test_values_of_another_kind_are_refused(refuse, message):
    with pytest.raises(InputError, match=message):
        refuse()


def test_numbers_of_all_libraries_are_numbers():
    for value in (1, 0.5, True, np.float32(1), np.int64(1), np.array(1.0), jnp.array(2), np.inf):
        check_number(value, "it")
    for value in ("1", None, [1.0], np.array([1.0]), np.array("1"), 1j):
        with pytest.raises(InputError, match=r"^it is .*; give a number$"):
            check_number(value, "it")


@pytest.mark.parametrize(
    ("said", "typed"),
    [
        ("give acceleration=... (rad/s^2), or", "give --acceleration ... (rad/s^2), or"),
        ("give torque=8.0", "give --torque 8.0"),
        ("is coupled; hold={'a_1': ...}, else", "is coupled; --hold a_1 ..., else"),
        ("give allow=[(body, body)], or", "give --allow body body, or"),
        ("allow=[('a', 'b')]; there", "--allow a b; there"),
        ("(those to plan for: joints=[...])", "(those to plan for: --joints ...)"),
        ("rest_share=0.8 and shorten=False", "--rest-share 0.8 and --no-shorten"),
        ("shorten=True", "--shorten"),
        # No options of this command, or no arguments.
        ('contype="1" radius=2, f(torque=...)', 'contype="1" radius=2, f(torque=...)'),
    ],
)
def test_a_command_names_its_options_where_functions_have_arguments(capsys, said, typed):
    def main():
        raise InputError(said)

    # Last, as it is elsewhere: without options.
    for names, words in (
        ("acceleration torque hold allow joints rest_share shorten", typed),
        ("", said),
    ):
        name_options(names.split())
        with pytest.raises(SystemExit):
            run_command(main)
        assert capsys.readouterr().err == f"error: {words}\n"


@pytest.mark.parametrize("seed", [-1, 2**31, 2**70])
def test_a_seed_that_jax_cannot_take_is_refused(seed):
    with pytest.raises(InputError, match=rf"seed is {seed}; choose an integer from 0 to"):
        check_seed(seed)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("num_nodes is 1; give 2 or more"), 2, "error: num_nodes is 1; give 2 or more"),
        (KeyboardInterrupt(), 130, "interrupted; start the same command again to go on"),
        (
            PermissionError(13, "Permission denied", "/x"),
            2,
            "error: Permission denied: /x; check its permissions",
        ),
        (MemoryError("no room"), 2, "error: not enough memory; ask for less at once (no room)"),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 TB"),
            2,
            "error: not enough memory; ask for less at once (RESOURCE_EXHAUSTED: 9 TB)",
        ),
    ],
)
def test_a_command_says_in_one_line_what_went_wrong(error, status, line, capsys):
    def main():
        raise error

    with pytest.raises(SystemExit) as exit_info:
        run_command(main)
    assert exit_info.value.code == status
    assert capsys.readouterr().err == line + "\n"


def test_a_command_tells_what_of_its_own_takes_less_memory(capsys):
    def main():
        raise MemoryError("no room")

    with pytest.raises(SystemExit):
        run_command(main, smaller="give a smaller --batch-size")
    said = "error: not enough memory; give a smaller --batch-size (no room)\n"
    assert capsys.readouterr().err == said


def test_a_command_returns_its_status():
    for returned, status in ((None, 0), (0, 0), (1, 1)):
        with pytest.raises(SystemExit) as exit_info:
            run_command(lambda returned=returned: returned)
        assert exit_info.value.code == status


@pytest.fixture
def unread():
    """A pipe whose reader is gone, as that of `| head` when it has seen enough."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w", buffering=1) as pipe:
        yield pipe


@pytest.mark.parametrize(
    "main", [lambda: print("x"), lambda: print("x", end=""), lambda: sys.exit(print("x"))]
)
def test_a_command_whose_output_nobody_reads_ends_without_a_word(main, unread, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout", unread)
    with pytest.raises(SystemExit) as exit_info:
        run_command(main)
    assert exit_info.value.code == 141
    assert capsys.readouterr().err == ""


def test_nor_does_python_complain_at_the_end_of_the_process(unread):
    command = [sys.executable, "-m", "gnnjax.planner_arena", "--help"]
    ended = subprocess.run(command, stdout=unread, stderr=subprocess.PIPE, text=True)
    assert (ended.stderr, ended.returncode) == ("", 141)


def test_another_pipe_that_breaks_is_said(unread, capfd):
    with pytest.raises(SystemExit) as exit_info:
        run_command(lambda: os.write(unread.fileno(), b"x"))
    assert exit_info.value.code == 2
    assert capfd.readouterr().err == "error: [Errno 32] Broken pipe; check the path\n"


@pytest.mark.parametrize(
    "message",
    ["one\ntwo\r\n three\x85four\u2028five", "x" * 10**6, "a\x1b[2Jb\0c", "\ud800", "é" * 500],
)
def test_a_message_is_one_line_of_less_than_300_characters(message):
    text = str(InputError(f"the beginning {message}; the remedy"))
    assert len(text) < 300
    assert len(text.splitlines()) == 1
    assert text.isprintable()
    assert text.startswith("the beginning ")
    assert text.endswith("; the remedy")


def test_a_value_is_said_briefly_however_large_it_is_or_deep():
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, [1] * 10**6, "x" * 10**6, 10**400, {"a": {"b": deep}}):
        assert len(brief(value)) < 200
    assert brief([0.1, 0.2]) == "[0.1, 0.2]"


def test_a_training_says_how_it_goes_on(capsys):
    def main():
        raise KeyboardInterrupt

    with pytest.raises(SystemExit):
        run_command(main, AGAIN)
    line = "interrupted; start the same command again with --resume to go on\n"
    assert capsys.readouterr().err == line


def test_numbers_are_said_as_they_were_typed():
    typed = [[0.12, -3e-7, 1e30], [float("inf"), 2.0, 0.1]]
    for kind in (np.float32, np.float64):
        assert as_typed(np.array(typed, kind)) == typed
    assert as_typed(np.float32(0.12).astype(float)) == 0.12
    assert as_typed([0.12345678901234, 1e300]) == [0.12345678901234, 1e300]
    assert np.isnan(as_typed(np.float32("nan")))


@pytest.mark.parametrize(
    "values", [["1", "2"], [True, False], "1", [[b"1"]], [np.datetime64("now")]]
)
def test_texts_and_truth_values_are_no_numbers(values):
    with pytest.raises(TypeError):
        as_floats(values)


def test_numbers_of_any_kind_are_numbers():
    assert as_floats([[1, 2.5], [np.float32(3), 4]]).tolist() == [[1.0, 2.5], [3.0, 4.0]]
    with pytest.raises(OverflowError):
        as_floats([10**400])
