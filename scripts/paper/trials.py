"""What the experiments share: settings, simulated trials, their elements against the truth, and summaries."""

import json
import tomllib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.config import Config
from jaxsat.pipeline import Estimate, estimate, search_options
from jaxsat.preparation import Prepared, prepare
from jaxsat.saturation.layout import Sizes, bucket
from jaxsat.saturation.solvers import Status
from jaxsat.signals.recording import Recording
from jaxsat.studies.elements import Case, make_case, run_elements
from jaxsat.studies.motions import MOTIONS, Motion
from jaxsat.studies.simulate import Sensor, Truth, simulate

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "paper"
METHODS = ("direct", "triangle", "quadratic", "map")
SWEPT = ("gyr_rail", "acc_rail", "gyr_bound", "acc_bound")
QUANTILES = (0.05, 0.5, 0.95)

Settings = dict[str, Any]


def settings(name: str, quick: bool = False) -> Settings:
    """Those of an experiment; quick: with what its table `quick` changes, for the tests."""
    whole = tomllib.loads((CONFIGS / f"{name}.toml").read_text())
    changes = whole.pop("quick", {})
    return {**whole, **changes} if quick else whole


def config_of(chosen: Settings, **changes: Any) -> Config:
    """Its configuration for simulated recordings, with some sections changed: `rails={"gyr": 5.0}`."""
    # The smoother is told the noise of the sensor, which is white.
    sensor = Sensor()
    noise = {
        "gyr_density": sensor.gyr_density,
        "acc_density": sensor.acc_density,
        "change": 0.0,
        "rest_velocity_sd": 0.01,
    }
    return Config.model_validate({"noise": noise, **chosen["config"], **changes})


def motion_of(chosen: Settings) -> Motion:
    parameters = dict(chosen["motion"])
    return MOTIONS[parameters.pop("kind")](**parameters)


def record(
    chosen: Settings, seed: int, gyr_rail: float = np.inf, acc_rail: float = np.inf
) -> tuple[Recording, Truth]:
    """One noisy recording of its motion, with its true rests."""
    recording, truth = simulate(
        motion_of(chosen),
        rate=chosen["rate"],
        duration=chosen["duration"],
        sensor=Sensor(gyr_rail=gyr_rail, acc_rail=acc_rail),
        key=jax.random.fold_in(jax.random.key(chosen["seed"]), seed),
    )
    return replace(recording, rest=truth.rest, name=f"seed {seed}"), truth


def clipped(chosen: Settings, seed: int) -> tuple[Recording, Truth, Config]:
    """The same as a sensor with its rails records it, and the configuration that knows them."""
    rails = (chosen["rails"].get(sensor, np.inf) for sensor in ("gyr", "acc"))
    recording, truth = record(chosen, seed, *rails)
    return recording, truth, config_of(chosen, rails={"gyr": "none", "acc": "none", **chosen["rails"]})


def estimates(recording: Recording, config: Config, methods: tuple[str, ...]) -> dict[str, Estimate]:
    """One recording by several methods."""
    return {m: estimate(recording, config.model_copy(update={"method": m})) for m in methods}


class Elements(NamedTuple):
    """Unclipped recordings of one motion, as the elements of a sweep."""

    cases: list[Case]
    end: Float[np.ndarray, "3"]
    """Where the motion truly ends (m)."""
    samples: int
    sizes: Sizes
    config: Config


def elements_of(chosen: Settings) -> Elements:
    """Recordings of all seeds; the last ones are kept, since experiments share them."""
    made_of = {
        name: chosen[name] for name in ("seed", "seeds", "rate", "duration", "values", "motion", "config")
    }
    # Bounds are swept.
    made_of["config"] = {k: v for k, v in made_of["config"].items() if k != "saturation"}
    elements = _elements(json.dumps(made_of, sort_keys=True))
    return elements._replace(config=config_of(chosen, rails={"gyr": "none", "acc": "none"}))


@lru_cache(maxsize=1)
def _elements(made_of: str) -> Elements:
    chosen = json.loads(made_of)
    config = config_of(chosen, rails={"gyr": "none", "acc": "none"})
    cases = []
    for seed in range(chosen["seeds"]):
        recording, truth = record(chosen, seed)
        cases.append(_against(truth, prepare(recording, config), config))
    longest = int(np.diff(motion_of(chosen).moving, axis=1).max() * chosen["rate"]) + 2
    sizes = Sizes(bucket(longest, 256), bucket(chosen["values"], 64))
    return Elements(cases, truth.position[-1], len(truth.time), sizes, config)


def _against(truth: Truth, prepared: Prepared, config: Config) -> Case:
    """A case that is compared with the truth, not with the path of the unclipped recording."""
    busy = np.arange(len(prepared.segments))
    path = np.zeros((len(prepared.trial.signal), 3))
    path[: len(truth.position)] = truth.position
    return make_case(prepared, busy, bucket(len(busy), 1), config, path)


def score(trials: Elements, values: Float[np.ndarray, "E 4"], chunk: int) -> pd.DataFrame:
    """Every recording at each row of rails and bounds (the order of `SWEPT`), by every method.

    All chunks have one size, so one compiled program. One row an element and method: last-position error and RMSE
    (m), summed squared error (m², the paper's "position error norm" as we read it), the error of the distance from
    start to stop (m), that of the filled values, and how the search ended; and its ratios to the standard smoother.
    """
    options = tuple(search_options(trials.config, method) for method in METHODS)
    parts = []
    given = (trials.cases, values, chunk, trials.sizes, options, trials.config)
    for some, found in run_elements(*given, standard=True):
        real = slice(0, some.real)
        for method, columns in found.items():
            part = pd.DataFrame({name: column[real] for name, column in columns.items()})
            part.insert(0, "seed", some.which[real])
            part.insert(1, "method", method)
            part[list(SWEPT)] = some.values[real]
            parts.append(part)
    table = pd.concat(parts, ignore_index=True)
    reach = np.sqrt((table[["end_x", "end_y", "end_z"]] ** 2).sum(axis=1))
    table["last"] = table["end_distance"]
    table["norm"] = trials.samples * table["path_rmse"] ** 2
    table["distance"] = np.abs(reach - np.linalg.norm(trials.end))
    keys = ["seed", *SWEPT]
    standard = table.loc[table["method"] == "standard"]
    joined = table[keys].merge(standard[[*keys, "last", "norm", "distance"]], on=keys, how="left")
    for column in ("last", "norm", "distance"):
        table[f"{column}_ratio"] = table[column].to_numpy() / joined[column].to_numpy()
    converged = (Status.CONVERGED, Status.NOTHING_TO_DO)
    table["converged"] = table["status"].isna() | table["status"].isin(converged)
    return table


def summary(table: pd.DataFrame, by: list[str], columns: list[str]) -> pd.DataFrame:
    """Median and 5 % and 95 % quantiles over the seeds, one row a method and value of `by`."""
    groups = table.groupby([*by, "method"], sort=False, dropna=False)
    parts = {
        f"{column}_{name}": groups[column].quantile(q)
        for column in columns
        for name, q in zip(("low", "median", "high"), QUANTILES, strict=True)
    }
    counts = {"seeds": groups.size(), "saturated": groups["saturated"].median()}
    shares = {name: groups[name].mean() for name in ("converged",) if name in table}
    return pd.DataFrame({**counts, **parts, **shares}).reset_index()
