"""The tables of Barraza-Madrigal et al. 2014, and attitude on real trials beside Madgwick, Mahony and VQF.

    python scripts/orientation_tables.py ../shared/data [--only static moving broad clipped] [-o results/orientation]

`configs/orientation/board.toml` says what is measured. Recordings: BROAD (Laidig et al., Data 2021, 6(7), 72,
CC BY 4.0) and a still stretch of x-io's `fusion_sensor_data.csv` (MIT). Truth tunes gains on the named training
trials and scores. The packages that it compares with are the extra `bench`. A run with --only keeps the other
tables; README.md and board.json are written from all of them.
"""

import argparse
import json
import tomllib
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from peers import import_peer
from scipy.ndimage import uniform_filter1d

from jaxsat.attitude import orient
from jaxsat.config import Orientation, load_config
from jaxsat.inertial.orientation import Direction, Gains, start_at_rest
from jaxsat.signals.formats import GRAVITY
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.boards import Row, write_board
from jaxsat.studies.metrics import attitude_errors, load_broad_truth
from jaxsat.studies.motions import Joint
from jaxsat.studies.simulate import Sensor, simulate
from jaxsat.studies.tuning import Trials, tune_gains

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "orientation" / "board.toml"
TABLES = ("static", "moving", "tuning", "broad", "clipped")
ESTIMATES = ("gyro", "accel", "gyro_accel", "pi", "smoothed")
PAPER = {
    "gyro": (22.85, 45.15, 19.87),
    "accel": (0.34, 0.17, 0.002),
    "gyro_accel": (0.33, 0.12, 9.26),
    "pi": (0.001, 0.10, 9.21),
}
AXES = "xyz"
# A data frame: its type stubs know too little of what is done with one here.
Table = Any


def settings(**given: Any):
    """The default configuration, with some of [orientation] replaced."""
    return load_config(None, **{f"orientation.{key}": value for key, value in given.items()})


def sensor(c: dict) -> Sensor:
    """The simulated device; `Sensor` scales a density by √rate, the bandwidth lets more through."""
    spread = {name: np.sqrt(c[f"{name}_bandwidth"] / c["rate_hz"]) for name in ("gyr", "acc")}
    return Sensor(
        gyr_density=float(np.deg2rad(c["gyr_noise"]) * spread["gyr"]),
        acc_density=float(c["acc_noise"] * GRAVITY * spread["acc"]),
        gyr_bias=np.deg2rad(c["gyr_bias"]),
        acc_bias=np.array(c["acc_bias"]) * GRAVITY,
        gyr_rail=float(np.deg2rad(c["gyr_rail"])),
        acc_rail=c["acc_rail"] * GRAVITY,
    )


def warmed(recording: Recording, c: dict) -> Recording:
    """With both zeros drifting as the device warms."""
    share = (recording.time / 300.0 * c["warming"])[:, None]
    drift = [np.deg2rad(c["gyr_per_degree"])] * 3 + [c["acc_per_degree"] * GRAVITY] * 3
    return recording.with_signal(recording.signal + share * drift)


def angles(recording: Recording, **given: Any) -> np.ndarray:
    """Angles about x, y, z (deg)."""
    return np.rad2deg(np.unwrap(orient(recording, settings(**given)).euler, axis=0))


def at_rest(recording: Recording, name: str) -> list[dict]:
    """Rows of Table 1: drift between the means of the first and the last second, noise about running means."""
    second = round(1 / recording.period)
    rows = []
    options: dict[str, Any] = {name: {"estimate": name} for name in ESTIMATES}
    options["pi, Good Gain"] = {"estimate": "pi", "gains": "good_gain"}
    options["pi, Good Gain, tau 0"] = {"estimate": "pi", "gains": "good_gain", "tau": 0.0}
    for label, given in options.items():
        found = angles(recording, **given)
        drift = np.abs(found[-second:].mean(axis=0) - found[:second].mean(axis=0))
        noise = (found - uniform_filter1d(found, second, axis=0))[second:-second].std(axis=0)
        rows.append(
            {
                "recording": name,
                "estimate": label,
                **{f"drift_{axis}": drift[k] for k, axis in enumerate(AXES)},
                **{f"rmse_{axis}": noise[k] for k, axis in enumerate(AXES)},
            }
        )
        print(name, label, drift.round(3), noise.round(4), flush=True)
    return rows


