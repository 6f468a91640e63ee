"""Compiled functions: their options and precision, whose traces outlive the process, and which do not crowd it.

JAX keeps compiled programs on disk, but to know which one it needs it traces the Python code anew in each process:
most of what a later run of the command line would wait for. `stored_jit` keeps the traces too.
"""

import hashlib
import os
import pickle
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache, lru_cache, partial, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from threadpoolctl import ThreadpoolController

F = TypeVar("F", bound=Callable[..., Any])
Options = dict[str, Any]
"""Of XLA, by the names of its flags."""

# Of the two emitters that jaxlib 0.10 has for CPUs the newer one, its default, takes about twice as long to compile
# these programs of many small operations, and what it makes is slower. An option that is not known is an error, so it
# is for the jaxlib that knows it.
OPTIONS: Options = {"xla_cpu_use_fusion_emitters": False} if version("jaxlib").startswith("0.10.") else {}
# For what runs for a moment and is compiled for long: without LLVM's optimisations.
UNOPTIMISED: Options = {**OPTIONS, "xla_backend_optimization_level": 0}

# Of the memory maps that Linux allows a process so many may be taken before compiled programs are forgotten. They are
# counted so often (s), which takes 2 ms; in a second a few dozen programs are compiled at most.
MOST_MAPS, COUNTED_EVERY = 0.5, 1.0

_folder: Path | None = None
_loaded: dict[Hashable, "_Program | None"] = {}
_counted = -np.inf


@contextmanager
def computing() -> Iterator[None]:
    """In here JAX computes in double precision, whatever its setting, and LAPACK in one thread.

    Matrices of these problems are small: several threads gain nothing, and where another process wants the cores too
    they wait for each other twenty times as long as they compute.
    """
    with _libraries(len(sys.modules)).limit(limits=1, user_api="blas"), jax.enable_x64(True):
        yield


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Of linear algebra, as loaded. To look for them takes a millisecond, and more come with modules only."""
    return ThreadpoolController()


class Beside(ThreadPoolExecutor):
    """Threads that compute as the one that submits: device and precision are a thread's own settings."""

    def submit(self, function, /, *args, **kwargs):
        device, wide = jax.config.jax_default_device, jax.config.jax_enable_x64  # type: ignore[attr-defined]

        def alike():
            with jax.default_device(device), jax.enable_x64(wide):
                return function(*args, **kwargs)

        return super().submit(alike)


def usable_cores() -> int:
    """That this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_processor() -> AbstractContextManager[Any]:
    """In here JAX makes arrays and runs programs on the CPU, where one trial after the other takes less time."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    # JAX may have been told to use the accelerator alone.
    except RuntimeError:
        return nullcontext()


def compiled(function: F, options: Options = OPTIONS) -> F:
    """`equinox.filter_jit` with the options that suit this package."""
    # What `jax.jit` takes besides is passed on, though its signature does not say so.
    return cast(Any, eqx.filter_jit)(function, compiler_options=options)


def keep_traces(folder: Path | None) -> None:
    """From now on traces are read from and written to this folder; None: to none, as it is at first."""
    global _folder
    _folder = folder


def make_room() -> None:
    """Forget compiled programs where the process has many: to be called before the next recording.

    On a CPU each takes hundreds of memory maps, and a process that has no more of them dies in the next compilation
    (jaxlib 0.10, some 100 programs). What is needed again comes from JAX's cache on disk, if there is one.
    """
    global _counted
    if time.monotonic() - _counted < COUNTED_EVERY:
        return
    _counted = time.monotonic()
    try:
        taken = Path("/proc/self/maps").read_bytes().count(b"\n")
        most = int(Path("/proc/sys/vm/max_map_count").read_text())
    except OSError:
        return
    if taken > MOST_MAPS * most:
        _loaded.clear()
        jax.clear_caches()


