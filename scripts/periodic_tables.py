"""Periodic motion: the simulation of Latt et al. 2011, and real recordings that were clipped in software.

    python scripts/periodic_tables.py [simulation] [clip] [arm] [reference] [tremor] [board] [-o DIR] [--data DIR]

Each part writes a table (CSV) and figures; `board` makes board.json, board.md and env.json of the tables. Without
a name, all of them run, in this order.
"""

import argparse
import json
import tomllib
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pandas as pd
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from jaxsat.config import load_config
from jaxsat.inertial.filters import apply, butterworth, response
from jaxsat.inertial.harmonic import Spectrum, least_squares, predict, recursive
from jaxsat.inertial.periodic import analytical, band, chain_response, latt_bmflc, references
from jaxsat.periodic import estimate_periodic
from jaxsat.saturation.harmonic_fill import fill_harmonic
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.signals.support import find_band, find_support
from jaxsat.studies.boards import Row, write_board
from jaxsat.studies.metrics import load_broad_truth

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs" / "periodic"
UNIT = {2: 1e6, 1: 1e3}  # µm and mrad
NAMES = {2: "position", 1: "angle"}
PAPER = {  # RMS and maximum of the method and of analytical integration, without and with the sensor's filter
    (2, False): ((6.2, 23.1), (14.8, 43.6)),
    (2, True): ((6.5, 23.6), (24.1, 65.1)),
    (1, False): ((0.54, 1.78), (1.00, 2.92)),
    (1, True): ((0.56, 2.03), (1.64, 4.45)),
}


def settings(name: str) -> dict[str, Any]:
    return tomllib.loads((CONFIGS / f"{name}.toml").read_text())


@partial(jax.jit, static_argnames=("order", "samples"))
def simulated(key, config, rate, order, lowpass, samples):
    """Time, what the sensor reads, and the true motion."""
    time = jnp.arange(samples) / rate
    omega = 2 * jnp.pi * config["frequencies"]
    angle = time[:, None] * omega
    shape = -jnp.sin(angle) / omega**2 if order == 2 else -jnp.cos(angle) / omega
    read_out = config["amplitude"] * jnp.sin(angle).sum(axis=1) + config["offset"]
    read_out = read_out + config["noise"] * jax.random.normal(key, time.shape)
    for stage in lowpass:
        read_out = apply(stage, read_out)
    return time, read_out, config["amplitude"] * shape.sum(axis=1)


@partial(jax.jit, static_argnames=("order", "samples"))
def errors(key, config, rate, order, mu, frequency, highpass, lowpass, samples):
    """Error of every method at each sample."""
    time, read_out, truth = simulated(key, config, rate, order, lowpass, samples)
    by_analysis = analytical(read_out, time, frequency, order, mu).motion
    x, z = references(frequency, time, chain_response(lowpass, order, frequency))
    # Nothing is known beforehand: sines of up to ten times the signal, an offset of up to 100 m/s².
    weights = 2 * len(frequency)
    prior = jnp.concatenate([jnp.full(weights, 4.0), jnp.full(1, 1e4)])
    spectrum = Spectrum(prior, config["noise"] ** 2)
    # The sensor's filter starts from zero in the simulation: 50 ms, 16 of its time constants, are left out.
    everywhere = jnp.where(time < 0.05, 0.0, 1.0)
    paper = latt_bmflc(read_out, time, frequency, order, highpass, lowpass, mu)
    ignored = latt_bmflc(read_out, time, frequency, order, highpass, (), mu)
    tracked = recursive(read_out, everywhere, x, z, spectrum, jnp.zeros(weights + 1))
    at_once, _ = predict(least_squares(read_out, everywhere, x, spectrum), z)
    found = {
        "modified BMFLC": paper.motion,
        "without compensation": ignored.seen,
        "analytical": by_analysis,
        "analytical, one sample late": jnp.roll(by_analysis, 1),
        "recursive least squares": tracked.motion,
        "least squares": at_once,
    }
    return {name: motion - truth for name, motion in found.items()}