def static_table(c: dict, data: Path) -> Table:
    device, duration = c["sensor"], c["static"]["duration"]
    still, rows = Joint(start=duration + 1.0), []
    for seed in range(c["static"]["seeds"]):
        recording, _ = simulate(
            still, rate=device["rate_hz"], duration=duration, sensor=sensor(device), key=jax.random.key(seed)
        )
        rows += at_rest(warmed(recording, device), "simulated, 300 s")
    table: Table = pd.DataFrame(rows)
    simulated = table.groupby(["recording", "estimate"], sort=False).mean().reset_index()
    real = read(data / "xio" / "fusion_sensor_data.csv")
    first, last = (int(np.searchsorted(real.time, t)) for t in c["static"]["tail"])
    tail = Recording(
        real.time[first:last] - real.time[first],
        real.gyr[first:last],
        real.acc[first:last],
        real.missing[first:last],
        name="tail",
    )
    return pd.concat([simulated, pd.DataFrame(at_rest(tail, "real, 32 s"))], ignore_index=True)


def moving_table(c: dict, data: Path) -> Table:
    """Table 2: ±90° about each axis; drift at the end and RMSE of the angle about that axis (deg)."""
    device, rows = c["sensor"], []
    options: dict[str, Any] = {name: {"estimate": name} for name in ESTIMATES}
    options["pi, Q_comp"] = {"estimate": "pi", "update": "comp"}
    options["pi, Q_imp"] = {"estimate": "pi", "update": "imp"}
    options["pi, Eq. 11"] = {"estimate": "pi", "direction": "unit", "tau": 0.0}
    options["pi, Good Gain"] = {"estimate": "pi", "gains": "good_gain"}
    for lever in c["moving"]["levers"]:
        for k, axis in enumerate(AXES):
            motion = Joint(axis=np.eye(3)[k], lever=np.full(3, lever))
            recording, truth = simulate(
                motion,
                rate=device["rate_hz"],
                duration=c["moving"]["duration"],
                sensor=sensor(device),
                key=jax.random.key(k),
            )
            recording = warmed(recording, device)
            turned = 2 * np.arctan2(truth.q_nb[:, 1 + k], truth.q_nb[:, 0])
            for label, given in options.items():
                found = orient(recording, settings(**given))
                # Relative to the start: the zero of the accelerometer tilts the whole, which is no drift.
                error = np.angle(np.exp(1j * (found.euler[:, k] - found.euler[0, k] - turned)))
                rows.append(
                    {
                        "lever": lever,
                        "axis": axis,
                        "estimate": label,
                        "drift": np.rad2deg(abs(error[-round(1 / recording.period) :].mean())),
                        "rmse": np.rad2deg(np.sqrt(np.mean(error**2))),
                    }
                )
                print(*rows[-1].values(), flush=True)
    return pd.DataFrame(rows)


def load_trial(path: Path) -> tuple[Recording, np.ndarray, np.ndarray]:
    """A BROAD trial, its true attitude and the samples that count: moving and tracked."""
    _, q_nb, _, valid = load_broad_truth(path)
    with np.load(path) as arrays:
        moving = arrays["movement"].astype(bool)
    return read(path), q_nb, valid & moving


