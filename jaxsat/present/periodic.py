"""A periodic estimate as tables, numbers and text."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxsat.periodic import PeriodicEstimate
from jaxsat.present.summary import input_summary, rails_summary, versions
from jaxsat.present.text import columns, plural
from jaxsat.signals.recording import CHANNELS

MOTION = ("ang_x", "ang_y", "ang_z", "pos_x", "pos_y", "pos_z")
SENSORS = {"gyr": (slice(0, 3), "angle", "rad"), "acc": (slice(3, 6), "position", "m")}


def motion_table(found: PeriodicEstimate) -> pd.DataFrame:
    """One row a sample: `time` (s), `ang_*` (rad) and `pos_*` (m) of the sensors that were used, their `*_sd`.

    The sd is empty for the combiners of the paper, which do not know it.
    """
    table = {"time": found.recording.time}
    used = [j for sensor in found.band for j in range(*SENSORS[sensor][0].indices(6))]
    table |= {MOTION[j]: found.motion[:, j] for j in used}
    unknown = np.full(len(found.recording), np.nan)
    table |= {f"{MOTION[j]}_sd": unknown if found.sd is None else found.sd[:, j] for j in used}
    return pd.DataFrame(table)


def periodic_signals_table(found: PeriodicEstimate) -> pd.DataFrame:
    """One row a sample: `time`, the filled channels, `raw_*`, `sat_*`, and `*_sd` of filled values (else 0)."""
    blocks = {"": found.filled, "raw_": found.recording.signal, "sat_": found.saturated}
    table = {"time": found.recording.time}
    table |= {f"{prefix}{name}": x[:, j] for prefix, x in blocks.items() for j, name in enumerate(CHANNELS)}
    return pd.DataFrame(table | {f"{name}_sd": found.signal_sd[:, j] for j, name in enumerate(CHANNELS)})


def periodic_gaps_table(found: PeriodicEstimate) -> pd.DataFrame:
    """One row a gap: `channel`, `start`, `end` (s, [start, end)), `rail` (signed), `peak` of the fill, `peak_sd`."""
    gaps, recording = found.gaps, found.recording
    rows = []
    for channel, sign, start, end in zip(gaps.channel, gaps.sign, gaps.start, gaps.end, strict=True):
        top = start + int(np.argmax(sign * found.filled[start:end, channel]))
        rows.append(
            (
                CHANNELS[channel],
                recording.time[start],
                recording.time[start] + (end - start) * recording.period,
                sign * float(np.min(sign * recording.signal[start:end, channel])),
                found.filled[top, channel],
                found.signal_sd[top, channel],
            )
        )
    table = pd.DataFrame(rows, columns=["channel", "start", "end", "rail", "peak", "peak_sd"])
    return table.sort_values(["start", "channel"], ignore_index=True)


def summarise_periodic(found: PeriodicEstimate, source: Path | None = None) -> dict[str, Any]:
    """Everything needed to judge and to repeat a periodic estimate, ready for JSON (SI units)."""
    return {
        "versions": versions(),
        "input": input_summary(found.recording, source),
        "configuration": found.config.model_dump(mode="json"),
        "method": found.config.periodic.method,
        "band": {sensor: list(band) for sensor, band in found.band.items()},
        "rails": rails_summary(found.rails, found.gaps),
        "motion": {
            MOTION[j]: {"rms": float(np.sqrt(np.mean(found.motion[:, j] ** 2))), "sd": _typical_sd(found, j)}
            for sensor in found.band
            for j in range(*SENSORS[sensor][0].indices(6))
        },
        "seconds": found.seconds,
        "warnings": found.warnings,
    }


def _typical_sd(found: PeriodicEstimate, channel: int) -> float | None:
    return None if found.sd is None else float(np.median(found.sd[:, channel]))


def periodic_text(found: PeriodicEstimate, path: Path) -> str:
    """What `jaxsat periodic` prints."""
    recording = found.recording
    lines = [
        f"{recording.name}: {len(recording)} samples at {1 / recording.period:.4g} Hz, method "
        f"{found.config.periodic.method}",
        f"saturated: {plural(int(found.saturated.sum()), 'value')} in {plural(len(found.gaps), 'gap')}",
    ]
    rows = [["motion", "band (Hz)", "RMS", "sd", ""]]
    for sensor, (low, high) in found.band.items():
        where, name, unit = SENSORS[sensor]
        for j in range(*where.indices(6)):
            sd = _typical_sd(found, j)
            rms = 1e3 * np.sqrt(np.mean(found.motion[:, j] ** 2))
            known = "-" if sd is None else f"{1e3 * sd:.3g}"
            rows.append([f"{name} {MOTION[j][-1]}", f"{low:.3g}-{high:.3g}", f"{rms:.4g}", known, f"m{unit}"])
    return "\n".join([*lines, columns(rows), f"table: {path}"])
