"""Short plain text for a terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxsat.attitude import Orientation
from jaxsat.config import Noise, Saturation
from jaxsat.pipeline import Estimate
from jaxsat.saturation.solvers import Status
from jaxsat.signals.formats import ANGULAR_RATE, SPECIFIC_FORCE


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows as aligned text: the first column to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            row[0].ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)),
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def plural(count: int, noun: str) -> str:
    """'1 gap', '2 gaps'."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def inspection_text(found: Mapping[str, Any]) -> str:
    """What `jaxsat inspect` prints."""
    rests, force = found["rests"], found["specific_force_at_rest"]
    lines = [
        f"{found['name']}: {found['samples']} samples at {found['rate']:.6g} Hz, {found['duration']:.2f} s",
        f"missing values: {found['missing_values']}",
        f"rests: {rests['count']} ({rests['source']}), {rests['share']:.0%} of the time"
        + (f"; first {rests['first'][0]:.2f} to {rests['first'][1]:.2f} s" if rests["first"] else ""),
        "specific force at rest: "
        + (f"{force:.3f} m/s²" if force is not None else "unknown, there is no rest"),
        "",
    ]
    rows = [["channel", "lowest", "highest", "", "lower rail", "upper rail", "saturated", "gaps", "longest"]]
    for channel, sides in found["rails"].items():
        # Data sheets speak of °/s and g: rails are shown in both.
        unit, other = ("rad/s", "deg/s") if channel.startswith("gyr") else ("m/s²", "g")
        scale = ANGULAR_RATE["deg/s"] if other == "deg/s" else SPECIFIC_FORCE["g"]
        rails = [
            "-" if side["rail"] is None else f"{side['rail']:.4g} ({side['rail'] / scale:.4g} {other})"
            for side in (sides["low"], sides["high"])
        ]
        gaps = sum(side["gaps"] for side in sides.values())
        longest = max(side["longest_gap"] for side in sides.values())
        rows.append(
            [
                channel,
                f"{found['lowest'][channel]:.4g}",
                f"{found['highest'][channel]:.4g}",
                unit,
                *rails,
                str(found["saturated"][channel]),
                str(gaps),
                str(longest),
            ]
        )
    lines += [columns(rows), found["support"]]
    lines += [f"warning: {warning}" for warning in found["warnings"]]
    return "\n".join(lines)


def estimate_text(estimate: Estimate, report: Path) -> str:
    """What `jaxsat estimate` prints."""
    recording, position = estimate.recording, estimate.trajectory.position
    status = estimate.fills.status
    searched = status != Status.NOTHING_TO_DO
    rows = [
        ["recording", f"{recording.name}, {len(recording)} samples at {1 / recording.period:.4g} Hz"],
        ["method", estimate.config.method],
        [
            "saturated",
            f"{plural(int(estimate.saturated.sum()), 'value')} in {plural(len(estimate.gaps), 'gap')}",
        ],
        [
            "rests",
            f"{estimate.rest.mean():.0%} of the time, with {plural(len(estimate.segments), 'segment')} of motion",
        ],
    ]
    if estimate.level:
        rows.append(["ground", "level, as far as the recording can say (--height off: do not assume it)"])
    if searched.any():
        settled = int((status == Status.CONVERGED).sum())
        rows.append(["searches", f"{settled} of {int(searched.sum())} settled on a minimum"])
    cost = f"{float(estimate.cost):.4g}"
    if estimate.config.method != "standard":
        cost += f" (was {float(estimate.cost_standard):.4g} with saturation ignored)"
    moved = np.linalg.norm(position[-1, :2] - position[0, :2])
    rows += [
        ["misfit J*", cost],
        ["start to end", f"{moved:.3f} m horizontally, {position[-1, 2] - position[0, 2]:+.3f} m in height"],
        ["report", str(report)],
    ]
    return "\n".join(f"{label:<14}{text}" for label, text in rows)


