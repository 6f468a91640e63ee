"""What jaxsat is compared with: its speed, each peer checked against jaxsat first, and its accuracy.

    python -m scripts.peers --check      # every peer computes what jaxsat computes
    python -m scripts.peers --time       # how long each takes
    python -m scripts.peers --paper      # one segment in the paper's way

- `strapdown`: a bare pass over the samples, compiled by numba; nothing that looks at each sample can do less.
- `paper_way`: δ of one segment as in Dang & Suh 2014, a dense quadratic problem inside a generic solver.
- `smoothers`: the linear smoother by dynamax and by cuthbert, general libraries in JAX.
- `fills`, `gaitmap_rts`: saturated samples filled from the signal alone, and gaitmap's smoother, for accuracy.

A peer that is not installed raises `MissingPeer`; `pip install jaxsat[bench]` brings all of them.
"""

import importlib
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxsat.inertial.strapdown import NavState


class MissingPeer(ImportError):
    """A package to compare with is not installed."""


def import_peer(module: str) -> Any:
    """A module of a peer, imported only when it is asked for."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.split(".")[0]
        raise MissingPeer(
            f"{name} cannot be imported ({error}); pip install 'jaxsat[bench]' brings it."
        ) from None


def numpy_state(q_nb: Any, velocity: Any, position: Any) -> NavState:
    """A state of numpy arrays."""
    return NavState(q_nb, velocity, position)


def shortest(function: Callable, repeats: int = 5) -> float:
    """Seconds of the fastest call; a first one compiles."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return min(seconds)
