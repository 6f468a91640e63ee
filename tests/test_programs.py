"""Traces that are kept: the same results without running the Python code again, and never a wrong one."""

import os
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec
from jax.stages import Compiled
from threadpoolctl import threadpool_info

import jaxsat
from jaxsat.inertial import programs
from jaxsat.inertial.programs import (
    Beside,
    computing,
    keep_traces,
    on_processor,
    stored_jit,
    trace_ahead,
)

TRACED = []


class Pair(eqx.Module):
    value: jax.Array
    name: str = eqx.field(static=True)
    nothing: None = None


def scaled(pair: Pair, factor, power: int):
    TRACED.append((pair.name, power))
    matrix = jnp.eye(3, dtype=pair.value.dtype) + jnp.outer(pair.value, pair.value)
    return Pair(jnp.linalg.cholesky(matrix)[:, 0] * factor**power, pair.name + "!"), {
        "sum": jnp.sum(pair.value)
    }


@pytest.fixture
def folder(tmp_path):
    TRACED.clear()
    keep_traces(tmp_path / "traces")
    yield tmp_path / "traces"
    keep_traces(None)
    programs._loaded.clear()


def fresh():
    """The function as a new process has it."""
    programs._loaded.clear()
    return stored_jit(scaled)


PAIR = Pair(jnp.array([1.0, 2.0, 3.0]), "a")


def check(found, factor=2.0, power=3):
    first, second = found
    matrix = np.eye(3) + np.outer(PAIR.value, PAIR.value)
    np.testing.assert_allclose(first.value, np.linalg.cholesky(matrix)[:, 0] * factor**power)
    assert first.name == "a!" and first.nothing is None and second["sum"] == 6.0


def test_a_later_process_does_not_trace(folder):
    for _ in range(3):
        check(fresh()(PAIR, np.asarray(2.0), 3))
    assert TRACED == [("a", 3)] and len(list(folder.iterdir())) == 1


def test_what_is_no_array_and_shapes_and_types_have_traces_of_their_own(folder):
    run = fresh()
    check(run(PAIR, np.asarray(2.0), 3))
    check(run(PAIR, np.asarray(2.0), 2), power=2)
    assert run(Pair(PAIR.value, "b"), np.asarray(2.0), 3)[0].name == "b!"
    run(PAIR, np.asarray([2.0]), 3)
    run(Pair(PAIR.value.astype(jnp.float32), "a"), np.asarray(2.0, np.float32), 3)
    assert len(TRACED) == 5 == len(list(folder.iterdir()))


def test_other_code_has_a_trace_of_its_own(folder, monkeypatch):
    fresh()(PAIR, np.asarray(2.0), 3)
    monkeypatch.setattr(programs, "_surroundings", lambda: "another version")
    fresh()(PAIR, np.asarray(2.0), 3)
    assert len(TRACED) == 2


@pytest.mark.parametrize("content", [b"", b"no trace", None])
def test_a_spoilt_trace_is_made_anew(folder, content):
    fresh()(PAIR, np.asarray(2.0), 3)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    for _ in range(2):
        check(fresh()(PAIR, np.asarray(2.0), 3))
    assert len(TRACED) == 2


def test_a_folder_that_cannot_be_written_costs_a_trace_only(folder):
    folder.parent.joinpath("file").write_text("")
    keep_traces(folder.parent / "file" / "traces")
    check(fresh()(PAIR, np.asarray(2.0), 3))


def test_what_is_traced_ahead_is_neither_traced_nor_compiled_by_the_call(folder):
    run = fresh()
    with Beside(1) as beside:
        beside.submit(trace_ahead(run, Pair(np.zeros(3), "a"), np.zeros(()), 3)).result()
    (program,) = programs._loaded.values()
    assert isinstance(program._run, Compiled)
    check(run(PAIR, np.asarray(2.0), 3))
    assert TRACED == [("a", 3)] and list(programs._loaded.values()) == [program]


def test_without_a_folder_nothing_is_done_ahead(folder):
    keep_traces(None)
    trace_ahead(stored_jit(scaled), PAIR, np.asarray(2.0), 3)()
    assert TRACED == []


def test_threads_beside_compute_as_the_one_that_submits():
    with jax.enable_x64(False), Beside(2) as beside:
        assert beside.submit(lambda: jnp.ones(1).dtype).result() == jnp.float32
        with computing():
            assert list(beside.map(lambda n: jnp.ones(n).dtype, [1, 2])) == [jnp.float64] * 2


def test_what_cannot_be_kept_runs_all_the_same(folder, monkeypatch):
    from jax import export

    def refuse(*_):
        raise ValueError("not this operation")

    monkeypatch.setattr(export, "export", refuse)
    run = fresh()
    for _ in range(2):
        check(run(PAIR, np.asarray(2.0), 3))
    assert TRACED == [("a", 3)] and not folder.exists()


