"""Compiled functions that are kept on disk: found again, bit by bit the same, or made anew."""

import functools
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from gnnjax import devices, kept, surroundings
from gnnjax.arm.hulls import simplify
from gnnjax.files import cache_folder
from gnnjax.kept import keep, kept_result
from gnnjax.scene.field import Grid, cell_of

GRID = Grid((0.0, 0.0, 0.0), 0.1, (4, 4, 4))
POINT = [np.linspace(0, 0.5, 8, dtype=np.float32) for _ in range(3)]


def cells(grid=GRID):
    return keep(functools.partial(cell_of, grid))


@functools.cache
def expected():
    return np.asarray(cell_of(GRID, [jnp.asarray(x) for x in POINT]))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where code is kept, in an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
    yield cache_folder("code")
    jax.config.update("jax_compilation_cache_dir", before)
    reset_cache()


@pytest.fixture
def compiled(monkeypatch):
    """The functions that are lowered, in order."""
    lowered, jit = [], jax.jit

    def noted(function, **how):
        jitted = jit(function, **how)

        class Noted:
            def lower(self, *args):
                lowered.append(function)
                return jitted.lower(*args)

            def __call__(self, *args):
                lowered.append("not kept")
                return jitted(*args)

        return Noted()

    monkeypatch.setattr(jax, "jit", noted)
    return lowered


def suffixes(folder):
    return sorted(path.suffix for path in folder.iterdir())


def test_what_is_kept_is_found_again_and_computes_the_same_bits(folder, compiled, caplog):
    caplog.set_level("INFO", "gnnjax.kept")
    first = np.asarray(cells()(POINT))
    assert [record.message[:9] for record in caplog.records] == ["compiling", "functools"]
    assert len(compiled) == 1
    assert suffixes(folder) == [".code", ".link"]
    again = cells()
    assert np.asarray(again(POINT)).tobytes() == first.tobytes()
    assert (len(compiled), again._cache_size(), len(caplog.records)) == (1, 1, 2)
    np.testing.assert_array_equal(first, expected())


def test_other_statics_shapes_types_and_settings_are_compiled(folder, compiled):
    asked = 0
    for grid, point in [
        (GRID, POINT),
        (GRID._replace(cell=np.nextafter(0.1, 1)), POINT),
        (GRID, [x[:4] for x in POINT]),
        (GRID, [x.astype(np.float16) for x in POINT]),
    ]:
        cells(grid)(point)
        asked += 1
        assert len(compiled) == asked
    same = cells()
    same(POINT)
    assert len(compiled) == asked
    with jax.enable_x64(True):
        same(POINT)
    with jax.default_matmul_precision("float32"):
        same(POINT)
    assert len(compiled) == asked + 2


def test_results_of_another_form_are_another_program(folder):
    forms = []
    for form in ("x[0] * 2, None", "x[0] * 2, None, None", "[x[0] * 2]"):  # one program
        space = {"__name__": "gnnjax.made_up"}
        exec(f"def doubled(x):\n    return {form}", space)
        forms.append(jax.tree.structure(keep(space["doubled"])(POINT)))
    expected = [(0, None), (0, None, None), [0]]
    assert forms == [jax.tree.structure(form) for form in expected]


def test_a_constant_or_source_that_changes_is_another_function(folder, compiled, monkeypatch):
    cells()(POINT)
    monkeypatch.setattr(kept, "SOURCES", "changed")
    compiles = []
    compile_, failing = kept._compile, lambda lowered: compiles.append(lowered)
    monkeypatch.setattr(kept, "_compile", failing)
    cells()(POINT)  # lowered to the same program, whose code is there
    assert (len(compiled), compiles) == (2, [])
    assert suffixes(folder) == [".code", ".link", ".link"]

    def change_meanwhile(lowered):
        monkeypatch.setattr(kept, "SOURCES", "changed again")
        return compile_(lowered)

    monkeypatch.setattr(kept, "_compile", change_meanwhile)
    cells(GRID._replace(shape=(5, 5, 5)))(POINT)
    assert suffixes(folder) == [".code", ".code", ".link", ".link"]  # nobody knows whose it is


def truncate(path, other):
    path.write_bytes(path.read_bytes()[:-1])


def flip_a_bit(path, other):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def exchange(path, other):
    path.write_bytes(other.read_bytes())


@pytest.mark.parametrize("suffix", [".code", ".link"])
@pytest.mark.parametrize("damage", [truncate, flip_a_bit, exchange])
def test_files_that_are_damaged_or_anothers_are_made_anew(folder, compiled, caplog, suffix, damage):
    cells()(POINT)
    (mine,) = folder.glob(f"*{suffix}")
    cells(GRID._replace(shape=(2, 2, 2)))(POINT)
    (other,) = set(folder.glob(f"*{suffix}")) - {mine}
    damage(mine, other)
    for _ in range(2):
        np.testing.assert_array_equal(cells()(POINT), expected())
    assert len(compiled) == 3
    assert [record.message for record in caplog.records] == [
        f"{str(mine)!r} is damaged and is made anew"
    ]


def test_code_that_cannot_be_loaded_is_made_anew(folder, compiled, caplog):
    cells()(POINT)
    (code,) = folder.glob("*.code")
    kept._write(code, b"no pickle")
    np.testing.assert_array_equal(cells()(POINT), expected())
    cells()(POINT)
    assert len(compiled) == 2
    assert "cannot be loaded and is made anew" in caplog.text


