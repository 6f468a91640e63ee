"""Float64, strict promotion, a persistent compilation cache, and the folder of real recordings."""

import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

# Compiling is most of the time of the tests: programs without LLVM's optimisations, made by the older of the two
# emitters that jaxlib has for CPUs, are compiled in a third of it. A flag that is not known ends the process, so that
# is for the jaxlib that knows it. Two devices, so that sweeps have something to spread over.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_force_host_platform_device_count=2"
    + " --xla_cpu_use_fusion_emitters=false" * version("jaxlib").startswith("0.10."),
)

import jax
import pytest

# What the package tells XLA counts only if it comes before the first program.
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording

ROOT = Path(__file__).resolve().parents[1]
jax.config.update("jax_enable_x64", True)
jax.config.update(
    "jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache/jax"))
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(20140506)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings that are not part of the project; they lie beside the checkout where they are present."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not at {folder}")
    return folder


@pytest.fixture
def pyshoe_trial(shared_data) -> Callable[[str], Recording]:
    """Reads a PyShoe recording with the rests that it names."""

    def load(name: str) -> Recording:
        path = shared_data / "pyshoe" / f"{name}.mat"
        if not path.is_file():
            pytest.skip(f"the trial is not at {path}")
        return read(path, rest_column="zv_shoe_opt")

    return load
