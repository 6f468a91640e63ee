"""The board and the page of the tables."""

from jaxsat.studies.boards import Row

from . import Table

PAPER = {
    "gyro": (22.85, 45.15, 19.87),
    "accel": (0.34, 0.17, 0.002),
    "gyro_accel": (0.33, 0.12, 9.26),
    "pi": (0.001, 0.10, 9.21),
}
"""Drift in x, y and z of Table 1 (deg)."""


def board(tables: dict[str, Table]) -> list[Row]:
    """The numbers that are aimed at."""
    rows = []
    static = tables["static"].set_index(["recording", "estimate"])
    for recording, word in (("simulated, 300 s", "static"), ("real, 32 s", "tail")):
        gyro = static.loc[(recording, "gyro")]
        forms = (
            ("", "pi, Good Gain, tau 0"),
            ("_low_pass", "pi, Good Gain"),
            ("_integral", "pi, integral alone"),
            ("_default", "pi"),
            ("_smoothed", "smoothed"),
        )
        for suffix, label in forms:
            pi = static.loc[(recording, label)]
            for axis, paper in zip("xy", PAPER["pi"][:2], strict=True):
                note = f"{recording}, {label}; baseline: the gyroscope alone; the paper in 300 s: {paper:g}"
                name, value = f"orientation_{word}_drift_{axis}{suffix}", pi[f"drift_{axis}"]
                rows.append(Row(name, value, "deg", "lower", 0.1, gyro[f"drift_{axis}"], note))
        notes = {
            (
                "pi, integral alone",
                "_integral",
            ): "structural: no correction has a vertical component, so z drifts as the gyroscope (baseline)",
            ("pi", "_default"): "its offset about z is read at rests; baseline: the gyroscope alone",
        }
        for (label, suffix), note in notes.items():
            value = static.loc[(recording, label)]["drift_z"]
            name = f"orientation_{word}_drift_z{suffix}"
            rows.append(Row(name, value, "deg", "lower", None, gyro["drift_z"], note))
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
    # What was not run in a round has no number.
    every = tables["clipped"].dropna(subset="total").set_index(["filter", "trial", "input"]).sort_index()
    clipped, peer = every.loc["jaxsat smoothed"], every.loc["VQF offline"]
    for trial in clipped.xs("filled", level="input").index:
        total = {word: clipped.loc[(trial, word)]["total"] for word in ("unclipped", "filled")}
        theirs = {word: peer.loc[(trial, word)] for word in ("unclipped", "filled")}
        rows.append(
            Row(
                f"orientation_clipped_ratio_{trial[:2]}",
                total["filled"] / total["unclipped"],
                "1",
                "lower",
                1.2,
                theirs["filled"]["total"] / theirs["unclipped"]["total"],
                f"{trial}: total RMSE, clipped at 500 °/s and filled, over unclipped ({total['unclipped']:.2f}°); "
                f"{clipped.loc[(trial, 'filled')]['saturated']:.1%} of the moving samples saturate; "
                "baseline: VQF offline with the same fill",
            )
        )
        filled = clipped.loc[(trial, "filled")]
        rows.append(
            Row(
                f"orientation_clipped_inclination_{trial[:2]}",
                filled["inclination"],
                "deg",
                "lower",
                None,
                theirs["filled"]["inclination"],
                f"{trial}: inclination RMSE, clipped and filled; said to be {filled['inclination_sd']:.2g} deg; "
                f"unclipped {clipped.loc[(trial, 'unclipped')]['inclination']:.2f}; baseline: VQF offline, same fill",
            )
        )
    return rows


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
    said = (
        tables["clipped"]
        .query("filter == 'jaxsat smoothed'")
        .pivot(index="trial", columns="input", values=["inclination", "inclination_sd"])
    )
    said.columns = [f"{what}, {how}" for what, how in said.columns]
    clipped.columns = [f"{what}, {how}" for what, how in clipped.columns]
    moving = tables["moving"].pivot(index=["lever", "estimate"], columns="axis", values=["drift", "rmse"])
    moving.columns = [f"{what} {axis}" for what, axis in moving.columns]
    parts = [
        "# Orientation\n\nMade by `scripts/orientation` with `configs/orientation/board.toml`; the numbers "
        "aimed at are in `board.md`, all of them in the CSV files. Degrees throughout.",
        "## At rest (the paper's Table 1)\n\nDrift between the means of the first and the last second; RMSE about a "
        "running mean over one second. The simulated MPU-6050 (mean of five seeds) warms by 0.6 °C, which moves its "
        "zeros as its data sheet says. `pi` learns the gyroscope's offset at rests, about z too; `integral alone` "
        "and Good Gain do not, as the paper has it: there z drifts as the gyroscope, structurally.",
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
        "What `smoothed` says of its inclination (sd), beside what it is (RMSE):",
        markdown(said.reset_index()),
        notes,
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def markdown(table: Table, digits: int = 3) -> str:
    cells = [
        [f"{x:.{digits}f}" if isinstance(x, float) else str(x) for x in row] for row in table.to_numpy(object)
    ]
    lines = [list(table.columns), ["---"] * len(table.columns), *cells]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
