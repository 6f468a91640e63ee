"""An estimate in numbers and in plain words: `summary.json`, warnings, and what a recording holds."""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from jaxsat.attitude import Orientation
from jaxsat.config import Config
from jaxsat.pipeline import Estimate
from jaxsat.saturation.solvers import Status
from jaxsat.signals.checks import check
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.signals.rests import find_rests, runs
from jaxsat.signals.support import find_support

_SENSORS = {"gyr": ("gyroscope", "rad/s", slice(0, 3)), "acc": ("accelerometer", "m/s²", slice(3, 6))}


def summarise(estimate: Estimate, source: Path | None = None) -> dict[str, Any]:
    """Everything needed to judge and to repeat an estimate, ready for JSON (SI units).

    source: the file that the recording was read from; its SHA-256 is stored.
    """
    fills = estimate.fills
    # What was searched; a segment without gaps has nothing to do.
    busy = fills.status != Status.NOTHING_TO_DO
    words = [Status(code).name.lower() for code in fills.status[busy]]
    floor = estimate.floor
    constants, constants_sd = (x.tolist() for x in (estimate.calibration.constants, estimate.calibration.sd))
    return {
        "versions": versions(),
        "input": input_summary(estimate.recording, source),
        "configuration": estimate.config.model_dump(mode="json"),
        "method": estimate.config.method,
        "rails": rails_summary(estimate.rails, estimate.gaps),
        "rests": _rests(estimate.recording, estimate.rest),
        "segments": {
            "count": len(estimate.segments),
            "searched": int(busy.sum()),
            "status": {word: words.count(word) for word in sorted(set(words))},
            "iterations": int(fills.iterations.sum()),
            "largest_residual": float(fills.residual[busy].max(initial=0.0)),
        },
        "at_bound": dict(zip(CHANNELS, fills.at_bound.sum(axis=0).tolist(), strict=True)),
        "inflated": dict(zip(CHANNELS, fills.inflated.sum(axis=0).tolist(), strict=True)),
        "cost": {"before": float(estimate.cost_standard), "after": float(estimate.cost)},
        "gravity": float(estimate.gravity),
        "heights": heights_of(estimate),
        "gyr_offset": estimate.gyr_offset.tolist(),
        "gyr_offset_sd": estimate.doubt.gyr_offset.tolist(),
        "bias": dict(zip(CHANNELS, constants[:6], strict=True)),
        "bias_sd": dict(zip(CHANNELS, constants_sd[:6], strict=True)),
        "lever": constants[6:],
        "lever_sd": constants_sd[6:],
        "floor": None
        if floor is None
        else {
            "active_samples": np.flatnonzero(floor.active).tolist(),
            "iterations": int(floor.iterations),
            "converged": bool(floor.converged),
        },
        "seconds": estimate.seconds,
        "warnings": warnings_of(estimate),
    }


def heights_of(estimate: Estimate) -> str:
    """What the path was told of the heights of rests: level (as found), free, zero or nonnegative."""
    mode = estimate.config.height.mode
    return {"auto": "level" if estimate.level else "free", "off": "free"}.get(mode, mode)


def summarise_orientation(found: Orientation, source: Path | None = None) -> dict[str, Any]:
    """Everything needed to judge and to repeat an orientation, ready for JSON (SI units)."""
    gains = found.gains
    used = {name: float(getattr(gains, name)) for name in ("kp", "ki", "tau", "gate", "limit")}
    return {
        "versions": versions(),
        "input": input_summary(found.recording, source),
        "configuration": found.config.model_dump(mode="json"),
        "estimate": found.config.orientation.estimate,
        "gains": {name: value if np.isfinite(value) else "none" for name, value in used.items()},
        "rails": rails_summary(found.rails, found.gaps),
        "gravity": float(found.start.gravity),
        "gyr_offset": found.start.offset.tolist(),
        "bias_at_the_end": found.bias[-1].tolist(),
        "sd": None
        if found.sd is None
        else {
            "inclination_median": float(np.median(found.sd[:, 0])),
            "inclination_largest": float(found.sd[:, 0].max()),
            "heading_at_the_end": float(found.sd[-1, 1]),
        },
        "warnings": found.warnings,
    }


def summarise_sweep(
    table: pd.DataFrame,
    config: Config,
    swept: Mapping[str, Sequence[Any]],
    sources: Sequence[Path],
    seconds: float,
) -> dict[str, Any]:
    """Everything needed to judge and to repeat a sweep, ready for JSON (SI units; an infinite rail is none).

    swept: the values of each parameter; sources: the files of the trials, whose SHA-256 is stored.
    """
    return {
        "versions": versions(),
        "inputs": [{"file": str(path), "sha256": file_hash(path)} for path in sources],
        "configuration": config.model_dump(mode="json"),
        "swept": {
            name: [
                "none" if isinstance(value, float) and not np.isfinite(value) else value for value in values
            ]
            for name, values in swept.items()
        },
        "rows": len(table),
        "status": {word: int(count) for word, count in table["status"].value_counts().sort_index().items()},
        "seconds": round(seconds, 3),
    }


