"""Many trials at many rails in few calls: each trial is clipped in software, filled again, and compared.

One element is a trial at one gyroscope rail, one accelerometer rail and one pair of bounds; all methods are run on
it. Elements of trials of about the same length share a compiled program, which runs on them in chunks that keep to a
memory budget, spread over the local devices or cores. A trial that cannot be used costs one row of the table.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, get_args

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from jaxsat.config import Config, Method
from jaxsat.errors import InputError
from jaxsat.inertial.programs import computing, make_room, on_processor
from jaxsat.pipeline import search_options
from jaxsat.preparation import Prepared, prepare
from jaxsat.saturation.layout import Sizes, bucket, count_values, padded_sizes
from jaxsat.saturation.solvers import Status
from jaxsat.signals.recording import Recording
from jaxsat.studies.elements import (
    ELEMENTS,
    Case,
    Scores,
    calls_at_once,
    element_bytes,
    make_case,
    measured,
    offset_of,
    run_elements,
)

Progress = Callable[[str, int, int], None]
"""Called with ("sweep", elements done, elements in all)."""

Loader = Callable[[], Recording]
"""Raises `InputError` where there is no recording to load."""

METHODS: tuple[str, ...] = get_args(Method)
SWEPT = ("gyr_rail", "acc_rail", "gyr_bound", "acc_bound")
_COUNTS = ("saturated", "segments", "iterations", "at_bound")
_COLUMNS = (
    *("trial", "method", *SWEPT, "saturated", "segments", "status", "cost_before", "cost_after"),
    *("iterations", "residual", "at_bound", "path_rmse", "end_distance", "end_x", "end_y", "end_z"),
    *("fill_rmse_gyr", "fill_rmse_acc", "note"),
)


def sweep(
    recordings: Sequence[Recording] | Mapping[str, Loader],
    config: Config | None = None,
    *,
    methods: Sequence[str] = ("standard", "direct"),
    gyr_rails: Sequence[float] = (np.inf,),
    acc_rails: Sequence[float] = (np.inf,),
    gyr_bounds: Sequence[float] | None = None,
    acc_bounds: Sequence[float] | None = None,
    memory: float = 2e9,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Clip every recording at every rail, reconstruct it by every method, and tabulate how it went.

    recordings: each with a name of its own; or names and a function for each that loads it when its turn comes.
    Rests are those of the recording as given, and so is the path that is compared with. gyr_rails, acc_rails:
    limits in rad/s and m/s²; infinite leaves a sensor as it is. gyr_bounds, acc_bounds: values of δ_b (default:
    those of the configuration). memory: what the arrays of a call may take (bytes), on each of the local devices or,
    where these are parts of one CPU, in all; one element of each device always runs.

    Returns one row an element and method: `trial` (the name of the recording), `method`, the rails and bounds,
    `saturated` (values), `segments` (that saturate), `status` (that of the worst segment), `cost_before`,
    `cost_after`, `iterations`, `residual`, `at_bound`, `path_rmse` and `end_distance` (m, against the path of the
    recording as given by `standard`), `end_x`…`end_z` (m), `fill_rmse_gyr`, `fill_rmse_acc` (rad/s and m/s², of
    values clipped in software) and `note`. A recording that cannot be loaded or used has one row, with the status
    `failed` and the reason in `note`. Raises `InputError` for rails, bounds, methods and configurations that cannot
    be, and for recordings that are none or share a name.
    """
    plan = _plan(config or Config(), methods, gyr_rails, acc_rails, gyr_bounds, acc_bounds, memory)
    loaders = _loaders(recordings)
    with computing():
        # Called in here: the tolerances among them are arrays of double precision.
        options = tuple(
            search_options(plan.config, method) for method in plan.methods if method != "standard"
        )
        batches, rows = _batches(loaders, plan)
        total, done = sum(len(batch.cases) for batch in batches) * len(plan.grid), 0
        for batch in batches:
            make_room()
            given = (_chunk_size(batch, plan), batch.sizes, options, plan.config, "standard" in plan.methods)
            for chunk, scores in run_elements(batch.cases, plan.grid, *given):
                names = [batch.names[i] for i in chunk.which[: chunk.real]]
                rows += _rows(scores, names, chunk.values, plan.methods)
                done += chunk.real
                if progress:
                    progress("sweep", done, total)
    place = {name: i for i, name in enumerate(loaders)}
    rows.sort(key=lambda row: place[row["trial"]])
    types = {name: "Int64" if name in _COUNTS else "float64" for name in _COLUMNS}
    types |= dict.fromkeys(("trial", "method", "status", "note"), "string")
    return pd.DataFrame(rows, columns=pd.Index(_COLUMNS)).astype(types)


def _loaders(recordings: Sequence[Recording] | Mapping[str, Loader]) -> dict[str, Loader]:
    """Each recording by its name, in order."""
    if not len(recordings):
        raise InputError("there is no recording to sweep; give at least one.")
    if isinstance(recordings, Mapping):
        return dict(recordings)
    loaders: dict[str, Loader] = {}
    for recording in recordings:
        if recording.name in loaders:
            raise InputError(f"two recordings are called '{recording.name}'; give each another name.")
        loaders[recording.name] = lambda r=recording: r
    return loaders


class _Plan(NamedTuple):
    """What a sweep does, checked."""

    config: Config
    methods: tuple[str, ...]
    grid: Float[np.ndarray, "E 4"]
    """Rails and bounds in the order of `SWEPT`."""
    memory: float