def test_a_folder_that_cannot_be_written_is_said_and_does_no_harm(folder, caplog):
    folder.parent.mkdir(parents=True)
    folder.write_text("a file")
    np.testing.assert_array_equal(cells()(POINT), expected())
    assert "is made anew" in caplog.text


def test_what_has_no_digest_is_compiled_and_not_kept(folder, compiled):
    own = keep(lambda x: x + 1)
    assert np.asarray(own(POINT[0]))[0] == 1
    assert compiled == ["not kept"]
    assert cells()([x.tolist()[0] for x in POINT]) == 0  # nor of numbers
    assert not folder.exists()


def test_traced_a_kept_function_is_a_part_of_what_is_traced(folder):
    found = jax.jit(lambda point: cells()(point) + 1)(POINT)
    np.testing.assert_array_equal(found, expected() + 1)
    assert not folder.exists()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("jax.default_backend", lambda: "gpu"),
        ("jax.device_count", lambda: 2),
        ("gnnjax.surroundings._processor", lambda: None),
    ],
)
def test_nothing_is_kept_on_accelerators_nor_of_many_devices(folder, monkeypatch, name, value):
    assert surroundings.keeps_code()
    monkeypatch.setattr(name, value)
    assert not surroundings.keeps_code()
    cells()(POINT)
    assert not folder.exists()


def test_nothing_is_kept_where_jax_was_told_where_to_keep_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    devices.cache_compilations()  # the tests have told it
    cells()(POINT)
    assert not cache_folder("code").exists()


def test_the_machine_is_told_by_what_code_depends_on(monkeypatch):
    told = repr(surroundings.machine())
    for name in (jax.__version__, np.__version__, sys.version, *surroundings._processor()):
        assert repr(name) in told
    assert ("jax_enable_x64", "False") in surroundings.settings()[0]
    assert ("jax_disable_most_optimizations", "True") in surroundings.settings()[0]
    monkeypatch.setenv("XLA_FLAGS", "--xla_none")
    assert ("XLA_FLAGS", "--xla_none") in surroundings.settings()[1]


def test_another_program_than_was_kept_is_found_out_where_asked(folder, compiled, monkeypatch):
    monkeypatch.setenv(kept._CHECK, "1")
    for _ in range(2):
        cells()(POINT)
    assert len(compiled) == 2  # looked at, and found the same
    digest = kept.digest
    ignoring = functools.partial(digest, "the grid does not count")
    monkeypatch.setattr(
        kept, "digest", lambda f, *x: digest(f, *x) if isinstance(f, str) else ignoring(*x)
    )
    cells()(POINT)
    with pytest.raises(RuntimeError, match="another program's"):
        cells(GRID._replace(cell=0.2))(POINT)


def test_the_files_that_were_not_read_for_longest_go_first(folder, monkeypatch):
    ahead = time.time() + 1e9  # by a machine whose clock is wrong
    for name, at in (("1", 1), ("2", 2), ("ahead", ahead)):
        kept._write(folder / name, bytes(1000))
        os.utime(folder / name, (at, at))
    kept._read(folder / "1")
    monkeypatch.setattr(kept, "_MOST_BYTES", 2500)
    kept._write(folder / "3", bytes(1000))
    assert sorted(path.name for path in folder.iterdir()) == ["1", "3"]
    assert os.stat(folder / "1").st_mtime == pytest.approx(time.time(), abs=60)
    for name in ("1", "3"):  # by machines whose clocks are ahead of this one's
        os.utime(folder / name, (ahead, ahead))
    kept._write(folder / "4", bytes(1000))
    assert (folder / "4").exists()


def test_what_a_function_returns_is_kept_by_what_it_is_given(folder, monkeypatch):
    corners = np.random.default_rng(0).normal(size=(30, 3))
    expected = simplify(corners, 0.5)
    for _ in range(2):
        found = kept_result(simplify, corners, 0.5)
        assert found[0].tobytes() == expected[0].tobytes()
        assert found[1] == expected[1]
    assert len(list(folder.iterdir())) == 1
    kept_result(simplify, np.nextafter(corners, 9), 0.5)
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setattr("scipy.optimize.nnls", None)  # what computes it
    assert kept_result(simplify, corners, 0.5)[1] == expected[1]
    assert kept_result(lambda x: x + 1, 1) == 2  # of one's own it is not kept
    assert len(list(folder.iterdir())) == 2


QUERY = """
import sys, jax, gnnjax
if sys.argv[2:]:
    jax.stages.Lowered.compile = None
planner = gnnjax.load_planner(sys.argv[1], num_nodes=64)
scene = gnnjax.make_scene(centers=[[0.5, 0, 0.1]], half_extents=[[0.05, 0.05, 0.4]])
plan = planner.plan(scene, [-1.0, 0, 0], [1.0, 0, 0])
print(plan.path.tobytes().hex(), plan.edge_checks, plan.configuration_checks)
"""


@pytest.mark.whole
def test_a_second_process_compiles_nothing_and_plans_the_same(tiny_path, tmp_path):
    names = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    base = {name: value for name, value in os.environ.items() if name not in names}
    found = []
    for more, own, words in [
        ({}, {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax")}, []),  # nothing is kept
        ({}, {}, []),
        ({}, {}, ["compile nothing"]),
        ({kept._CHECK: "1"}, {}, ["compile nothing"]),
    ]:
        env = {**base, "XDG_CACHE_HOME": str(tmp_path), **more, **own}
        command = [sys.executable, "-c", QUERY, str(tiny_path), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout)
    assert len(set(found)) == 1
