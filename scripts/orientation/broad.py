"""Real motion against optical tracking, beside the filters of others."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxsat.studies.metrics import attitude_errors

from . import Table, Trial, load_trial, ours
from .peers import madgwick, mahony, vqf

Known = dict[tuple[str, str], Any]
"""Errors (deg) by filter and trial."""


def broad_table(
    c: dict, data: Path, tuned: Table, again: Sequence[str] = (), former: Table | None = None
) -> Table:
    """again: filters of this package that are run anew, all others standing as they are in a former table."""
    b = c["broad"]
    trials = {name: load_trial(data / "broad" / f"{name}.npz") for name in (*b["train"], *b["test"])}
    training, known = {name: trials[name] for name in b["train"]}, {}
    paper = tuned.set_index("form").loc["unit"]
    alone = {"estimate": "pi", "offset": "integral"}
    paper_form = alone | {"direction": "unit", "tau": 0.0, "kp": paper["kp"], "ki": paper["ki"]}
    gradient = tuned.set_index("form").loc["mean"].to_dict()
    runs = {
        "jaxsat gyro": partial(ours, estimate="gyro"),
        "jaxsat gyro_accel": partial(ours, estimate="gyro_accel"),
        "jaxsat pi": partial(ours, estimate="pi"),
        "jaxsat pi, Q_comp": partial(ours, **alone, update="comp"),
        "jaxsat pi, Q_imp": partial(ours, **alone, update="imp"),
        "jaxsat pi, integral alone": partial(ours, **alone),
        "jaxsat pi, gate 1 m/s²": partial(ours, **alone, gate=1.0),
        "jaxsat pi, tau 0, ki 0": partial(ours, **alone, tau=0.0, ki=0.0),
        "jaxsat pi, Eq. 11, tau 0": partial(ours, **paper_form),
        "jaxsat pi, Eq. 11, tau 0, gate 1 m/s²": partial(ours, **paper_form, gate=1.0),
        "jaxsat pi, Good Gain": partial(ours, **alone, gains="good_gain"),
        "jaxsat pi, by gradient": partial(ours, **alone, **gradient),
        "jaxsat smoothed": ours,
    }
    if former is None:
        runs |= _peers(b, training, known)
        rows = []
    else:
        runs = {label: runs[label] for label in again}
        rows = former[~former["filter"].isin(runs)].to_dict("records")
    for label, run in runs.items():
        for name, trial in trials.items():
            found = errors_of(label, run, name, trial, known)
            split = "train" if name in b["train"] else "test"
            rows.append(
                {"filter": label, "trial": name, "split": split}
                | dict(zip(("total", "heading", "inclination"), found, strict=True))
            )
        mean = np.mean([[r["total"], r["heading"], r["inclination"]] for r in rows[-len(trials) :]], axis=0)
        print(label, mean.round(3), flush=True)
    return pd.DataFrame(rows).sort_values("filter", key=lambda f: ~f.str.startswith("jaxsat"), kind="stable")


def _peers(b: dict, training: dict[str, Trial], known: Known) -> dict[str, Any]:
    """The filters of others, Madgwick's and Mahony's with the best gains of a grid on the training trials."""
    runs: dict[str, Any] = {"VQF": partial(vqf, offline=False), "VQF offline": partial(vqf, offline=True)}
    filters = {f"Madgwick, gain {g:g}": partial(madgwick, gain=g) for g in b["madgwick_gain"]}
    best = best_of(filters, training, known)
    runs |= {label: filters[label] for label in dict.fromkeys((best, "Madgwick, gain 0.033"))}
    filters = {
        f"Mahony, kp {kp:g}, ki {ki:g}": partial(mahony, kp=kp, ki=ki)
        for kp in b["mahony_kp"]
        for ki in b["mahony_ki"]
    }
    best = best_of(filters, training, known)
    return runs | {best: filters[best]}


def best_of(candidates: dict[str, Any], trials: dict[str, Trial], known: Known) -> str:
    """The candidate of least mean inclination error on the training trials."""
    means = {}
    for label, run in candidates.items():
        errors = [errors_of(label, run, name, trial, known)[2] for name, trial in trials.items()]
        means[label] = np.mean(errors)
        print("training", label, means[label], flush=True)
    return min(means, key=means.__getitem__)


def errors_of(label: str, run: Any, name: str, trial: Trial, known: Known) -> np.ndarray:
    """Total, heading and inclination RMSE (deg) of a filter on a trial, computed once."""
    if (label, name) not in known:
        recording, q_nb, scored = trial
        known[label, name] = np.rad2deg(attitude_errors(run(recording), q_nb, scored))
    return known[label, name]