def stored_jit(function: F, options: Options | None = OPTIONS) -> F:
    """`compiled` of a function of positional arguments that returns arrays; its trace is kept.

    options: None for one that is called by functions that are traced themselves, which then cannot be transformed.

    A trace is for the code of the package, the versions of what it runs on, the kind of device, and the arguments'
    shapes, types and whatever is no array. One that cannot be read is made anew; where none can be made or written it
    goes without.
    """
    inner = options is None
    jitted = function if inner else compiled(function, options)

    def flat(args):
        arrays, rest = eqx.partition(args, lambda x: isinstance(x, jax.Array | np.ndarray | np.generic))
        return *jax.tree.flatten(arrays), rest

    def load(folder: Path, leaves, structure, rest) -> _Program | None:
        kinds = [jax.typeof(leaf) for leaf in leaves]
        name = f"{function.__module__}.{function.__qualname__}"
        where = _platform()
        settings = name, where, jax.config.jax_enable_x64  # type: ignore[attr-defined]
        plain, form = jax.tree.flatten(rest, is_leaf=lambda x: x is None)
        # To print all of it takes a millisecond, to look it up a tenth of one.
        key = *settings, structure, form, *((type(x), x) for x in plain), *kinds
        if key not in _loaded:
            parts = *settings, _surroundings(), structure, rest, kinds
            path = folder / f"{hashlib.sha256(repr(parts).encode()).hexdigest()}.trace"

            def whole(*given):
                return function(*eqx.combine(jax.tree.unflatten(structure, given), rest))

            _loaded[key] = _read(path, options) or _trace(whole, kinds, where, path, options)
        return _loaded[key]

    @wraps(function)
    def call(*args):
        leaves, structure, rest = flat(args)
        if not inner and any(isinstance(leaf, Tracer) for leaf in leaves):
            return function(*args)
        program = None if _folder is None else load(_folder, leaves, structure, rest)
        return jitted(*args) if program is None else program(*leaves)

    def ahead(*args):
        leaves, structure, rest = flat(args)
        program = None if _folder is None else load(_folder, leaves, structure, rest)
        return (lambda: None) if program is None else partial(program.compile_for, leaves)

    call.ahead = ahead  # type: ignore[attr-defined]
    return cast(F, call)


def trace_ahead(function: Callable[..., Any], *args: Any) -> Callable[[], None]:
    """Trace a function of `stored_jit` for such arguments; what is returned compiles it, in a thread beside others.

    Of arrays only shapes and types count. Where traces are not kept nothing is done: the call itself will compile.
    Python traces one function at a time however many threads there are, so what takes longest to compile comes first.
    """
    return function.ahead(*args)  # type: ignore[attr-defined]


@cache
def _surroundings() -> str:
    """What a trace depends on besides its arguments."""
    code, package = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        code.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    packages = ("jax", "jaxlib", "equinox", "numpy", "optax", "jaxopt")
    versions = [f"{name} {version(name)}" for name in packages]
    return " ".join([code.hexdigest(), platform.python_version(), *versions])


def _platform() -> str:
    """The kind of device that programs run on here."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


class _Program:
    """A trace, to be called with the leaves of its arguments; returns the tree that the function does."""

    def __init__(self, exported: Any, skeleton: Any, options: Options | None):
        self._run: Any = (
            exported.call if options is None else jax.jit(exported.call, compiler_options=options)
        )
        self._structure = jax.tree.structure(skeleton)

    def __call__(self, *leaves: Any) -> Any:
        return jax.tree.unflatten(self._structure, self._run(*leaves))

    def compile_for(self, leaves: list[Any]) -> None:
        if hasattr(self._run, "lower"):
            self._run = self._run.lower(*leaves).compile()


def _read(path: Path, options: Options | None) -> _Program | None:
    from jax import export

    try:
        serialised, skeleton = pickle.loads(path.read_bytes())
        return _Program(export.deserialize(serialised), skeleton, options)
    # Whatever is wrong with it, a trace can be made anew.
    except Exception:
        return None


def _trace(
    function: Callable[..., Any], kinds: list[Any], where: str, path: Path, options: Options | None
) -> _Program | None:
    from jax import export

    structure = None

    def flat(*leaves):
        nonlocal structure
        found, structure = jax.tree.flatten(function(*leaves))
        return found

    shapes = [jax.ShapeDtypeStruct(kind.shape, kind.dtype) for kind in kinds]
    try:
        # JAX exports for a CPU or for the accelerator that there is.
        exported = export.export(jax.jit(flat), platforms=("cpu",) if where == "cpu" else None)(*shapes)
    # Not every operation of every device can be kept; a fault of the function shows again without.
    except Exception:
        return None
    assert structure is not None, "it was traced"
    skeleton = jax.tree.unflatten(structure, list(range(structure.num_leaves)))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Whole or not at all, also where several processes share the folder.
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(pickle.dumps((exported.serialize(), skeleton)))
        Path(file.name).replace(path)
    except OSError:
        pass
    return _Program(exported, skeleton, options)