def test_a_fault_of_the_function_is_the_callers(folder):
    with pytest.raises(TypeError):
        fresh()(PAIR, np.ones(7), 3)


def test_inside_another_program_it_is_the_function(folder):
    run = fresh()
    found = jax.vmap(lambda value: run(Pair(value, "a"), jnp.asarray(2.0), 3)[1]["sum"])(jnp.ones((4, 3)))
    np.testing.assert_allclose(found, 3.0)
    assert not folder.exists()


def test_each_kind_of_device_has_traces_of_its_own(folder, monkeypatch):
    """On the CPU beside an accelerator a program runs that was exported for a CPU."""
    call = fresh()
    with on_processor():
        check(call(PAIR, jnp.asarray(2.0), 3))
    check(call(PAIR, jnp.asarray(2.0), 3))
    assert len(TRACED) == 1, "here both are the CPU"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with on_processor():
        assert programs._platform() == "cpu"
    assert programs._platform() == "gpu"


def test_what_runs_within_another_program_has_a_trace_too(folder):
    """Spread over devices, each of which runs it; its own process traces it once, later ones do not."""
    assert jax.local_device_count() > 1, "spread over one device it is not spread"
    mesh = jax.make_mesh((jax.local_device_count(),), ("devices",), devices=jax.local_devices())
    spread = PartitionSpec("devices")
    values = jnp.arange(6.0 * jax.local_device_count()).reshape(-1, 3)

    def each(values, factor):
        TRACED.append(values.shape)
        return jax.vmap(lambda x: jnp.linalg.cholesky(jnp.eye(3) + jnp.outer(x, x))[:, 0] * factor)(values)

    def spread_over_devices(inner):
        def outer(values, factor):
            local = partial(lambda x, factor: inner(x, factor), factor=factor)
            return jax.shard_map(local, mesh=mesh, in_specs=spread, out_specs=spread, check_vma=False)(values)

        return jax.jit(outer)(jax.device_put(values, NamedSharding(mesh, spread)), 2.0)

    expected = [np.linalg.cholesky(np.eye(3) + np.outer(x, x))[:, 0] * 2.0 for x in np.asarray(values)]
    for _ in range(3):
        programs._loaded.clear()
        np.testing.assert_allclose(spread_over_devices(stored_jit(each, None)), expected)
    assert TRACED == [(2, 3)] and len(list(folder.iterdir())) == 1


def test_lapack_has_one_thread_and_jax_double_precision_while_something_is_computed():
    def state():
        blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
        return blas, bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]

    with jax.enable_x64(False):
        before = state()
        with computing(), computing():
            inside = state()
        assert inside == ([1] * len(before[0]), True) and before[0]
        assert state() == before


def test_a_process_does_not_die_of_the_programs_that_it_has_compiled(monkeypatch):
    """Where half of the allowed memory maps are taken they are forgotten, and compiled again when they are needed."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("memory maps are counted on Linux only")

    def count():
        return maps.read_bytes().count(b"\n")

    @jax.jit
    def bent(x):
        return jnp.sort(jnp.sin(x)) @ jnp.cumsum(x)

    monkeypatch.setattr(programs, "COUNTED_EVERY", 0.0)
    expected, before = bent(jnp.arange(7.0)), count()
    programs.make_room()
    assert bent._cache_size() == 1
    monkeypatch.setattr(programs, "MOST_MAPS", 0.0)
    programs.make_room()
    assert bent._cache_size() == 0 and count() < before
    assert bent(jnp.arange(7.0)) == expected


def test_a_small_loop_is_one_program_of_the_processor():
    if jax.default_backend() != "cpu":
        pytest.skip("loops of a CPU are meant")

    def running(x):
        return jax.lax.scan(lambda total, each: (total + jnp.sin(each) * total.T,) * 2, jnp.zeros((9, 9)), x)

    made = jax.jit(running).lower(jnp.ones((100, 9, 9))).compile().as_text()
    assert made is not None and "xla_cpu_small_call" in made


@pytest.mark.parametrize("own", ["", "--xla_cpu_max_isa=AVX2", "--xla_backend_extra_options=other=1"])
def test_what_a_user_tells_xla_stays(monkeypatch, own):
    monkeypatch.setenv("XLA_FLAGS", own)
    jaxsat._make_small_loops_one()
    jaxsat._make_small_loops_one()
    flags = os.environ["XLA_FLAGS"].split()
    assert set(own.split()) <= set(flags)
    assert sum(flag.startswith("--xla_backend_extra_options") for flag in flags) == 1