def tuning_table(c: dict, data: Path) -> Table:
    """Gains by gradient on the training trials: for what is the default, and for the paper's form of it."""
    trials = [load_trial(data / "broad" / f"{name}.npz") for name in c["broad"]["train"]]
    n = max(len(recording) for recording, _, _ in trials)
    start, given, rows = c["tuning"]["start"], Orientation(), []
    with jax.enable_x64(True):
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(_padded(*trial, n) for trial in trials))
        forms: tuple[tuple[Direction, float], ...] = (("mean", start["tau"]), ("unit", 0.0))
        for direction, tau in forms:
            first = jax.tree.map(
                lambda x: jnp.asarray(x, float), Gains(start["kp"], start["ki"], tau, np.inf, given.limit)
            )
            best = tune_gains(
                stacked,
                first,
                direction=direction,
                steps=c["tuning"]["steps"],
                rate=c["tuning"]["rate"],
                report=lambda k, loss, g: print(k, np.rad2deg(np.sqrt(loss)), g.kp, g.ki, g.tau, flush=True),
            )
            rows.append(
                {"form": direction, **{name: float(getattr(best, name)) for name in ("kp", "ki", "tau")}}
            )
    return pd.DataFrame(rows)


def _padded(recording: Recording, q_nb: np.ndarray, scored: np.ndarray, n: int) -> Trials:
    def pad(x):
        return jnp.asarray(np.pad(x, ((0, n - len(x)), *((0, 0) for _ in x.shape[1:]))))

    w, x, y, z = q_nb.T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    first = recording.signal[: round(1 / recording.period)]
    return Trials(
        pad(recording.signal),
        pad(np.full(len(recording), recording.period)),
        pad(~recording.missing.reshape(-1, 2, 3).any(axis=2)),
        start_at_rest(jnp.asarray(first)),
        pad(up),
        pad(scored),
    )


def ours(recording: Recording, rails: dict | None = None, **given: Any) -> np.ndarray:
    options = {f"orientation.{key}": value for key, value in given.items()}
    return orient(recording, load_config(None, **options, **(rails or {}))).after


