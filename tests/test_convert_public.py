import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from experiments.convert_public import ConvertConfig, convert
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.problems.shards import load_problems


def entries(num: int = 4) -> list:
    rng = np.random.default_rng(0)
    return [
        (
            [(rng.uniform(0.1, 0.3, 3), rng.uniform(-1, 1, 3)) for _ in range(row)],
            rng.uniform(-1, 1, 7),
            tuple(rng.uniform(-1, 1, 7)),  # tuples of NumPy scalars occur as well as arrays
            [rng.uniform(-1, 1, 7)],
        )
        for row in range(num)
    ]


def converted(tmp_path: Path, data: bytes) -> dict[str, np.ndarray]:
    (tmp_path / "source.pkl").write_bytes(data)
    convert(ConvertConfig(tmp_path / "source.pkl", tmp_path / "out.npz"))
    with np.load(tmp_path / "out.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_every_pickle_protocol_gives_the_problems_in_their_order(tmp_path, protocol):
    source = entries()
    out = converted(tmp_path, pickle.dumps(source, protocol))
    assert out["robot"] == "kuka_iiwa14"
    np.testing.assert_array_equal(out["num_boxes"], [0, 1, 2, 3])
    assert out["box_quats"].shape == (4, 3, 4)
    np.testing.assert_array_equal(out["box_quats"].reshape(-1, 4), [[1, 0, 0, 0]] * 12)
    for row, (obstacles, start, goal, _) in enumerate(source):
        np.testing.assert_array_equal(out["start"][row], np.float32(start))
        np.testing.assert_array_equal(out["goal"][row], np.float32(goal))
        for box, (half_extents, center) in enumerate(obstacles):
            np.testing.assert_array_equal(
                out["box_half_extents"][row, box], np.float32(half_extents)
            )
            np.testing.assert_array_equal(out["box_centers"][row, box], np.float32(center))


def test_pickles_of_numpy_1_are_read(tmp_path):
    data = pickle.dumps(entries(), protocol=2)
    assert b"numpy._core" in data
    old = data.replace(b"numpy._core", b"numpy.core")
    np.testing.assert_equal(converted(tmp_path, old), converted(tmp_path, data))


def test_the_planner_reads_what_was_written(tmp_path):
    converted(tmp_path, pickle.dumps(entries()))
    problem_set = load_problems(tmp_path / "out.npz", load_robot("kuka_iiwa14"))
    np.testing.assert_array_equal(problem_set.problems.scene.mask.sum(axis=1), [0, 1, 2, 3])


class _Call:
    def __init__(self, function, *arguments):
        self.reduction = function, arguments

    def __reduce__(self):
        return self.reduction


def test_a_pickle_that_runs_code_is_refused_before_it_runs(tmp_path):
    touched = tmp_path / "touched"
    for call in (_Call(os.system, f"touch {touched}"), _Call(eval, f"open({str(touched)!r}, 'w')")):
        with pytest.raises(InputError, match="only NumPy arrays are read"):
            converted(tmp_path, pickle.dumps([call, *entries()]))
    assert not touched.exists()
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    "name", [b"numpy\nload", b"numpy.core.multiarray\nfromfile", b"numpy\nf2py"]
)
def test_numpy_names_that_build_no_array_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="only NumPy arrays are read"):
        converted(tmp_path, b"c" + name + b"\n.")


@pytest.mark.parametrize(
    "bad",
    [
        [],
        {"start": 1},
        [1, 2],
        [([], [0.0] * 7, [0.0] * 6, [])],
        [([], [0.0] * 7, [0.0] * 7, []), ([], [0.0] * 6, [0.0] * 6, [])],
        [([([0.1, 0.1], [0, 0, 0])], [0.0] * 7, [0.0] * 7, [])],
        [([([0.1, -0.1, 0.1], [0, 0, 0])], [0.0] * 7, [0.0] * 7, [])],
        [([], [np.nan] * 7, [0.0] * 7, [])],
    ],
)
def test_other_data_is_an_input_error(tmp_path, bad):
    with pytest.raises(InputError, match=r"source\.pkl"):
        converted(tmp_path, pickle.dumps(bad))


def test_damaged_and_missing_files_are_input_errors(tmp_path):
    for data in (b"", b"not a pickle", pickle.dumps(entries())[:-40]):
        with pytest.raises(InputError, match="not a pickle of problems"):
            converted(tmp_path, data)
    with pytest.raises(InputError, match="no file"):
        convert(ConvertConfig(tmp_path / "none.pkl", tmp_path / "out.npz"))


def test_the_command_reports_bad_input_in_one_line(tmp_path, run_as_command):
    words = "none.pkl", tmp_path / "out.npz"
    status, _, said = run_as_command("experiments.convert_public", *words)
    assert status == 2
    assert said.count("\n") == 1
    assert said.startswith("error: no file")