def scores(
    config: dict[str, Any], rate: float, order: int, filtered: bool, mu: float
) -> list[dict[str, Any]]:
    """Median over the seeds of RMS and maximum error, for each method."""
    samples = round(config["duration"] * rate)
    numbers = {key: jnp.asarray(config[key]) for key in ("amplitude", "noise", "offset", "frequencies")}
    highpass = butterworth("highpass", 4, config["highpass"], rate)
    lowpass = (butterworth("lowpass", 1, config["lowpass"], rate),) if filtered else ()
    frequency = jnp.asarray(band(*config["band"]))
    scored = jnp.arange(samples) >= config["settle"] * rate

    def one(key):
        found = errors(key, numbers, rate, order, mu, frequency, highpass, lowpass, samples)
        rms = {name: jnp.sqrt(jnp.sum(scored * e**2) / scored.sum()) for name, e in found.items()}
        return rms, {name: jnp.max(scored * jnp.abs(e)) for name, e in found.items()}

    rms, largest = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(2011), config["seeds"]))
    unit = UNIT[order]
    return [
        {
            "motion": NAMES[order], "rate": rate, "sensor_filter": filtered, "mu": mu, "method": name,
            "rms": float(jnp.median(rms[name])) * unit, "max": float(jnp.median(largest[name])) * unit,
        }
        for name in rms
    ]  # fmt: skip


def simulation(out: Path) -> None:
    config = settings("simulation")
    rows = []
    for rate in config["rates"]:
        for order in (2, 1):
            for filtered in (False, True):
                for mu in config["mus"] if rate == config["rates"][0] else [config["mu"]]:
                    rows += scores(config, rate, order, filtered, mu)
                print(rate, NAMES[order], filtered, flush=True)
    pd.DataFrame(rows).to_csv(out / "simulation.csv", index=False, float_format="%.5g")
    figures(config, out)


def figures(config: dict[str, Any], out: Path) -> None:
    """The figures of the paper's Section 3, redrawn from one seed."""
    rate = config["rates"][0]
    samples = round(config["duration"] * rate)
    numbers = {key: jnp.asarray(config[key]) for key in ("amplitude", "noise", "offset", "frequencies")}
    highpass = butterworth("highpass", 4, config["highpass"], rate)
    lowpass = butterworth("lowpass", 1, config["lowpass"], rate)
    key = jax.random.key(2011)

    axes = np.linspace(8, 12, 200)
    figure, panels = plt.subplots(2, 2, figsize=(9, 5), sharex=True)
    for column, (name, stage) in zip(panels.T, {"low-pass 50 Hz": lowpass, "high-pass 5 Hz": highpass}.items(),
                                     strict=True):  # fmt: skip
        gain = np.asarray(response((stage,), jnp.asarray(axes)))
        column[0].plot(axes, np.abs(gain))
        column[0].set(title=name, ylabel="gain")
        column[1].plot(axes, np.rad2deg(np.angle(gain)))
        column[1].set(xlabel="frequency (Hz)", ylabel="phase (°)")
    save(figure, out / "filters.svg")

    time, read_out, truth = simulated(key, numbers, rate, 2, (), samples)
    figure, panels = plt.subplots(1, 2, figsize=(10, 3))
    panels[0].plot(time, 1e3 * read_out, lw=0.4)
    panels[0].set(xlabel="time (s)", ylabel="mm/s²", title="simulated acceleration")
    drifted = np.cumsum(np.cumsum(read_out)) / rate**2
    panels[1].plot(time, 1e3 * drifted, label="double integration")
    panels[1].plot(time, 1e3 * truth, label="true")
    panels[1].set(xlabel="time (s)", ylabel="mm", title="position")
    panels[1].legend()
    save(figure, out / "drift.svg")

    frequency = jnp.asarray(band(*config["band"]))
    figure, panels = plt.subplots(2, 2, figsize=(11, 6), sharex=True)
    for row, order in zip(panels, (2, 1), strict=True):
        found = errors(key, numbers, rate, order, config["mu"], frequency, highpass, (lowpass,), samples)
        seen = np.asarray(time) >= config["duration"] - 1
        _, _, true = simulated(key, numbers, rate, order, (lowpass,), samples)
        unit, name = UNIT[order], {2: "µm", 1: "mrad"}[order]
        row[0].plot(time[seen], unit * true[seen], "k", lw=2, alpha=0.4, label="true")
        for method in ("without compensation", "modified BMFLC"):
            row[0].plot(time[seen], unit * (true + found[method])[seen], lw=1, label=method)
        row[0].set(ylabel=f"{NAMES[order]} ({name})")
        for method in ("analytical", "modified BMFLC", "least squares"):
            row[1].plot(time[seen], unit * found[method][seen], lw=1, label=method)
        row[1].set(ylabel=f"error ({name})")
    for panel in panels[0]:
        panel.legend(fontsize=7, loc="upper right")
    for panel in panels[1]:
        panel.set_xlabel("time (s)")
    save(figure, out / "errors.svg")


