"""Trajectories from inertial recordings that saturated.

The public names are loaded when they are first used, so that importing the package costs nothing.
"""

import os
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsat.attitude import Orientation, orient
    from jaxsat.config import Config, load_config
    from jaxsat.errors import InputError
    from jaxsat.periodic import PeriodicEstimate, estimate_periodic
    from jaxsat.pipeline import Estimate, Trajectory, estimate
    from jaxsat.present.folder import write_periodic, write_results
    from jaxsat.saturation.harmonic_fill import fill_harmonic
    from jaxsat.signals.readers import read
    from jaxsat.signals.recording import Recording
    from jaxsat.studies.metrics import position_rmse
    from jaxsat.studies.motions import MOTIONS
    from jaxsat.studies.simulate import Sensor, simulate
    from jaxsat.studies.sweep import sweep

# On a CPU XLA makes each of the dozens of operations in a loop a program of its own, and for one trial starting them
# takes longer than what they compute. Loops whose steps touch fewer bytes than this become one program, and a filter
# takes a quarter of the time.
SMALL_LOOP = 2**17


def _make_small_loops_one() -> None:
    """XLA takes this for a whole process only, before its first program; a setting of the user's stays."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        option = f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={SMALL_LOOP}"
        os.environ["XLA_FLAGS"] = f"{flags} {option}".strip()


_make_small_loops_one()

_HOME = {
    "Config": "jaxsat.config",
    "Estimate": "jaxsat.pipeline",
    "InputError": "jaxsat.errors",
    "MOTIONS": "jaxsat.studies.motions",
    "Orientation": "jaxsat.attitude",
    "PeriodicEstimate": "jaxsat.periodic",
    "Recording": "jaxsat.signals.recording",
    "Sensor": "jaxsat.studies.simulate",
    "Trajectory": "jaxsat.pipeline",
    "estimate": "jaxsat.pipeline",
    "estimate_periodic": "jaxsat.periodic",
    "fill_harmonic": "jaxsat.saturation.harmonic_fill",
    "load_config": "jaxsat.config",
    "orient": "jaxsat.attitude",
    "position_rmse": "jaxsat.studies.metrics",
    "read": "jaxsat.signals.readers",
    "simulate": "jaxsat.studies.simulate",
    "sweep": "jaxsat.studies.sweep",
    "write_periodic": "jaxsat.present.folder",
    "write_results": "jaxsat.present.folder",
}

__all__ = [  # noqa: RUF022 (the order of _HOME)
    "Config",
    "Estimate",
    "InputError",
    "MOTIONS",
    "Orientation",
    "PeriodicEstimate",
    "Recording",
    "Sensor",
    "Trajectory",
    "estimate",
    "estimate_periodic",
    "fill_harmonic",
    "load_config",
    "orient",
    "position_rmse",
    "read",
    "simulate",
    "sweep",
    "write_periodic",
    "write_results",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("jaxsat")
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsat' has no attribute '{name}'")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