def _plan(
    config: Config,
    methods: Sequence[str],
    gyr_rails: Sequence[float],
    acc_rails: Sequence[float],
    gyr_bounds: Sequence[float] | None,
    acc_bounds: Sequence[float] | None,
    memory: float,
) -> _Plan:
    for method in methods:
        if method not in METHODS:
            raise InputError(f"method '{method}' cannot be swept; choose among {', '.join(METHODS)}.")
    if not len(methods):
        raise InputError(f"there is no method to sweep; give at least one of {', '.join(METHODS)}.")
    if config.saturation.segments != "parallel" or config.height.mode == "nonnegative":
        raise InputError(
            "a sweep solves segments in parallel and knows no inequality; set saturation.segments to parallel "
            "and height.mode to auto, off or zero."
        )
    if not memory > 0:
        raise InputError(f"a memory of {memory / 1e9:g} GB cannot be; give a positive number.")
    limits = config.saturation
    axes = (
        _positive(gyr_rails, "a gyroscope rail", np.inf),
        _positive(acc_rails, "an accelerometer rail", np.inf),
        _positive([limits.gyr_bound] if gyr_bounds is None else gyr_bounds, "a gyroscope bound"),
        _positive([limits.acc_bound] if acc_bounds is None else acc_bounds, "an accelerometer bound"),
    )
    return _Plan(config, tuple(dict.fromkeys(methods)), np.array(list(itertools.product(*axes))), memory)


def _positive(values: Sequence[float], what: str, most: float = np.finfo(float).max) -> list[float]:
    for value in values:
        if not 0 < value <= most:
            raise InputError(f"{what} of {value:g} cannot be; give positive numbers.")
    if not len(values):
        raise InputError(f"{what} is missing; give at least one.")
    return list(dict.fromkeys(float(value) for value in values))


class _Batch(NamedTuple):
    """Trials that share a compiled program."""

    cases: list[Case]
    names: list[str]
    sizes: Sizes
    """Of their segments at the lowest rails."""


def _batches(loaders: Mapping[str, Loader], plan: _Plan) -> tuple[list[_Batch], list[dict[str, Any]]]:
    """Trials of equal padded length together; and a row for each that cannot be used."""
    lowest = np.repeat(plan.grid[:, :2].min(axis=0), 3)
    groups: dict[int, list[tuple[str, Prepared, np.ndarray]]] = {}
    failed = []
    for name, load in loaders.items():
        try:
            with on_processor():
                prepared = prepare(replace(load(), name=name), plan.config)
            item = name, prepared, _clipped_most(prepared, lowest, name)
            groups.setdefault(len(prepared.trial.signal), []).append(item)
        except InputError as error:
            failed.append({"trial": name, "status": "failed", "note": str(error)})
    batches = []
    for items in groups.values():
        counts = [count_values(sign, prepared.segments) for _, prepared, sign in items]
        lanes = bucket(max(int((values > 0).sum()) for _, values in counts), 1, factor=2)
        sizes = padded_sizes(
            max(int(samples.max(initial=1)) for samples, _ in counts),
            max(int(values.max(initial=1)) for _, values in counts),
            factor=2,
        )
        with on_processor():
            cases = [
                make_case(prepared, np.flatnonzero(values), lanes, plan.config)
                for (_, prepared, _), (_, values) in zip(items, counts, strict=True)
            ]
        batches.append(_Batch(cases, [name for name, _, _ in items], sizes))
    return batches, failed


def _clipped_most(prepared: Prepared, lowest: Float[np.ndarray, "6"], name: str) -> Int[np.ndarray, "N 6"]:
    """Where the lowest rails saturate; `InputError` where that reaches into rests."""
    raw = np.asarray(prepared.trial.signal) + offset_of(prepared)
    resting = np.abs(raw[: len(prepared.rest)][prepared.rest]).max(axis=0)
    if (resting >= lowest).any():
        axis = int(np.argmax(resting - lowest))
        raise InputError(
            f"{name}: a rail of {lowest[axis]:.4g} {('rad/s', 'm/s²')[axis // 3]} lies within what the sensor reads "
            f"at rest ({resting[axis]:.4g}); sweep higher rails."
        )
    clipped = (np.abs(raw) >= lowest) & np.asarray(measured(prepared.trial))
    return np.where(clipped, 1, np.asarray(prepared.trial.sign))


def _chunk_size(batch: _Batch, plan: _Plan) -> int:
    """How many elements are in a call: as many on every local device, and no more than the memory holds."""
    case, devices, calls = batch.cases[0], jax.local_device_count(), calls_at_once()
    each = element_bytes(len(case.trial.signal), len(case.departure), batch.sizes, plan.methods)
    most, memory = -(-len(batch.cases) * len(plan.grid) // (devices * calls)), plan.memory
    if jax.default_backend() == "cpu":
        most, memory = min(most, ELEMENTS), memory / (devices * calls)
    return devices * int(max(1.0, min(memory / each, most)))


def _rows(
    scores: Scores,
    names: list[str],
    values: Float[np.ndarray, "C 4"],
    methods: tuple[str, ...],
) -> Iterator[dict[str, Any]]:
    """One row an element and method, elements in order."""
    for i, name in enumerate(names):
        for method in methods:
            found = {column: numbers[i] for column, numbers in scores[method].items()}
            # The standard smoother searches nothing.
            idle = "ignored" if found["saturated"] else Status.NOTHING_TO_DO.name.lower()
            status = Status(found["status"]).name.lower() if "status" in found else idle
            swept = dict(zip(SWEPT, values[i], strict=True))
            yield {"trial": name, "method": method, **swept, **found, "status": status}