def save(figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def clipped_and_filled(true: np.ndarray, share: float, missing: np.ndarray | None = None) -> dict[str, Any]:
    """Error in the gaps of a clipped copy: filled by harmonics, by a cubic spline, and left as it is."""
    low, high = np.quantile(true, [share / 2, 1 - share / 2])
    sign = (true >= high).astype(int) - (true <= low).astype(int)
    missing = np.zeros(len(true), bool) if missing is None else missing
    sign[missing] = 0
    measured = (sign == 0) & ~missing
    found = fill_harmonic(np.clip(true, low, high), sign, missing)
    index = np.arange(len(true))
    spline = CubicSpline(index[measured], true[measured])(index)
    gap = sign != 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], gap.astype(int), [0]])))
    error = {
        "harmonic": found.signal, "spline": spline, "clipped": np.clip(true, low, high),
    }  # fmt: skip
    error = {name: float(np.sqrt(np.mean((x - true)[gap] ** 2))) for name, x in error.items()}
    inside = np.abs(found.signal - true)[gap] < 1.96 * found.sd[gap]
    return {
        "share": share, "samples": int(gap.sum()), "gaps": len(edges) // 2,
        "longest": int(np.diff(edges)[::2].max()), **error, "ratio": error["harmonic"] / error["spline"],
        "cover95": float(inside.mean()),
    }  # fmt: skip