def input_summary(recording: Recording, source: Path | None) -> dict[str, Any]:
    return {
        "name": recording.name,
        "file": None if source is None else str(source),
        "sha256": None if source is None else file_hash(source),
        **extent(recording),
    }


def file_hash(path: Path) -> str | None:
    """SHA-256 of a file; None where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def warnings_of(estimate: Estimate) -> list[str]:
    """What a reader of the results must know, one sentence each."""
    fills, config = estimate.fills, estimate.config
    found = [*estimate.warnings]
    for sensor, (name, unit, channels) in _SENSORS.items():
        given = getattr(config.rails, sensor)
        if isinstance(given, float) and not estimate.saturated[:, channels].any():
            highest = np.abs(estimate.recording.signal[:, channels]).max()
            found.append(
                f"no sample reaches the given {name} rail of {given:g} {unit} (highest: {highest:.4g}); "
                f"check its unit, which on the command line is that of --{sensor}-unit."
            )
    searched = int((fills.status != Status.NOTHING_TO_DO).sum())
    stopped = int((fills.status == Status.MAX_ITERATIONS).sum())
    if stopped:
        found.append(
            f"{stopped} of {searched} searched segments used up their iterations before the search settled; "
            "their filled values are the best found (raise saturation.max_iterations)."
        )
    blind = np.flatnonzero(fills.status == Status.NO_ARRIVAL)
    if len(blind):
        first = estimate.recording.time[estimate.segments.departure[blind[0]] + 1]
        found.append(
            f"no rest follows the motion that begins at {first:.2f} s: its saturated values stay as measured."
        )
    for sensor, (name, unit, channels) in _SENSORS.items():
        count, bound = int(fills.at_bound[:, channels].sum()), getattr(config.saturation, f"{sensor}_bound")
        if count:
            found.append(
                f"{count} filled {name} values lie at the bound of {bound:g} {unit} beyond their rail: there the "
                f"bound decided, not the data (saturation.{sensor}_bound)."
            )
    if estimate.floor is not None and not bool(estimate.floor.converged):
        found.append("the search for rests on the floor did not settle; heights may be off (height.mode).")
    return found


def inspect(recording: Recording, config: Config) -> dict[str, Any]:
    """What a recording holds before anything is estimated, ready for JSON (SI units).

    Raises `InputError` where it makes no sense (units, rate).
    """
    warnings = check(recording)
    rails = find_rails(recording, config.rails.gyr, config.rails.acc)
    saturated, sign = saturation_mask(recording, rails)
    settings = config.rests
    rest = find_rests(
        recording,
        settings.detector,
        settings.threshold,
        settings.window,
        settings.min_duration,
        np.logical_or.reduce(saturated, axis=1),
    )
    return {
        "name": recording.name,
        **extent(recording),
        "specific_force_at_rest": float(np.linalg.norm(recording.acc[rest], axis=1).mean())
        if rest.any()
        else None,
        "lowest": dict(zip(CHANNELS, recording.signal.min(axis=0).tolist(), strict=True)),
        "highest": dict(zip(CHANNELS, recording.signal.max(axis=0).tolist(), strict=True)),
        "saturated": dict(zip(CHANNELS, saturated.sum(axis=0).tolist(), strict=True)),
        "rails": rails_summary(rails, find_gaps(sign)),
        "rests": _rests(recording, rest),
        "support": find_support(recording, rest).sentence(),
        "warnings": warnings,
    }


def extent(recording: Recording) -> dict[str, Any]:
    return {
        "samples": len(recording),
        "rate": round(1 / recording.period, 6),
        "duration": len(recording) * recording.period,
        "missing_values": int(recording.missing.sum()),
    }


def rails_summary(rails: Rails, gaps: Gaps) -> dict[str, Any]:
    """Per channel and side: the limit (null: none), how many samples lie there, and in how many gaps."""
    table = {}
    for j, channel in enumerate(CHANNELS):
        table[channel] = {}
        for side, sign, limit, count in (
            ("low", -1, rails.low[j], rails.low_count[j]),
            ("high", 1, rails.high[j], rails.high_count[j]),
        ):
            mine = (gaps.channel == j) & (gaps.sign == sign)
            table[channel][side] = {
                "rail": float(limit) if np.isfinite(limit) else None,
                "samples": int(count),
                "gaps": int(mine.sum()),
                "longest_gap": int((gaps.end - gaps.start)[mine].max(initial=0)),
            }
    return table


def _rests(recording: Recording, rest: np.ndarray) -> dict[str, Any]:
    starts, ends = runs(rest)
    return {
        "source": "detected" if recording.rest is None else "recording",
        "count": len(starts),
        "share": float(rest.mean()),
        "first": [float(recording.time[starts[0]]), recording.period * int(ends[0])] if len(starts) else None,
        "shortest": recording.period * int((ends - starts).min()) if len(starts) else None,
    }


def versions() -> dict[str, str]:
    names = ("jaxsat", "jax", "jaxlib", "jaxopt", "equinox", "numpy", "scipy")
    device = jax.devices()[0]
    return {
        **{name: version(name) for name in names},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{device.platform}: {device.device_kind}",
    }