def orientation_text(found: Orientation, path: Path) -> str:
    """What `jaxsat orientation` prints."""
    recording, gains = found.recording, found.gains
    first, last = np.rad2deg(found.euler[0]), np.rad2deg(found.euler[-1])
    offset = np.rad2deg(found.start.offset)
    rows = [
        ["recording", f"{recording.name}, {len(recording)} samples at {1 / recording.period:.4g} Hz"],
        ["estimate", found.config.orientation.estimate],
        ["gains", f"kp {float(gains.kp):.4g} /s, ki {float(gains.ki):.4g} /s², tau {float(gains.tau):.4g} s"],
        [
            "saturated",
            f"{plural(int((found.sign != 0).sum()), 'value')} in {plural(len(found.gaps), 'gap')}",
        ],
        ["offset", ", ".join(f"{x:+.3f}" for x in offset) + " deg/s"],
        ["first", ", ".join(f"{x:+.2f}" for x in first) + " deg about x, y, z"],
        ["last", ", ".join(f"{x:+.2f}" for x in last) + " deg; z drifts with the gyroscope"],
        *([] if found.sd is None else [["sd", _sd_words(np.rad2deg(found.sd))]]),
        ["table", str(path)],
    ]
    return "\n".join(f"{label:<14}{text}" for label, text in rows)


def _sd_words(sd: np.ndarray) -> str:
    """Of inclination and heading (deg)."""
    middle, largest = np.median(sd[:, 0]), sd[:, 0].max()
    return f"inclination {middle:.2g} deg, at most {largest:.2g}; heading {sd[-1, 1]:.2g} deg at the end"


def sweep_text(table: pd.DataFrame, path: Path) -> str:
    """What `jaxsat sweep` prints: by method and rails, the median path error and how the elements ended."""
    used, failed = table.query("status != 'failed'"), table.query("status == 'failed'")
    words = sorted(set(used["status"]))
    rows = [["method", "gyr rail", "acc rail", "path RMSE", *words]]
    labels = ["method", "gyr_rail", "acc_rail"]
    for _, group in used.groupby(labels, sort=False):
        method, *rails = group[labels].iloc[0]
        ends = list(group["status"])
        rows.append(
            [
                method,
                *(f"{rail:.4g}" if np.isfinite(rail) else "none" for rail in rails),
                f"{group['path_rmse'].median():.4g} m",
                *(str(ends.count(word)) for word in words),
            ]
        )
    lines = [
        f"{plural(len(set(used['trial'])), 'trial')}; rails in rad/s and m/s²; median path RMSE against the "
        "recording as given; elements by status",
        columns(rows),
    ]
    lines += [f"failed: {note}" for note in failed["note"]]
    return "\n".join([*lines, f"table: {path}"])


def tuning_text(
    found: tuple[Noise, Noise] | tuple[Saturation, Saturation],
    loss: tuple[float, float],
    against_truth: bool,
    names: Sequence[str],
) -> str:
    """What `jaxsat tune` prints, and writes above what it found: noise or prior, and loss, before and after."""
    units = {"prior_width": "rails", "prior_share": "of what is expected"}
    if isinstance(found[0], Noise):
        units = {"gyr_density": "rad/s/√Hz", "acc_density": "m/s²/√Hz", "rest_velocity_sd": "m/s"}
    rows = [["", "before", "after", ""]]
    for name, unit in units.items():
        rows.append([name, *(f"{getattr(one, name):.4g}" for one in found), unit])
    if against_truth:
        rows.append(["position RMSE", *(f"{np.sqrt(one):.4g}" for one in loss), "m"])
    else:
        what = "a rest" if isinstance(found[0], Noise) else "a gap"
        rows.append([f"misfit of {what}", *(f"{one:.4f}" for one in loss), "-log p"])
    return f"tuned on {plural(len(names), 'recording')}: {', '.join(names)}\n" + columns(rows)