def arm(out: Path, data: Path) -> None:
    """Rates of the robot arm, which moves from rest to rest: what it supports, and a clipped copy filled."""
    config, rows, supports = settings("tremor"), [], {}
    for path in sorted((data / "robot_arm").glob("*.mat")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # scipy: a variable that is twice in the file
            recording = read(path)
        supports[path.stem] = find_support(recording).sentence()
        for axis in range(3):
            found = clipped_and_filled(
                recording.gyr[:, axis], config["arm_share"], recording.missing[:, axis]
            )
            rows.append({"recording": path.stem, "channel": f"gyr_{'xyz'[axis]}", **found})
            print(rows[-1], flush=True)
    pd.DataFrame(rows).to_csv(out / "arm.csv", index=False, float_format="%.4g")
    (out / "support.json").write_text(json.dumps(supports, indent=2) + "\n")


def reference(out: Path, data: Path) -> None:
    """A hand-held board moved to and fro, against optical tracking (BROAD): position in the band, body axes."""
    config, rows = settings("tremor"), []
    for path in sorted((data / "broad").glob("*translation*.npz")):
        recording = read(path)
        first, count = (round(config[f"reference_{key}"] / recording.period) for key in ("start", "seconds"))
        part = slice(first, first + count)
        recording = Recording(
            recording.time[part],
            recording.gyr[part],
            recording.acc[part],
            recording.missing[part],
            name=path.stem,
        )
        if find_band(recording.acc, recording.period) is None:
            print(path.stem, "has no band in this stretch", flush=True)
            continue
        settled = {"rails.gyr": "none", "rails.acc": "none"}  # none of them saturates
        found = estimate_periodic(recording, load_config(None, **settled))
        low, high = found.band["acc"]
        _, q_nb, position, valid = (x[part] for x in load_broad_truth(path))
        index = np.arange(len(q_nb))
        position = np.stack([np.interp(index, index[valid], axis[valid]) for axis in position.T], axis=1)
        sections = signal.butter(4, [low, high], "bandpass", fs=1 / recording.period, output="sos")
        turn = Rotation.from_quat(q_nb, scalar_first=True)
        true = turn.inv().apply(signal.sosfiltfilt(sections, position, axis=0))
        # Both through the same band, so that what the reference leaves out is not counted.
        seen = signal.sosfiltfilt(sections, found.motion[:, 3:], axis=0)
        size = np.linalg.norm(true, axis=1)
        moving = valid & (size > 0.1 * size.max())
        error = np.sqrt(np.mean(np.sum((seen - true)[moving] ** 2, axis=1)))
        size = np.sqrt(np.mean(np.sum(true[moving] ** 2, axis=1)))
        angle = float(np.sqrt(np.mean(np.sum(found.motion[:, :3] ** 2, axis=1))))
        rows.append({"recording": path.stem, "low": low, "high": high, "rmse_mm": 1e3 * error,
                     "rms_mm": 1e3 * size, "ratio": error / size, "angle_rms": angle})  # fmt: skip
        print(rows[-1], flush=True)
    pd.DataFrame(rows).to_csv(out / "reference.csv", index=False, float_format="%.4g")


def periodic_clip(out: Path) -> None:
    """The simulated acceleration, clipped and filled: a signal that is periodic indeed."""
    config, clips = settings("simulation"), settings("tremor")
    rate = config["rates"][0]
    time = np.arange(round(config["duration"] * rate)) / rate
    noise = config["noise"] * np.random.default_rng(2011).normal(size=len(time))
    true = config["amplitude"] * np.sin(2 * np.pi * np.outer(time, config["frequencies"])).sum(axis=1) + noise
    rows = [
        {"recording": "simulated", "channel": "acc", **clipped_and_filled(true, share)}
        for share in clips["shares"]
    ]
    pd.DataFrame(rows).to_csv(out / "clip.csv", index=False, float_format="%.4g")


def tremor(out: Path, data: Path) -> None:
    config = settings("tremor")
    # Takes minutes: a table that is there already is continued.
    table = out / "tremor.csv"
    rows = pd.read_csv(table).to_dict("records") if table.exists() else []
    done = {(row["recording"], row["channel"], row["share"]) for row in rows}
    for path in sorted((data / "tremor").glob("*.csv")):
        recording = read(path)
        sections = signal.butter(4, config["drift_below"], "highpass", fs=1 / recording.period, output="sos")
        acc = recording.acc[recording.time >= recording.time[0] + config["seconds_dropped"]]
        name = "_".join(path.stem.removeprefix("T_").split("_")[:2]).lower() + (
            "_right" if "RIGHT" in path.stem else ""
        )
        for axis, true in zip("xyz", signal.sosfiltfilt(sections, acc, axis=0).T, strict=True):
            for share in config["shares"]:
                if (name, f"acc_{axis}", share) in done:
                    continue
                rows.append({"recording": name, "channel": f"acc_{axis}", **clipped_and_filled(true, share)})
                print(rows[-1], flush=True)
                pd.DataFrame(rows).to_csv(table, index=False, float_format="%.4g")


def board(out: Path) -> None:
    """The board of the tables."""
    config = settings("simulation")
    table = pd.read_csv(out / "simulation.csv").set_index(["motion", "rate", "sensor_filter", "mu", "method"])
    rate, mu = config["rates"][0], config["mu"]
    rows = []
    for (order, filtered), (ours, theirs) in PAPER.items():
        motion, unit = NAMES[order], {2: "µm", 1: "mrad"}[order]
        where = f"{motion}_{'filter' if filtered else 'plain'}"
        key = (motion, rate, filtered)
        lms = table.loc[(*key, mu, "modified BMFLC")]
        for k, (statistic, label) in enumerate((("rms", "RMS"), ("max", "maximum"))):
            seeds = config["seeds"]
            note = (
                f"{label} error of the modified BMFLC, μ = {mu:g}, median of {seeds} seeds; goal: the paper"
            )
            rows.append(Row(f"{where}_bmflc_{statistic}", lms[statistic], unit, "lower", ours[k], note=note))
            late = table.loc[(*key, config["paper_mu"], "analytical, one sample late")][statistic]
            aligned = table.loc[(*key, mu, "analytical")][statistic]
            note = (
                f"{label} error of analytical integration one sample late, μ = {config['paper_mu']:g}; aligned, "
                f"μ = {mu:g}: {aligned:.4g} {unit}; baseline: the paper's"
            )
            rows.append(
                Row(f"{where}_analytical_{statistic}", late, unit, "lower", baseline=theirs[k], note=note)
            )
        for name in ("recursive least squares", "least squares"):
            value = table.loc[(*key, mu, name)]["rms"]
            note = f"RMS error over that of the modified BMFLC on the same data; {value:.3g} {unit}"
            metric = f"{where}_{name.replace(' ', '_')}_ratio"
            rows.append(Row(metric, value / lms["rms"], "1", "lower", 0.5, note=note))
    labels = (
        ("clip", "the simulated acceleration"),
        ("tremor", "hand tremor"),
        ("arm", "rates of the robot arm, which has no period"),
    )
    for name, label in labels:
        if not (out / f"{name}.csv").exists():
            continue
        gaps = pd.read_csv(out / f"{name}.csv")
        for share, part in gaps.groupby("share"):
            ratio = float(np.exp(np.log(part["ratio"]).mean()))
            note = (
                f"{label}: error in the gaps over a cubic spline's, geometric mean of {len(part)} channels "
                f"({part['ratio'].min():.2f} to {part['ratio'].max():.2f}); 95 % bands hold "
                f"{part['cover95'].mean():.0%}"
            )
            rows.append(Row(f"{name}_fill_ratio_{share:g}", ratio, "1", "lower", 1 / 3, note=note))
    for row in pd.read_csv(out / "reference.csv").to_dict("records"):
        note = (
            f"{row['rmse_mm']:.3g} of {row['rms_mm']:.3g} mm in {row['low']:.2f} to {row['high']:.2f} Hz, against "
            f"optical tracking; angle {row['angle_rms']:.2g} rad RMS"
        )
        rows.append(Row(f"{row['recording']}_position", row["ratio"], "1", "lower", note=note))
    write_board(out / "board.json", rows, {"simulation": config, "tremor": settings("tremor")})


def main() -> None:
    parser = argparse.ArgumentParser(description="Periodic motion")
    parser.add_argument("parts", nargs="*", default=[])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "results" / "periodic")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    arguments = parser.parse_args()
    out = arguments.output
    out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    parts = arguments.parts or ["simulation", "clip", "arm", "reference", "tremor", "board"]
    if "simulation" in parts:
        simulation(out)
    for name, part in (("arm", arm), ("reference", reference), ("tremor", tremor)):
        if name in parts:
            part(out, arguments.data)
    if "clip" in parts:
        periodic_clip(out)
    if "board" in parts:
        board(out)


if __name__ == "__main__":
    main()