def offset_taken_off(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rates without the mean of the first second, and the level start: what filters without a bias are given."""
    first = recording.signal[: round(1 / recording.period)].mean(axis=0)
    with jax.enable_x64(True):
        q = np.asarray(start_at_rest(jnp.asarray(first[None])).q_nb)
    return recording.gyr - first[:3], q


def madgwick(recording: Recording, gain: float) -> np.ndarray:
    filters, (gyr, q0) = import_peer("ahrs.filters"), offset_taken_off(recording)
    return filters.Madgwick(gyr=gyr, acc=recording.acc, frequency=1 / recording.period, gain=gain, q0=q0).Q


def mahony(recording: Recording, kp: float, ki: float) -> np.ndarray:
    filters, (gyr, q0) = import_peer("ahrs.filters"), offset_taken_off(recording)
    return filters.Mahony(gyr=gyr, acc=recording.acc, frequency=1 / recording.period, k_P=kp, k_I=ki, q0=q0).Q


def vqf(recording: Recording, offline: bool) -> np.ndarray:
    package = import_peer("vqf")
    gyr, acc = np.ascontiguousarray(recording.gyr), np.ascontiguousarray(recording.acc)
    if offline:
        return package.offlineVQF(gyr, acc, None, recording.period, {})["quat6D"]
    return package.VQF(recording.period).updateBatch(gyr, acc)["quat6D"]


Known = dict[tuple[str, str], Any]
"""Errors (deg) by filter and trial."""


def errors_of(label: str, run: Any, name: str, trial: tuple, known: Known) -> np.ndarray:
    """Total, heading and inclination RMSE (deg) of a filter on a trial, computed once."""
    if (label, name) not in known:
        recording, q_nb, scored = trial
        known[label, name] = np.rad2deg(attitude_errors(run(recording), q_nb, scored))
    return known[label, name]


def best_of(candidates: dict[str, Any], trials: dict[str, tuple], known: Known) -> str:
    """The candidate of least mean inclination error on the training trials."""
    means = {}
    for label, run in candidates.items():
        errors = [errors_of(label, run, name, trial, known)[2] for name, trial in trials.items()]
        means[label] = np.mean(errors)
        print("training", label, means[label], flush=True)
    return min(means, key=means.__getitem__)


def broad_table(c: dict, data: Path, tuned: Table) -> Table:
    b = c["broad"]
    trials = {name: load_trial(data / "broad" / f"{name}.npz") for name in (*b["train"], *b["test"])}
    training, known = {name: trials[name] for name in b["train"]}, {}
    paper = tuned.set_index("form").loc["unit"]
    paper_form = {"estimate": "pi", "direction": "unit", "tau": 0.0, "kp": paper["kp"], "ki": paper["ki"]}
    gradient = tuned.set_index("form").loc["mean"].to_dict()
    runs = {
        "jaxsat gyro": partial(ours, estimate="gyro"),
        "jaxsat gyro_accel": partial(ours, estimate="gyro_accel"),
        "jaxsat pi": partial(ours, estimate="pi"),
        "jaxsat pi, Q_comp": partial(ours, estimate="pi", update="comp"),
        "jaxsat pi, Q_imp": partial(ours, estimate="pi", update="imp"),
        "jaxsat pi, gate 1 m/s²": partial(ours, estimate="pi", gate=1.0),
        "jaxsat pi, tau 0, ki 0": partial(ours, estimate="pi", tau=0.0, ki=0.0),
        "jaxsat pi, Eq. 11, tau 0": partial(ours, **paper_form),
        "jaxsat pi, Eq. 11, tau 0, gate 1 m/s²": partial(ours, **paper_form, gate=1.0),
        "jaxsat pi, Good Gain": partial(ours, estimate="pi", gains="good_gain"),
        "jaxsat pi, by gradient": partial(ours, estimate="pi", **gradient),
        "jaxsat smoothed": ours,
        "VQF": partial(vqf, offline=False),
        "VQF offline": partial(vqf, offline=True),
    }
    filters = {f"Madgwick, gain {g:g}": partial(madgwick, gain=g) for g in b["madgwick_gain"]}
    best = best_of(filters, training, known)
    runs |= {label: filters[label] for label in dict.fromkeys((best, "Madgwick, gain 0.033"))}
    filters = {
        f"Mahony, kp {kp:g}, ki {ki:g}": partial(mahony, kp=kp, ki=ki)
        for kp in b["mahony_kp"]
        for ki in b["mahony_ki"]
    }
    best = best_of(filters, training, known)
    runs |= {best: filters[best]}
    rows = []
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
    return pd.DataFrame(rows)


def clipped_table(c: dict, data: Path) -> Table:
    """Trials whose rates pass the limit: unclipped, clipped and ignored, clipped and filled."""
    rows, limit = [], float(np.deg2rad(c["broad"]["clip"]))
    for name in sorted((*c["broad"]["train"], *c["broad"]["test"])):
        recording, q_nb, scored = load_trial(data / "broad" / f"{name}.npz")
        beyond = np.asarray(np.abs(recording.gyr) > limit)
        if not np.any(beyond):
            continue
        clipped = eqx.tree_at(lambda r: r.gyr, recording, np.clip(recording.gyr, -limit, limit))
        rails = {"rails.gyr": limit}
        filled = eqx.tree_at(
            lambda r: r.gyr, clipped, orient(clipped, load_config(None, **rails)).filled[:, :3]
        )
        values = {
            "gyr_max": np.rad2deg(np.abs(recording.gyr).max()),
            "saturated": float(np.mean(np.any(beyond, axis=1)[scored])),
        }
        for estimate in ("pi", "smoothed"):
            for label, run in (
                ("unclipped", partial(ours, recording, estimate=estimate)),
                ("ignored", partial(ours, clipped, {"rails.gyr": "none"}, estimate=estimate)),
                ("filled", partial(ours, clipped, rails, estimate=estimate)),
            ):
                errors = np.rad2deg(attitude_errors(run(), q_nb, scored))
                rows.append({"trial": name, **values, "filter": f"jaxsat {estimate}", "input": label})
                rows[-1] |= dict(zip(("total", "heading", "inclination"), errors, strict=True))
                print(*rows[-1].values(), flush=True)
        for label, given in (("unclipped", recording), ("ignored", clipped), ("filled", filled)):
            errors = np.rad2deg(attitude_errors(vqf(given, True), q_nb, scored))
            rows.append({"trial": name, **values, "filter": "VQF offline", "input": label})
            rows[-1] |= dict(zip(("total", "heading", "inclination"), errors, strict=True))
    return pd.DataFrame(rows)


def board(tables: dict[str, Table]) -> list[Row]:
    """The numbers that are aimed at."""
    rows = []
    static = tables["static"].set_index(["recording", "estimate"])
    for recording, word in (("simulated, 300 s", "static"), ("real, 32 s", "tail")):
        gyro = static.loc[(recording, "gyro")]
        forms = (
            ("", "pi, Good Gain, tau 0"),
            ("_low_pass", "pi, Good Gain"),
            ("_default", "pi"),
            ("_smoothed", "smoothed"),
        )
        for suffix, label in forms:
            pi = static.loc[(recording, label)]
            for axis, paper in zip("xy", PAPER["pi"][:2], strict=True):
                note = f"{recording}, {label}; baseline: the gyroscope alone; the paper in 300 s: {paper:g}"
                name, value = f"orientation_{word}_drift_{axis}{suffix}", pi[f"drift_{axis}"]
                rows.append(Row(name, value, "deg", "lower", 0.1, gyro[f"drift_{axis}"], note))
        pi = static.loc[(recording, "pi")]
        rows.append(
            Row(
                f"orientation_{word}_drift_z",
                pi["drift_z"],
                "deg",
                "lower",
                None,
                gyro["drift_z"],
                "structural: no correction has a vertical component, so z drifts as the gyroscope (baseline)",
            )
        )
    moving = tables["moving"].set_index(["lever", "axis", "estimate"])
    for axis, paper in (("x", 2.75), ("y", 2.98)):
        worst = max(moving.loc[(lever, axis, "pi")]["rmse"] for lever in {i[0] for i in moving.index})
        note = "±90° six times in 30 s, simulated, the worse of both levers; goal: the paper's"
        gyro = moving.xs((axis, "gyro"), level=("axis", "estimate"))["rmse"].max()
        rows.append(Row(f"orientation_moving_rmse_{axis}", worst, "deg", "lower", paper, gyro, note))
    means = tables["broad"].groupby("filter")[["total", "heading", "inclination"]].mean()
    tests = tables["broad"].query("split == 'test'").groupby("filter")["inclination"].mean()
    for label, metric in (("jaxsat pi", "pi"), ("jaxsat smoothed", "smoothed")):
        peer = "VQF" if metric == "pi" else "VQF offline"
        rows.append(
            Row(
                f"orientation_broad_inclination_{metric}",
                means["inclination"][label],
                "deg",
                "lower",
                0.75,
                means["inclination"][peer],
                f"mean RMSE of eight trials; the five test trials: {tests[label]:.3f}; baseline: {peer}",
            )
        )
        for what in ("total", "heading"):
            note = f"mean RMSE of eight trials, constant heading taken off; baseline: {peer}"
            values = means[what]
            rows.append(
                Row(
                    f"orientation_broad_{what}_{metric}",
                    values[label],
                    "deg",
                    "lower",
                    None,
                    values[peer],
                    note,
                )
            )
    clipped = tables["clipped"].query("filter == 'jaxsat smoothed'").set_index(["trial", "input"])
    for trial in dict.fromkeys(clipped.index.get_level_values(0)):
        total = {word: clipped.loc[(trial, word)]["total"] for word in ("unclipped", "ignored", "filled")}
        rows.append(
            Row(
                f"orientation_clipped_ratio_{trial[:2]}",
                total["filled"] / total["unclipped"],
                "1",
                "lower",
                1.2,
                total["ignored"] / total["unclipped"],
                f"{trial}: total RMSE, clipped at 500 °/s and filled, over unclipped ({total['unclipped']:.2f}°); "
                f"{clipped.loc[(trial, 'filled')]['saturated']:.1%} of the moving samples saturate; "
                "baseline: ignored",
            )
        )
    return rows


def markdown(table: Table, digits: int = 3) -> str:
    cells = [
        [f"{x:.{digits}f}" if isinstance(x, float) else str(x) for x in row] for row in table.to_numpy(object)
    ]
    lines = [list(table.columns), ["---"] * len(table.columns), *cells]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def page(tables: dict[str, Table], notes: str) -> str:
    broad = tables["broad"]
    means = broad.groupby("filter", sort=False)[["total", "heading", "inclination"]].mean()
    means["inclination, test trials"] = (
        broad.query("split == 'test'").groupby("filter", sort=False)["inclination"].mean()
    )
    wide = broad.pivot(index="trial", columns="filter", values="inclination")
    chosen = ["jaxsat pi", "jaxsat smoothed", "VQF", "VQF offline"]
    clipped = tables["clipped"].pivot(
        index=["trial", "gyr_max", "saturated", "filter"], columns="input", values=["total", "inclination"]
    )
    clipped.columns = [f"{what}, {how}" for what, how in clipped.columns]
    moving = tables["moving"].pivot(index=["lever", "estimate"], columns="axis", values=["drift", "rmse"])
    moving.columns = [f"{what} {axis}" for what, axis in moving.columns]
    parts = [
        "# Orientation\n\nMade by `scripts/orientation_tables.py` with `configs/orientation/board.toml`; the numbers "
        "aimed at are in `board.md`, all of them in the CSV files. Degrees throughout.",
        "## At rest (the paper's Table 1)\n\nDrift between the means of the first and the last second; RMSE about a "
        "running mean over one second. The simulated MPU-6050 (mean of five seeds) warms by 0.6 °C, which moves its "
        "zeros as its data sheet says. z drifts with the gyroscope whatever the filter: structural.",
        markdown(tables["static"], 4),
        "## Moving (Table 2)\n\n±90° about each axis, six times in 30 s, the sensor so far from the joint on each "
        "axis (m). The paper: gyro 24.12 / 11.36 / 7.14 RMSE in x / y / z, PI 2.75 / 2.98 / 7.14.",
        markdown(moving.reset_index()),
        "## BROAD\n\nRMSE over the moving and tracked samples of eight trials, mean of the trials; attitude after a "
        "sample against the truth of that sample, decomposed as the benchmark does; without a magnetometer the mean "
        "heading is free. Madgwick and Mahony (`ahrs`) get the rates without their mean over the first second and a "
        "level start; their gains are the best of a grid on the training trials, and Madgwick's default.",
        markdown(means.reset_index()),
        "Inclination by trial:",
        markdown(wide[chosen].reset_index()),
        "Gains by gradient on the training trials (`mean`: the default form; `unit`: Eq. 11 and no low-pass):",
        markdown(tables["tuning"], 4),
        "## Clipped at 500 °/s\n\nTrials that pass the limit.",
        markdown(clipped.reset_index()),
        notes,
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description="Orientation against the paper, peers and motion capture")
    parser.add_argument("data", type=Path, help="folder with broad/ and xio/")
    parser.add_argument("--only", nargs="*", choices=TABLES, default=TABLES)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/orientation"))
    arguments = parser.parse_args()
    c, out = tomllib.loads(CONFIG.read_text()), arguments.output
    out.mkdir(parents=True, exist_ok=True)
    makers = {
        "static": static_table,
        "moving": moving_table,
        "tuning": tuning_table,
        "clipped": clipped_table,
    }
    for name in (name for name in TABLES if name in arguments.only):
        if name == "broad":
            table = broad_table(c, arguments.data, pd.read_csv(out / "tuning.csv"))
        else:
            table = makers[name](c, arguments.data)
        table.round(6).to_csv(out / f"{name}.csv", index=False)
    if not all((out / f"{name}.csv").exists() for name in TABLES):
        return
    tables = {name: pd.read_csv(out / f"{name}.csv") for name in TABLES}
    peers = {name: version(name) for name in ("ahrs", "vqf")}
    configuration = json.loads(Orientation().model_dump_json()) | {"board": c, "peers": peers}
    write_board(out / "board.json", board(tables), configuration)
    notes = out / "notes.md"
    (out / "README.md").write_text(page(tables, notes.read_text() if notes.exists() else ""))


if __name__ == "__main__":
    main()
